"""The arithmetic of the ablation (`research/benchmarks/ablation.py`): errors, their parts, and what a row changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.bench.case import MAIN_JOINTS, PAPER_JOINTS
from pbl_pipeline.fit import METHODS, GaussNewtonParams
from pbl_pipeline.keypoints import Keypoints
from research.benchmarks.ablation import figures_of, path_error_m, row_of, table
from research.benchmarks.ablation_cases import DEFAULT, Setup, factors, leant, paramset_of, session, slow, squashed

RAY = np.array([[0.0, 0.0, 1.0]])


def errors(median: float, bias: float, sd: float, rte_cm: float = 2.0) -> dict:
    """`errors_of` with the same figures for every joint."""
    values = {"median_deg": median, "bias_deg": bias, "sd_deg": sd, "within_90": 0.9}
    return {**{k: dict.fromkeys(PAPER_JOINTS, v) for k, v in values.items()}, "rte_cm": rte_cm}


def test_a_turned_and_shifted_path_is_no_error():
    t = np.linspace(0, 5, 50)
    true = np.column_stack([t, np.sin(t), 0.02 * np.cos(9 * t)])
    c, s = np.cos(0.7), np.sin(0.7)
    moved = true @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]).T + [1.0, -2.0, 0.5]
    assert path_error_m(moved, true) == pytest.approx(0, abs=1e-12)


def test_a_path_tipped_out_of_level_or_stretched_is_an_error():
    true = np.column_stack([np.linspace(-1, 1, 41), np.zeros(41), np.zeros(41)])
    tipped = np.column_stack([true[:, 0], true[:, 1], 0.1 * true[:, 0]])
    assert path_error_m(tipped, true) == pytest.approx(0.1 * np.mean(np.abs(true[:, 0])))
    assert path_error_m(1.2 * true, true) == pytest.approx(0.2 * np.mean(np.abs(true[:, 0])))


def test_figures_share_the_square_error_between_bias_and_the_rest():
    figures = figures_of(errors(median=2.0, bias=-3.0, sd=4.0))
    assert figures["all_deg"] == pytest.approx(2.0)
    assert figures["bias_deg"] == pytest.approx(3.0)
    assert figures["bias_share"] == pytest.approx(9 / 25)


def test_main_counts_its_own_joints_only():
    given = errors(median=1.0, bias=0.0, sd=1.0)
    given["median_deg"]["elbow_flex_r"] = 1.0 + len(PAPER_JOINTS)
    assert "elbow_flex_r" not in MAIN_JOINTS
    figures = figures_of(given)
    assert figures["main_deg"] == pytest.approx(1.0)
    assert figures["all_deg"] == pytest.approx(2.0)


def test_a_row_compares_the_people_that_both_could_fit():
    default = {1: errors(1.0, 0, 1), 2: errors(2.0, 0, 1), 3: errors(9.0, 0, 1)}
    row = row_of(factors()[0], {1: errors(1.5, 0, 1), 2: errors(2.7, 0, 1)}, default)
    assert row["people"] == 2
    assert row["change_all_deg"] == pytest.approx(0.6)
    assert row["change_all_deg_se"] == pytest.approx(np.std([0.5, 0.7], ddof=1) / np.sqrt(2))


def test_a_row_that_nobody_could_be_fitted_with_stands_last():
    default = {1: errors(1.0, 0, 1), 2: errors(2.0, 0, 1)}
    rows = [row_of(factors()[0], {}, default), row_of(DEFAULT, default, default)]
    last = table(rows).splitlines()[-1]
    assert factors()[0].name in last
    assert "nan" in last


def test_squashing_touches_the_depth_alone():
    points = np.array([[[0.3, -0.5, 0.2]]])
    np.testing.assert_allclose(squashed(points, RAY, 0.8), [[[0.3, -0.5, 0.16]]])


def test_leaning_brings_the_head_near_and_keeps_lengths():
    head = np.array([[[0.2, -0.8, 0.0]]])  # the camera's y points down
    out = leant(head, RAY, 10.0)
    np.testing.assert_allclose(out, [[[0.2, -0.8 * np.cos(np.radians(10)), -0.8 * np.sin(np.radians(10))]]])


def test_slow_noise_has_the_detectors_memory_at_any_rate():
    for fps in (30, 60):
        noise = slow(np.random.default_rng(0), np.arange(20 * fps) / fps, (20 * fps, 300))
        assert noise.std() == pytest.approx(1, abs=0.05)
        later = fps // 30  # 1/30 s
        assert np.mean(noise[later:] * noise[:-later]) == pytest.approx(0.9, abs=0.05)


def test_every_row_is_named_once_and_differs_from_the_default():
    rows = factors()
    assert len({f.name for f in rows}) == len(rows)
    assert all(f.setup != DEFAULT.setup for f in rows)


def test_paramsets_change_in_what_is_asked_and_in_nothing_else():
    given = METHODS["gauss-newton"].params
    assert isinstance(given, GaussNewtonParams)
    made = METHODS.find(paramset_of(Setup(times={"cost.weight_2d": 0.1}, values={"max_iterations": 7}))).params
    cost = dataclasses.replace(given.cost, weight_2d=0.1 * given.cost.weight_2d)
    assert made == dataclasses.replace(given, cost=cost, max_iterations=7)
    with pytest.raises(KeyError):
        paramset_of(Setup(values={"cost.no_such_weight": 1.0}))


@pytest.mark.slow
@pytest.mark.parametrize("factor", factors(), ids=lambda f: f.name)
def test_every_row_can_be_observed_and_has_a_paramset(factor):
    paramset_of(factor.setup)
    given, truth = session(dataclasses.replace(factor.setup, n_trials=1), 100, 0.5)
    assert truth[0].shape == (round(0.5 * factor.setup.fps), 40)
    assert given.trials[0].names


def test_rows_see_the_same_walk_with_the_same_random_numbers():
    by_name = {f.name: f.setup for f in factors()}

    def points(setup: Setup) -> Keypoints:
        seen = session(setup, 100, 1.0)[0].trials[0]
        assert isinstance(seen, Keypoints)
        return seen

    usual, told = points(DEFAULT.setup), points(by_name["focal length told 5 % too long"])
    np.testing.assert_array_equal(told.xy_px, usual.xy_px)
    np.testing.assert_allclose(np.diag(told.camera.matrix)[:2], 1.05 * np.diag(usual.camera.matrix)[:2])
    none, double = points(by_name["pixel noise x0"]).xy_px, points(by_name["pixel noise x2"]).xy_px
    np.testing.assert_allclose(0.5 * (none + double), usual.xy_px, atol=1e-9)
