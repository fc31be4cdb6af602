"""A corpus of known walks: what a phone sees of them, how detectors err, and whether the tables find known errors."""

import dataclasses
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import GDI_METHODS, GdiParams, detect_events, feet_from_fit
from pbl_pipeline.synthetic import NO_NOISE, VIEWS_DEG, Noise, plain_walk
from research.corpus.errors import corpus_errors, corpus_tables, print_corpus, responsiveness, view_table, write_corpus
from research.corpus.motions import Motion
from research.corpus.true_fit import fit_of_qpos
from research.corpus.walks import (
    LONG_SECONDS,
    TURN_FROM_S,
    TURN_S,
    Case,
    Walk,
    is_held_out,
    joined,
    lasting,
    synthetic_walk,
    there_and_back,
)
from research.walker.detectors import DETECTORS, DetectorNoise
from research.walker.observe import observe
from research.walker.turns import facing
from tests import not_none

COLUMN = {n: i for i, n in enumerate(load_body().joint_names)}
TIME_S = np.arange(180) / 30
#: A detector that errs in nothing.
QUIET = DetectorNoise(**dataclasses.asdict(NO_NOISE))


def _walk(person: str = "somebody", condition: str = "healthy", severity: float = 0.0, knee_deg: float = 0.0) -> Walk:
    """A plain walk whose knees bend by `knee_deg` more."""
    qpos = plain_walk(TIME_S, heading_rad=0.3)
    qpos[:, [COLUMN["knee_angle_r"], COLUMN["knee_angle_l"]]] -= np.radians(knee_deg)
    events = detect_events(feet_from_fit(fit_of_qpos("walk", TIME_S, qpos))).events
    return Walk(person, "synthetic", condition, severity, TIME_S, qpos, np.ones(8), events)


def _fake_fit(change):
    """Return, instead of `fit_sessions`, the truth of each case, changed."""

    def fit(cases):
        def run(sessions, method):
            assert len(sessions) == len(cases)
            return [_session(change(c.walk.fit())) for c in cases]

        return run

    return fit


@dataclasses.dataclass(frozen=True)
class _Fit:
    trials: tuple
    qc: tuple = ()


def _errors(cases, fit, **kwargs) -> Any:
    """(pandas' own types say less of a column than these tests need.)"""
    return corpus_errors(cases, fit=fit, **kwargs)


def _session(fit) -> _Fit:
    return _Fit((fit,))


def _off(fit, joint: str, deg: float):
    qpos = fit.qpos.copy()
    qpos[:, [COLUMN[f"{joint}_{s}"] for s in "rl"]] += np.radians(deg)
    return dataclasses.replace(fit, qpos=qpos, qpos_sd=np.full_like(qpos, np.radians(5.0)))


@pytest.mark.parametrize("view", [v for v in VIEWS_DEG if v != "follow"])
def test_any_motion_is_seen_from_the_view_that_is_asked_for(view: str):
    qpos = plain_walk(TIME_S, heading_rad=1.0, start_m=(40.0, -7.0))
    seen = observe(qpos, TIME_S, view=view, noise=NO_NOISE, marker_set="blazepose_33", camera_motion="panned")
    way = seen.markers_world_m[-1].mean(axis=0) - seen.markers_world_m[0].mean(axis=0)
    facing = np.degrees(np.arctan2(way[1], way[0]))
    assert abs((facing - VIEWS_DEG[view] + 180) % 360 - 180) < 8
    assert seen.markers_world_m[..., 0].min() > 2.0
    assert seen.markers_world_m[..., 2].min() == pytest.approx(-1.2, abs=0.2)
    # All of the person in the picture, and only a turn and a shift away from where it was.
    assert (seen.keypoints.confidence > 0).all()
    turning = [i for n, i in COLUMN.items() if not n.startswith("pelvis")]
    assert np.array_equal(seen.qpos[:, turning], qpos[:, turning])


def test_a_view_that_moves_with_the_person_is_refused():
    with pytest.raises(PblError, match="follow"):
        observe(plain_walk(TIME_S), TIME_S, view="follow")


def _errors_of(noise: Noise, view: str = "frontal", seeds: int = 4) -> list[tuple[np.ndarray, np.ndarray]]:
    """Errors (T, J, 2) in the picture in metres at the person's distance, and (T, J, 3) in 3D, of some trials."""
    qpos, out = plain_walk(TIME_S, heading_rad=0.0), []
    for seed in range(seeds):
        kwargs = {"view": view, "marker_set": "blazepose_33", "camera_motion": "static", "seed": seed}
        ours, true = (observe(qpos, TIME_S, noise=n, **kwargs) for n in (noise, NO_NOISE))
        depth = true.keypoints.camera.matrix[0, 0] / (true.markers_world_m @ true.R_nc[0])[..., 2:]
        xyz = ours.keypoints.xyz_cam_m - true.keypoints.xyz_cam_m
        out.append(((ours.keypoints.xy_px - true.keypoints.xy_px) / depth, xyz))
    return out


def test_pixels_err_with_a_memory_by_constants_and_with_distance():
    noise = dataclasses.replace(QUIET, xy_m=0.02, xy_correlation=0.9, xy_constant_m=0.015)
    errors = [e for e, _ in _errors_of(noise)]
    constant = np.array([e.mean(axis=0) for e in errors])
    moving = np.concatenate([e - e.mean(axis=0) for e in errors], axis=1)
    assert constant.std() == pytest.approx(0.015, rel=0.2)
    assert moving.std() == pytest.approx(0.02, rel=0.15)
    assert np.mean(moving[1:] * moving[:-1]) / np.mean(moving**2) == pytest.approx(0.9, abs=0.04)


def test_the_far_leg_loses_movement_from_the_side_and_not_from_the_front():
    noise = dataclasses.replace(QUIET, far_still=0.5)
    for view, lost in (("sagittal", True), ("frontal", False)):
        ((xy, _),) = _errors_of(noise, view, seeds=1)
        near, far = (np.abs(xy[:, j]).max() for j in (27, 28))  # left and right ankle: the left side is near
        assert near < 0.06  # at the ends of a trial half a stride is all there is to tell near from far
        assert (far > 0.08) == lost


def test_the_benchmarks_noise_is_what_it_was():
    """Fields that came later draw nothing where they are off: figures of the benchmark stay comparable."""
    seen = observe(plain_walk(TIME_S), TIME_S, seed=3)
    assert np.isnan(seen.keypoints.xy_px).any(axis=(1, 2)).any()
    again = observe(plain_walk(TIME_S), TIME_S, seed=3, noise=DetectorNoise(wander_correlation=0.5))
    assert np.array_equal(seen.keypoints.xy_px, again.keypoints.xy_px, equal_nan=True)


def test_a_fit_without_errors_has_none_in_any_table():
    cases = [Case(_walk(p), v, "static", "blazepose-heavy") for p, v in (("a", "frontal"), ("b", "oblique"))]
    errors = _errors(cases, _fake_fit(lambda fit: fit)(cases))
    assert np.abs(errors["gdi"] - errors["gdi_true"]).max() < 1e-9
    assert errors["hip_adduction_ratio"].tolist() == pytest.approx([1.0, 1.0])
    assert errors[["knee_flexion_offset", "knee_flexion_sd"]].abs().max().max() < 1e-9


def test_known_errors_are_found():
    cases = [Case(_walk(p), "frontal", "static", "blazepose-heavy") for p in ("a", "b", "c")]
    errors = _errors(cases, _fake_fit(lambda fit: _off(fit, "hip_flexion", 10.0))(cases))
    assert errors["hip_flexion_offset"].to_numpy() == pytest.approx(10.0)
    assert errors["hip_flexion_sd"].to_numpy() == pytest.approx(0.0, abs=1e-9)
    # 10 deg of error against a spread of 5: outside of every 90 % interval; the others are inside.
    assert errors["hip_flexion_in90"].to_numpy() == pytest.approx(0.0)
    assert errors["knee_flexion_in90"].to_numpy() == pytest.approx(1.0)
    assert (errors["gdi"] < errors["gdi_true"]).all()
    assert errors["cadence"].to_numpy() == pytest.approx(errors["cadence_true"].to_numpy(), rel=0.01)


def test_the_index_is_that_of_the_method_asked_for():
    cases = [Case(_walk(), "frontal", "static", "blazepose-heavy")]
    fit = _fake_fit(lambda fit: _off(fit, "hip_flexion", 10.0))(cases)
    shipped = GDI_METHODS[GDI_METHODS.default]
    more = GDI_METHODS.make("more", 1, dataclasses.replace(shipped.params, lengthening=0.5))
    default, asked = _errors(cases, fit), _errors(cases, fit, index=more)
    for found, true in (("gdi", "gdi_true"), ("gdi_detected", "gdi_true")):
        assert asked[found][0] > default[found][0] + 1  # more is taken back from what errors lengthen
        assert asked[true][0] == default[true][0]  # of which the truth has none


def test_several_views_make_one_session():
    """A fit whose error in one view is the opposite of that in the other has none in the session's mean curves."""
    both = joined(["sagittal", "sagittal_right"])
    case = Case(_walk(), both, "static", "blazepose-heavy")
    assert list(case.trials()) == ["sagittal", "sagittal_right"]
    alone = Case(_walk(), "sagittal_right", "static", "blazepose-heavy").keypoints()
    assert np.array_equal(case.trials()["sagittal_right"].xy_px, alone.xy_px)

    def fit(sessions, method):
        assert [len(s.trials) for s in sessions] == [2]
        assert len(set(sessions[0].names)) == 2
        truth = case.walk.fit()
        return [_Fit((_off(truth, "hip_flexion", 6.0), _off(truth, "hip_flexion", -6.0)))]

    errors = _errors([case], fit)
    assert errors["hip_flexion_offset"][0] == pytest.approx(0.0, abs=1e-9)
    plain = _errors([case], fit, index=GDI_METHODS.make("plain", 1, GdiParams(average="curves")))
    assert plain["gdi"][0] == pytest.approx(plain["gdi_true"][0], abs=1e-6)
    with pytest.raises(PblError, match="above"):
        joined(["sagittal", "above"])


def test_the_mean_of_a_walks_views():
    """Two views whose errors are opposite have a mean without an error; a walk that lacks a view does not count."""
    seen = [(p, v) for p in ("a", "b") for v in ("sagittal", "sagittal_right", "frontal")][:-1]
    errors = pd.DataFrame(seen, columns=["person", "view"]).assign(
        held_out=lambda d: d["person"] == "b", condition="healthy", severity=0.0, gdi_true=100.0
    )
    off = {"sagittal": 6.0, "sagittal_right": -6.0, "frontal": 3.0}
    errors["gdi"] = errors["gdi_true"] + [off[view] for view in errors["view"]]
    again = errors[errors["view"] == "sagittal"].assign(gdi=0.0)  # another camera, which does not count
    table: Any = view_table(pd.concat([errors, again])).set_index("views")
    assert table["n"].to_dict() == {"front": 1, "one side": 4, "both sides": 2}
    assert table.loc["both sides", ["bias", "sd", "held out: bias"]].tolist() == pytest.approx([0.0, 0.0, 0.0])
    assert table["bias"]["front"] == pytest.approx(3.0)
    assert table["sd"]["one side"] == pytest.approx(np.std([6, -6, 6, -6], ddof=1))


def test_a_case_that_cannot_be_fitted_keeps_its_code(tmp_path):
    cases = [Case(_walk(p), "frontal", "static", "blazepose-heavy") for p in ("a", "b")]

    def fit(sessions, method):
        refused = PblError("FIT_DIVERGED", found="a", expected="b", next_step="c")
        return [refused, _session(cases[1].walk.fit())]

    errors = _errors(cases, fit)
    assert errors["error"].tolist() == ["FIT_DIVERGED", ""]
    assert np.isnan(errors["gdi"][0])
    tables: Any = corpus_tables(errors)
    assert tables["index: error by view (true events)"]["none"][0] == 1
    assert "index" in print_corpus(tables)
    paths = write_corpus(tmp_path / "out", errors, tables, {"detector": "blazepose-heavy"})
    assert all(p.stat().st_size > 100 for p in paths)
    assert "NaN" not in paths[1].read_text()


def test_the_fraction_of_a_change_that_survives():
    """A fit that moves every angle half of the way to the healthy walk keeps about half of the change."""
    walks = [_walk("a"), _walk("a", "crouch", 0.3, 8.0), _walk("a", "crouch", 0.8, 22.0)]
    cases = [Case(w, "frontal", "static", "blazepose-heavy") for w in walks]
    straight = walks[0].qpos

    def halved(fit):
        return dataclasses.replace(fit, qpos=0.5 * (fit.qpos + straight))

    whole: Any = responsiveness(_errors(cases, _fake_fit(lambda fit: fit)(cases)))
    half: Any = responsiveness(_errors(cases, _fake_fit(halved)(cases)))
    assert whole["healthy to 0.8: survives"][0] == pytest.approx(1.0)
    assert whole["healthy to 0.8: true"][0] < -5
    assert 0.2 < half["healthy to 0.8: survives"][0] < 0.8
    assert half["0.3 to 0.8: n"][0] == 1


def test_persons_are_held_out_by_a_rule_that_never_changes():
    assert [s for s in range(12) if is_held_out(f"synthetic {s}")] == [1, 4, 5, 10]


def test_a_short_walk_goes_on_stride_by_stride():
    time = np.arange(0, 1.5, 0.01)
    qpos = plain_walk(time, heading_rad=0.0, stride_s=1.1)
    motion = Motion("m", "p", "walk", "", time, qpos, np.ones(40, bool), 0.0, False, "", "", "")
    longer = not_none(lasting(motion, TIME_S))
    x = longer[:, COLUMN["pelvis_tx"]]
    assert (x[-1] - x[0]) / TIME_S[-1] == pytest.approx(1.2, rel=0.02)
    knee = longer[:, COLUMN["knee_angle_r"]]
    assert np.ptp(knee[:33]) == pytest.approx(np.ptp(knee[-33:]), rel=0.02)
    # It begins where the recording's stride does, and moves as the walk of that stride time.
    shift = [
        np.abs(plain_walk(TIME_S + s, heading_rad=0.0)[:, COLUMN["knee_angle_r"]] - knee).max()
        for s in np.arange(0, 1.1, 0.01)
    ]
    assert min(shift) < np.radians(2.0)


@pytest.mark.parametrize("detector", ["blazepose-heavy", "blazepose-33", "metrabs-87"])
def test_each_detector_has_its_points_and_a_memory(detector: str):
    model = DETECTORS[detector]
    keypoints = Case(_walk(), "oblique", "handheld", detector).keypoints()
    assert keypoints.marker_set == model.marker_set
    assert keypoints.root_relative == model.root_relative
    assert keypoints.phone_quat_wxyz is not None
    assert model.noise.xy_px == 0
    assert model.noise.xy_m > 0
    assert Case(_walk(), "oblique", "handheld", detector).keypoints().xy_px == pytest.approx(
        keypoints.xy_px, nan_ok=True
    )


def test_a_walk_turns_round_with_the_same_joint_angles():
    walk = synthetic_walk(3, seconds=LONG_SECONDS)
    bent = there_and_back(walk)
    turning = [i for n, i in COLUMN.items() if not n.startswith("pelvis")]
    assert np.array_equal(bent.qpos[:, turning], walk.qpos[:, turning])
    place = [COLUMN["pelvis_tx"], COLUMN["pelvis_tz"]]
    steps, before = (np.diff(w.qpos[:, place], axis=0) for w in (bent, walk))
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.linalg.norm(before, axis=1), atol=1e-12)
    turned = walk.time_s[1:] > TURN_FROM_S + TURN_S
    np.testing.assert_allclose(steps[turned], -before[turned], atol=1e-12)
    np.testing.assert_allclose(steps[walk.time_s[1:] < TURN_FROM_S], before[walk.time_s[1:] < TURN_FROM_S])
    heading = facing(bent.qpos[walk.time_s > TURN_FROM_S + TURN_S])
    assert np.dot(heading, facing(walk.qpos)) < -0.95
