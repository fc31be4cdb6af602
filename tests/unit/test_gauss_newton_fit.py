"""Gauss-Newton fits of synthetic walkers: what they recover, what they survive, and what must not change a result.

Bounds are about 1.4 times what was measured. All fits of the module are packed to one size (128 frames, 2 trials), so
that one program serves each kind of session.
"""

import dataclasses
import operator
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline import progress
from pbl_pipeline.body import load_body, marker_positions, marker_set, stature_m
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import (
    METHODS,
    GaussNewtonParams,
    SessionFit,
    SessionInput,
    TrialFit,
    fit_session,
    fit_sessions,
    lanes,
    many_sessions,
    session_fit,
)
from pbl_pipeline.fit.initial_pose import placed_poses
from pbl_pipeline.fit.per_frame import by_joint, floors_of
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.fit.vertical import on_their_feet, vertical
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.synthetic import CORRELATED_NOISE, Noise, Seen, SynthSpec, synthesise
from research.walker.observe import observe
from research.walker.views import observe_markers, observe_views
from research.walker.walk import person, walk_qpos
from tests import compiled

PARAMSET = METHODS["gauss-newton"]
pytestmark = pytest.mark.slow

TIME_S, HALF_S = np.arange(120) / 30, np.arange(60) / 30
#: Fits that several tests compare with: seeds of persons and walks.
SEEDS = (5, 6, 7)
UNSOLVED = PblError("FIT_DIVERGED", found="-", expected="-", next_step="-")


@pytest.fixture(scope="module", autouse=True)
def one_size() -> Iterator[None]:
    """One trial is packed like two."""
    with compiled.packed_in(least_trials=2):
        yield


def solved_by(function: Callable[..., Any]) -> Method[Any]:
    """The method with another function, as a laboratory adds one (docs/extending.md)."""
    method = METHODS.find(PARAMSET)
    return dataclasses.replace(method, family=dataclasses.replace(method.family, function=function))


def changed(**changes) -> Paramset:
    params = dataclasses.replace(METHODS.find(PARAMSET).params, **changes)
    return Paramset.of("fit", "changed", 1, params)


def walk(seed: int) -> np.ndarray:
    return walk_qpos(TIME_S, seed, path="straight")


def look(seed: int, **how) -> Seen:
    scale, offset = person(seed)
    return observe(walk(seed), TIME_S, scale=scale, site_offset_m=offset, seed=seed, **how)


def errors(trial: TrialFit, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median error over the known frames: of the pelvis' place (3,) in m, of the angles (37,) in deg."""
    known = np.isfinite(trial.qpos).all(axis=1)
    assert known.mean() > 0.9
    e = trial.qpos[known] - truth[known]
    angles = np.angle(np.exp(1j * e[:, 3:]))
    return np.median(np.abs(e[:, :3]), axis=0), np.rad2deg(np.median(np.abs(angles), axis=0))


def assert_near(trial: TrialFit, truth: np.ndarray, deg: float, m: float) -> None:
    place, angles = errors(trial, truth)
    assert np.median(angles) < deg, angles
    assert np.median(place) < m, place
    assert np.isfinite(trial.qpos_sd[np.isfinite(trial.qpos)]).all()
    assert np.all(trial.qpos_sd[np.isfinite(trial.qpos)] > 0)


def turned(trial: TrialFit, seen: Seen) -> np.ndarray:
    """Rotations (T, 3, 3), in the world, from the true to the fitted camera in the frames that count."""
    R = Rotation.from_quat(trial.phone_quat_wxyz, scalar_first=True).as_matrix()
    return np.einsum("tij,tkj->tik", R, seen.R_nc)[np.isfinite(trial.qpos[:, 0])]


def check(fit: SessionFit, name: str) -> str:
    return {c.check: c.outcome for c in fit.qc}[name]


def joint(trial: TrialFit, name: str) -> int:
    return trial.joint_names.index(name)


# --- recovery ---


@pytest.fixture(scope="module")
def walkers() -> list[SessionInput]:
    return [SessionInput([look(seed).keypoints], [f"walk {seed}"]) for seed in SEEDS]


@pytest.fixture(scope="module")
def one_by_one(walkers) -> list[SessionFit]:
    return [fit_session(w.trials, w.names, PARAMSET) for w in walkers]


def test_a_walk_is_recovered(one_by_one):
    for seed, fit in zip(SEEDS, one_by_one, strict=True):
        assert_near(fit.trials[0], walk(seed), deg=2.8, m=0.025)
        assert fit.converged
        assert fit.result in ("small_step", "small_gain")
        assert fit.iterations < 30
        assert {check(fit, n) for n in ("iterations", "joints_not_observed", "residual_3d_cm")} == {"PASS"}
        assert np.max(np.abs(fit.scale / person(seed)[0] - 1)) < 0.08


def test_intervals_of_90_percent_hold_the_truth():
    """360 frames of three people seen with pixels that err with a memory, all angles but the pelvis', which the
    vertical from the walk moves."""
    inside = []
    for seed in SEEDS:
        trial = fit_session([look(seed, noise=CORRELATED_NOISE).keypoints], ["a"], PARAMSET).trials[0]
        known = np.isfinite(trial.qpos).all(axis=1)
        error = np.angle(np.exp(1j * (trial.qpos - walk(seed))[known]))
        inside.append(np.abs(error) < 1.645 * trial.qpos_sd[known])
    share = np.concatenate(inside)[:, 6:]
    assert 0.83 < share.mean() < 0.96
    assert np.min(share.mean(axis=0)) > 0.3  # no joint is sure of what it is not


def test_two_trials_share_one_body():
    scale, offset = person(4)
    truths = [walk_qpos(HALF_S, seed, path="straight") for seed in (14, 15)]
    trials = [observe(q, HALF_S, scale=scale, site_offset_m=offset, seed=i).keypoints for i, q in enumerate(truths)]
    fit = fit_session(trials, ["a", "b"], PARAMSET)
    for trial, truth in zip(fit.trials, truths, strict=True):
        assert_near(trial, truth, deg=2.8, m=0.06)
        assert trial.scale is fit.scale or np.array_equal(trial.scale, fit.scale)


def test_a_known_height_sets_every_length_and_moves_no_pixel():
    """Points that are 10 % too small, as a detector that takes people for smaller would give them."""
    scale = person(5)[0]
    tall = stature_m(load_body(), scale)
    given = look(5).keypoints
    small = dataclasses.replace(given, xyz_cam_m=0.9 * given.xyz_cam_m)
    free, known = (fit_session([small], ["a"], PARAMSET, height_m=h) for h in (None, tall))
    a, b = free.trials[0], known.trials[0]
    assert stature_m(load_body(), known.scale) == pytest.approx(tall, rel=1e-6)
    assert stature_m(load_body(), free.scale) < 0.93 * tall
    factor = known.scale[0] / free.scale[0]
    np.testing.assert_allclose(b.qpos[:, 3:], a.qpos[:, 3:], atol=1e-9)
    np.testing.assert_allclose(b.markers_world_m, factor * a.markers_world_m, rtol=1e-6)  # the phone is the origin
    # The model says the same as the markers: what it puts at the pose lies there.
    body, markers = load_body(), marker_set(b.marker_set)
    seen = np.flatnonzero(np.isfinite(b.qpos[:, 0]))[:3]
    x = marker_positions(body, markers, b.qpos[seen], b.scale, b.site_offset_m)
    np.testing.assert_allclose(np.asarray(x), b.markers_world_m[seen], atol=2e-4)
    assert_near(b, walk(5), deg=2.8, m=0.06)
    assert check(known, "body_height_stated") == "PASS"
    assert (b.height_m, a.height_m) == (tall, pytest.approx(np.nan, nan_ok=True))
    mistyped = fit_session([small], ["a"], PARAMSET, height_m=1.4 * tall)
    assert check(mistyped, "body_height_stated") == "FAIL"
    assert check(mistyped, "scale_furthest_from_1") == "PASS"  # proportions, not the size
    with pytest.raises(PblError, match="FIT_INPUT"):
        fit_session([small], ["a"], PARAMSET, height_m=172.0)


def test_a_tilted_camera_is_set_upright_by_the_walk():
    seen = look(5, tilt_deg=(8.0, -5.0))
    fit = fit_session([seen.keypoints], ["a"], PARAMSET)
    up = turned(fit.trials[0], seen)[:, 2, 2]
    assert fit.trials[0].orientation_source == "estimated: gait"
    assert np.rad2deg(np.arccos(up)).max() < 3.0
    assert_near(fit.trials[0], walk(5), deg=2.8, m=0.06)


@pytest.mark.parametrize(("stoop_deg", "side_deg"), [(12.0, 0.0), (-8.0, 0.0), (0.0, 3.0)])
def test_a_short_path_tells_the_vertical_of_somebody_who_stoops(stoop_deg, side_deg):
    """2.4 m with 2 cm of bobbing; to a side, the body counts for all that is known."""
    t = np.linspace(0, 2, 60)
    x = np.stack([4 + 1.2 * t, 0.02 * np.sin(5 * t), 0.02 * np.sin(11 * t)], axis=1)
    axis = Rotation.from_euler("xyz", [side_deg, stoop_deg, 0], degrees=True).apply([0.0, 0, 1])
    up = vertical(x, axis)
    assert up is not None
    ahead, aside = np.rad2deg(np.arctan2(up[:2], up[2]))
    assert abs(ahead) < 1.5
    assert aside == pytest.approx(-side_deg, abs=1.0)


def test_somebody_who_sits_down_is_on_no_slope():
    """Two thirds of the frames on the feet, with a knee that bends to 60 deg; the last third on a chair."""
    body = load_body()
    qpos, right, left = np.zeros((90, 40)), *(body.joint_names.index(f"knee_angle_{s}") for s in "rl")
    qpos[:60, right] = -np.deg2rad(30 - 30 * np.cos(np.arange(60) / 5))
    qpos[:60, left] = -np.deg2rad(30 + 30 * np.cos(np.arange(60) / 5))
    qpos[60:, [right, left]] = -np.deg2rad(85)
    on_feet = on_their_feet(body, qpos, np.ones(90, bool))
    assert on_feet[:60].all()
    assert not on_feet[60:].any()


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_a_phone_in_the_hand_and_its_clock(seed):
    seen = look(seed, camera_motion="handheld")
    fit = fit_session([seen.keypoints], ["a"], PARAMSET, "handheld")
    trial = fit.trials[0]
    assert trial.orientation_source == "measured: phone"
    assert trial.phone_clock_offset_s == pytest.approx(seen.clock_offset_s, abs=0.010)
    assert np.rad2deg(np.median(Rotation.from_matrix(turned(trial, seen)).magnitude())) < 1.5
    assert_near(trial, walk(seed), deg=2.8, m=0.04)


def test_a_trial_of_pbl_synth():
    made = synthesise(SynthSpec(seed=3, seconds=4.0, camera="handheld", view="oblique"))
    trial = fit_session([made.keypoints], ["a"], PARAMSET, "handheld").trials[0]
    error = np.angle(np.exp(1j * (trial.qpos[:, 3:] - made.truth.qpos[:, 3:])))
    assert np.rad2deg(np.nanmedian(np.abs(error))) < 3.0


def test_a_clock_that_is_known_stays(tmp_path):
    seen = look(SEEDS[0], camera_motion="handheld")
    dataclasses.replace(seen.keypoints, phone_clock_sd_s=0.001).save(tmp_path / "keypoints.npz")
    trial = fit_session([Keypoints.load(tmp_path / "keypoints.npz")], ["a"], PARAMSET, "handheld").trials[0]
    assert abs(trial.phone_clock_offset_s) < 0.005 < abs(seen.clock_offset_s)


def test_four_cameras():
    scale, offset = person(9)
    trial = observe_views(walk(9), TIME_S, scale=scale, site_offset_m=offset)
    fit = fit_session([trial], ["a"], PARAMSET)
    assert_near(fit.trials[0], walk(9), deg=1.4, m=0.012)
    assert fit.trials[0].orientation_source == "measured: calibration"
    np.testing.assert_allclose(fit.trials[0].camera_position_m, trial.poses[0].p_nc, atol=1e-6)


@pytest.mark.usefixtures("little_optimised")
def test_laboratory_markers():
    scale, offset = person(9)
    trial = observe_markers(walk(9), TIME_S, scale=scale, site_offset_m=offset)
    fit = fit_session([trial], ["a"], METHODS["markers"])
    assert_near(fit.trials[0], walk(9), deg=1.4, m=0.012)
    assert np.isnan(fit.trials[0].phone_quat_wxyz).all()


@pytest.mark.parametrize("name", ["gauss-newton", "blazepose"])
def test_standard_deviations_of_every_joint_are_calibrated(name):
    body, params = load_body(), METHODS.find(METHODS[name]).params
    assert isinstance(params, GaussNewtonParams)
    floors, factors = floors_of(body, params.sd_floor), by_joint(body.joint_names, params.sd_factor, 1.0)
    assert np.all((floors > 0) | (factors != 1.0))
    # Degrees for turns, centimetres for slides.
    assert np.all(floors < np.deg2rad(30))


def fit_metre(fit: TrialFit) -> float:
    """Metres of the detector in one of the body."""
    session = make_session([look(5).keypoints], ["a"], METHODS.find(PARAMSET).params)
    assert fit.scale[0] * session.metre == pytest.approx(1.0, abs=0.1)
    return 1.0 / session.metre


def test_a_least_standard_deviation_is_added_in_squares(one_by_one):
    params = dataclasses.replace(METHODS.find(PARAMSET).params, sd_floor=(("knee", 10.0), ("pelvis_tx", 3.0)))
    given = Paramset.of("fit", "with floors", 1, params)
    fit = fit_session([look(5).keypoints], ["a"], given).trials[0]
    plain = one_by_one[0].trials[0]
    metre = fit_metre(fit)  # slides are in metres of the body until the end
    for name, floor in (("knee_angle_r", np.deg2rad(10)), ("pelvis_tx", 0.03 * metre), ("hip_flexion_l", 0.0)):
        want = np.hypot(plain.qpos_sd[:, joint(plain, name)], floor)
        np.testing.assert_allclose(fit.qpos_sd[:, joint(fit, name)], want, rtol=1e-2)


# --- what must not change a result ---


def assert_same(a: SessionFit, b: SessionFit) -> None:
    for one, other in zip(a.trials, b.trials, strict=True):
        np.testing.assert_allclose(one.qpos, other.qpos, atol=1e-4)
        np.testing.assert_allclose(one.qpos_sd, other.qpos_sd, rtol=1e-2)
        np.testing.assert_allclose(one.markers_world_m, other.markers_world_m, atol=1e-3)
    np.testing.assert_allclose(a.scale, b.scale, atol=1e-4)
    np.testing.assert_allclose(a.site_offset_m, b.site_offset_m, atol=1e-4)
    for check, other in zip(a.qc, b.qc, strict=True):
        assert (check.check, check.outcome, check.advice) == (other.check, other.outcome, other.advice)
        assert (check.value is None) == (other.value is None)
        assert check.value is None or check.value == pytest.approx(other.value, rel=1e-2)


def test_neither_company_nor_padding_changes_a_result(walkers, one_by_one, limits):
    """Five people and one whose points no one saw, packed with more frames, markers and trials than needed, in three
    lanes: who ended makes room, the last ones move to a program of two, the last of all has an empty lane beside it."""
    trial = walkers[0].trials[0]
    assert isinstance(trial, Keypoints)
    bad = SessionInput([dataclasses.replace(trial, confidence=np.zeros_like(trial.confidence))], ["bad"])
    limits(lanes, MOST_FRAMES=3 * 192, FEW=2, MOVED=2)
    with compiled.packed_in(frames=192, markers=128, trials=4):
        together = fit_sessions([walkers[0], bad, *walkers[1:], *walkers[:2]], PARAMSET, batch=5)
    error = together.pop(1)
    assert isinstance(error, PblError)
    assert error.code == "FIT_INPUT"
    for alone, fit in zip([*one_by_one, *one_by_one[:2]], together, strict=True):
        assert isinstance(fit, SessionFit)
        assert_same(alone, fit)


def test_a_bar_changes_no_result(walkers, one_by_one):
    progress.enable()
    try:
        [shown] = fit_sessions(walkers[:1], PARAMSET)
    finally:
        progress.enable(False)
    assert isinstance(shown, SessionFit)
    np.testing.assert_array_equal(shown.trials[0].qpos, one_by_one[0].trials[0].qpos)
    np.testing.assert_array_equal(shown.loss_trace, one_by_one[0].loss_trace)


def test_sessions_with_other_terms_are_not_solved_together(walkers):
    """One without 3D points has arrays of the same sizes, and must not decide for the others what counts."""
    trial = walkers[0].trials[0]
    pixels = SessionInput([dataclasses.replace(trial, xyz_cam_m=np.full_like(trial.xyz_cam_m, np.nan))], ["pixels"])
    asked: list[list[str]] = []

    def refuse(sessions, params, starts) -> list[PblError]:
        asked.append([session.names[0] for session, _ in zip(sessions, starts, strict=True)])
        return [UNSOLVED] * len(asked[-1])

    assert fit_sessions([pixels, *walkers], solved_by(refuse), batch=8) == [UNSOLVED] * 4
    assert sorted(asked) == sorted([["pixels"], [w.names[0] for w in walkers]])


def test_results_are_made_and_others_packed_while_a_solver_is_at_work(walkers, monkeypatch, limits):
    made, asked = threading.Event(), list[int]()

    def solve(sessions, params, starts) -> Iterator[None]:
        asked.append(0)
        for _ in range(8):
            while next(zip(sessions, starts, strict=True), None) is None:
                time.sleep(0.01)  # not packed yet
            asked[-1] += 1
            yield None
            assert made.wait(60)

    def result(*_: object) -> PblError:
        made.set()
        return UNSOLVED

    monkeypatch.setattr(session_fit, "_session_fit", result)
    limits(many_sessions, FIRST=1)
    assert fit_sessions([walkers[0]] * 8, solved_by(solve), batch=8) == [UNSOLVED] * 8
    assert asked == [8]


def test_two_solvers_share_the_sessions_of_a_gpu(walkers, monkeypatch, limits):
    """No session is lost or taken twice."""
    taken = list[int]()

    def solve(sessions, params, starts) -> Iterator[PblError]:
        assert operator.length_hint(sessions) == 30  # enough to solve them side by side
        for session, _ in zip(sessions, starts, strict=True):
            taken.append(int(session.names[0]))
            time.sleep(0.005)
            yield UNSOLVED

    monkeypatch.setattr(session_fit.jax, "default_backend", lambda: "gpu")
    limits(many_sessions, FIRST=4)
    given = [dataclasses.replace(walkers[0], names=[str(i)]) for i in range(30)]
    assert fit_sessions(given, solved_by(solve)) == [UNSOLVED] * 30
    assert sorted(taken) == list(range(30))


def test_a_solver_that_forgets_a_session_is_an_error(walkers):
    for solver in (lambda sessions, *_: list(sessions)[1:], lambda sessions, *_: [*list(sessions), UNSOLVED]):
        with pytest.raises(ValueError, match="a solution or an error for each"):
            fit_sessions(walkers, solved_by(solver), batch=3)


# --- robustness ---


def test_a_third_of_the_points_far_off(one_by_one):
    seen = look(5, noise=Noise(outlier_share=0.3))
    fit = fit_session([seen.keypoints], ["a"], PARAMSET)
    assert fit.converged
    assert_near(fit.trials[0], walk(5), deg=3.2, m=0.025)
    clean = one_by_one[0].trials[0].qpos_sd
    assert np.nanmedian(fit.trials[0].qpos_sd) > 1.3 * np.nanmedian(clean)


def test_toes_that_were_never_seen_are_told():
    seen = look(5, noise=Noise(drop_share=0.0), never_seen=("LBigToe", "lfourthtoe"))
    fit = fit_session([seen.keypoints], ["a"], PARAMSET)
    trial = fit.trials[0]
    assert_near(trial, walk(5), deg=2.8, m=0.025)
    sd = np.nanmedian(trial.qpos_sd, axis=0)
    assert sd[joint(trial, "mtp_angle_l")] > 5 * sd[joint(trial, "mtp_angle_r")]
    advice = {c.check: c.advice for c in fit.qc}["joints_not_observed"]
    assert "mtp_angle_l" in advice
    assert "mtp_angle_r" not in advice


def test_no_angle_has_a_smaller_error_with_fewer_points(walkers, one_by_one):
    """Without a third of the points, and without those of the left foot; the points' noise is estimated anew each time,
    to some percent."""
    seen, whole = walkers[0].trials[0], one_by_one[0].trials[0]
    foot = np.array([n in ("LHeel", "LBigToe", "LFoot") or n.startswith(("lf", "lank")) for n in seen.names])
    for lost in (np.random.default_rng(1).random(len(seen.names)) < 1 / 3, foot):
        kept = dataclasses.replace(seen, confidence=np.where(lost, 0.0, seen.confidence))
        part = fit_session([kept], ["a"], PARAMSET).trials[0]
        assert np.min(np.nanmedian(part.qpos_sd, axis=0) / np.nanmedian(whole.qpos_sd, axis=0)) > 0.97


def test_a_second_without_sight_stays_unknown():
    seen = look(5, unseen_s=((1.5, 2.5),))
    trial = fit_session([seen.keypoints], ["a"], PARAMSET).trials[0]
    unknown = (TIME_S >= 1.5) & (TIME_S < 2.5)
    assert np.isnan(trial.qpos[unknown]).all()
    known = np.asarray(np.isfinite(trial.qpos).all(axis=1))
    assert np.mean(known[~unknown]) > 0.9
    e = np.abs(trial.qpos[known] - walk(5)[known])[:, 3:]
    assert np.rad2deg(np.median(e)) < 2.8
    # At the hole's edge there is no neighbour on one side.
    edge, inside = int(np.argmax(unknown)) - 1, 25
    assert np.median(trial.qpos_sd[edge] / trial.qpos_sd[inside]) > 1.1


def test_a_start_that_faces_the_other_way_ends_the_right_way(one_by_one, stand_in):
    stand_in(placed_poses=lambda session, i, flip=False: placed_poses(session, i, not flip))
    fit = fit_session([look(5).keypoints], ["a"], PARAMSET)
    assert_near(fit.trials[0], walk(5), deg=2.8, m=0.025)
    e = fit.trials[0].qpos - one_by_one[0].trials[0].qpos
    assert np.nanmedian(np.abs(np.angle(np.exp(1j * e[:, 3:])))) < np.deg2rad(0.3)


def test_arms_that_do_not_hang_start_in_the_posture_nearest_to_their_points():
    """Sitting with bent arms."""
    posture = {"hip_flexion": 80, "knee_angle": -90, "arm_flex": 45, "arm_rot": 15, "elbow_flex": 95, "pro_sup": 95}
    truth, names = walk(5), load_body().joint_names
    for j, degrees in posture.items():
        for side in "rl":
            truth[:, names.index(f"{j}_{side}")] = np.deg2rad(degrees)
    seen = observe(truth, TIME_S, marker_set="blazepose_33", seed=5)
    session = make_session([seen.keypoints], ["a"], GaussNewtonParams())
    start = placed_poses(session, 0)[session.arrays[0].used]
    for j in ("arm_flex", "elbow_flex"):
        for side in "rl":
            found = np.median(start[:, names.index(f"{j}_{side}")])
            assert np.rad2deg(found) == pytest.approx(posture[j], abs=35), (j, side)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_start_far_off_reaches_the_same_fit_or_says_that_it_did_not(one_by_one, seed, stand_in):
    """Joints off by 60 deg in every frame: many steps are refused on the way, and none of them is an end."""

    def far(session, trial: int, flip: bool = False) -> np.ndarray:
        qpos = placed_poses(session, trial, flip)
        qpos[:, 3:] += np.random.default_rng(seed).normal(0, 1.0, 37)
        return qpos

    stand_in(placed_poses=far)
    fit = fit_session([look(5).keypoints], ["a"], PARAMSET)
    best = one_by_one[0].loss_trace[-1, 1]
    assert fit.converged == (fit.loss_trace[-1, 1] < 1.01 * best)
    if seed == 0:
        assert fit.converged
        assert_near(fit.trials[0], walk(5), deg=2.8, m=0.025)


# --- how it ends ---


def test_too_few_iterations_are_told(walkers):
    fit = fit_session(walkers[0].trials, ["a"], changed(max_iterations=2))
    assert not fit.converged
    assert (fit.iterations, fit.result) == (2, "max_steps_reached")
    assert check(fit, "iterations") == "WARN"
    assert len(fit.loss_trace) == 2


def test_a_fit_repeats_itself_to_the_last_bit(walkers, one_by_one):
    again = fit_session(walkers[0].trials, ["a"], PARAMSET)
    np.testing.assert_array_equal(again.trials[0].qpos, one_by_one[0].trials[0].qpos)
    np.testing.assert_array_equal(again.trials[0].qpos_sd, one_by_one[0].trials[0].qpos_sd)


def far_pixels(k: Keypoints) -> Keypoints:
    """One marker infinitely far off wherever it is seen."""
    xy = k.xy_px.copy()
    xy[:, -1] = np.where(k.confidence[:, -1, None] > 0, 1e30, xy[:, -1])
    return dataclasses.replace(k, xy_px=xy)


def no_lens(k: Keypoints) -> Keypoints:
    return dataclasses.replace(k, camera=dataclasses.replace(k.camera, distortion=np.full(5, np.nan)))


@pytest.mark.parametrize(("spoilt", "code"), [(far_pixels, "FIT_DIVERGED"), (no_lens, "CAMERA_INVALID")])
def test_a_cost_that_is_not_finite_is_an_error_and_no_fit(walkers, spoilt, code):
    with pytest.raises(PblError) as error:
        fit_session([spoilt(walkers[0].trials[0])], ["a"], PARAMSET)
    assert error.value.code == code
