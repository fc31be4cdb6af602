"""Training data of the event model and the calibration of its confidence."""

import dataclasses

import jax
import numpy as np
import pytest

from pbl_pipeline.gait.events.network.features import N_FEATURES
from pbl_pipeline.gait.events.network.predict import GRID_HZ
from research.events._augment import SOURCE, WINDOW, augment
from research.events._calibrate import _wraps, fit_logistic, probability, reliability
from research.events._corpus import UNIT_M, load, pack, save
from research.events._rhythm import draw_rhythm, draw_run, schedule
from research.events._scenes import scene
from research.events._sequence import Bout, Sequence
from tests.unit.test_event_phases import UP


def test_a_schedule_keeps_the_order_of_walking_and_of_running():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        left_down, right_up, right_down, left_up = schedule(rng, draw_rhythm(rng), 10.0)
        table = np.stack([left_down, right_up, right_down, left_up], axis=1).ravel()
        assert (np.diff(table) > 0).all()
        rng = np.random.default_rng(seed)
        left_down, right_up, right_down, left_up = schedule(rng, draw_run(rng), 10.0)
        assert (left_up < right_down).all()  # one foot leaves before the other comes down
        assert (left_down < left_up).all()
        assert right_up[0] < left_down[0] or right_up[0] > left_down[0] + 0.1


def test_a_scene_is_its_seeds_and_has_feet_below_the_hips():
    a, b, c = scene(5), scene(5), scene(6)
    np.testing.assert_array_equal(a.xyz_m, b.xyz_m)
    assert a.xyz_m.shape == c.xyz_m.shape == (600, 6, 2, 3)
    assert not np.array_equal(a.xyz_m, c.xyz_m)
    standing = [s for s in (scene(i) for i in range(12)) if s.kind in ("walk", "start_stop")]
    assert len(standing) > 5
    for s in standing:
        assert (s.xyz_m[:, 3, :, 2].mean(axis=0) < s.xyz_m[:, 1, :, 2].mean(axis=0)).all()
        assert (s.xyz_m[:, 1, :, 2].mean(axis=0) < s.xyz_m[:, 0, :, 2].mean(axis=0)).all()


def test_feet_are_ahead_where_they_come_down():
    """The events of a scene fit its movement: at an initial contact the foot is ahead of the other one."""
    judged = 0
    for seed in range(30):
        s = scene(seed)
        if s.kind not in ("walk", "start_stop") or not s.bouts:
            continue
        hips = s.xyz_m[:, 0, 0] - s.xyz_m[:, 0, 1]
        ahead = np.cross(hips, UP)
        apart = np.sum((s.xyz_m[:, 3, 0] - s.xyz_m[:, 3, 1]) * ahead, axis=1)
        for bout in s.bouts:
            left, right = ([round(t * GRID_HZ) for t in bout.events_s[k] if 0.1 < t < 11.9] for k in (0, 2))
            if len(left) > 3 and len(right) > 3:
                assert np.mean(apart[left]) > np.mean(apart[right])
                judged += 1
    assert judged > 15


def test_phases_are_whole_at_the_events():
    events = tuple(np.arange(4) * 1.1 + shift for shift in (0.5, 0.63, 1.05, 1.2))
    s = Sequence(np.zeros((300, 6, 2, 3), np.float32), (Bout(events, open_ends=False),), "walk")
    phase, walks = s.phases()
    assert not walks[s.time_s < 0.49].any()
    for k, times in enumerate(events):
        np.testing.assert_allclose(_wraps(phase[:, k], s.time_s), times, atol=1e-3)
    assert np.isnan(phase[~walks]).all()


@pytest.mark.long
@pytest.mark.slow
def test_an_example_is_what_the_model_takes():
    s = next(s for s in (scene(i) for i in range(50)) if s.kind == "walk")
    phase, walks = s.phases()
    cut = slice(0, SOURCE)
    made = jax.jit(augment)(jax.random.key(0), s.xyz_m[cut], phase[cut].astype(np.float32), walks[cut])
    assert made["features"].shape == (WINDOW, N_FEATURES)
    assert np.isfinite(made["features"]).all()
    assert np.isfinite(made["target"]).all()
    assert made["defined"].any()
    assert not (np.asarray(made["defined"]).any(axis=1) & ~np.asarray(made["seen"])).any()


def test_a_corpus_survives_the_file(tmp_path):
    corpus = pack(scene(i) for i in range(3))
    save(tmp_path / "c.npz", corpus)
    again = load(tmp_path / "c.npz")
    for f in dataclasses.fields(corpus):
        np.testing.assert_array_equal(getattr(corpus, f.name), getattr(again, f.name))
    first = scene(0).xyz_m
    middle = first[:, 0].mean(axis=1, keepdims=True)[:, None]
    np.testing.assert_allclose(UNIT_M * again.points[:600], first - middle, atol=UNIT_M)


def test_the_fitted_curve_says_how_often_events_are_real():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((20000, 2))
    real = rng.random(20000) < 1 / (1 + np.exp(-(1.0 + 2.0 * x[:, 0] - 0.5 * x[:, 1])))
    curve = fit_logistic(x[:10000], real[:10000])
    np.testing.assert_allclose([curve["intercept"], *curve["slope"]], [1.0, 2.0, -0.5], atol=0.12)
    assert reliability(probability(x[10000:], curve), real[10000:])["expected_error"] < 0.02
    assert reliability(np.full(10000, 0.99), real[10000:])["expected_error"] > 0.2
