"""The fit against the synthetic walker, whose angles are known; the cost terms against hand-worked numbers."""

import dataclasses
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from pbl_pipeline.body import SCALE_NAMES, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, ImplicitAdamParams, check_trial, fit_session
from pbl_pipeline.fit.checks import _converged
from pbl_pipeline.fit.initial_pose import root_positions
from pbl_pipeline.fit.joint_terms import inclination, pose_cost, pose_z, posture
from pbl_pipeline.fit.keypoint_terms import (
    mean_weights,
    offset_m,
    project_px,
    residual_3d_cm,
)
from pbl_pipeline.fit.priors import learned_poses, pose_prior, scale_precision
from pbl_pipeline.fit.term import huber, square
from pbl_pipeline.fit.trajectory import fit_ranges, pose_of, raw_of
from pbl_pipeline.keypoints import bridge_gaps, longest_run_s, whole_person_in_view
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.video import undistort_px
from tests.walker import CAMERA, observe

pytestmark = pytest.mark.slow

TIME_S = np.arange(0, 2.6, 1 / 30)


def quick(steps: int = 1500) -> Paramset:
    """`implicit-adam` with the demo's priors and full weight on 3D, because the synthetic points are metric."""
    cost = dataclasses.replace(METHODS["blazepose"].params.cost, weight_3d=1.0)
    small = {"samples_per_trial": 32, "hidden": (256, 256)}
    params = ImplicitAdamParams(steps=steps, start="keypoints", cost=cost, **small)
    return Paramset.of("fit", "test", 1, params)


@pytest.fixture(scope="module")
def two_trials():
    """Two trials of one person of other size, in opposite directions, with noise; and their fit."""
    scale = np.full(8, 1.06)
    truth = [
        plain_walk(TIME_S, heading_rad=np.pi / 2, start_m=(6.0, -1.5)),
        plain_walk(TIME_S, heading_rad=-np.pi / 2, start_m=(6.5, 1.5), stride_s=1.25),
    ]
    seen = [observe(q, TIME_S, noise_px=2.0, noise_m=0.01, scale=scale, seed=i) for i, q in enumerate(truth)]
    return truth, seen, fit_session(seen, ["left", "right"], quick())


def test_fit_recovers_angles_position_and_scale(two_trials):
    truth, _, fit = two_trials
    joints = ["hip_flexion", "hip_adduction", "knee_angle", "ankle_angle"]
    names = [f"{j}_{s}" for j in joints for s in "rl"]
    columns = [fit.trials[0].joint_names.index(n) for n in names]
    for q, trial in zip(truth, fit.trials, strict=True):
        error = np.rad2deg(np.abs(trial.qpos[:, columns] - q[:, columns]))
        assert np.median(error) < 3.0
        assert np.median(error[:, names.index("knee_angle_r")]) < 3.0
        assert np.median(np.abs(trial.qpos[:, :3] - q[:, :3])) < 0.10
    assert np.median(np.abs(fit.scale - 1.06)) < 0.03


def test_fit_turns_the_body_to_where_it_walks(two_trials):
    truth, _, fit = two_trials
    i = fit.trials[0].joint_names.index("pelvis_rotation")
    for q, trial in zip(truth, fit.trials, strict=True):
        off = np.angle(np.exp(1j * (trial.qpos[:, i] - q[:, i])))
        assert np.rad2deg(np.median(np.abs(off))) < 5.0


def test_fit_residuals_are_at_the_noise(two_trials):
    _, _, fit = two_trials
    for trial in fit.trials:
        assert np.nanmedian(trial.residual_2d_px) < 2 * 2.0
        assert np.nanmedian(trial.residual_3d_m) < 2 * 0.016  # |N(0, 1 cm)| in 3D has its median at 1.5 cm
    assert {c.check: c.outcome for c in fit.qc}["residual_2d_share_of_body_height"] == "PASS"
    assert all(bool(c.advice) == (c.outcome != "PASS") for c in fit.qc)


def test_fit_shares_one_body_and_reports_how_it_was_made(two_trials):
    _, _, fit = two_trials
    a, b = fit.trials
    assert np.array_equal(a.scale, b.scale)
    assert np.array_equal(a.site_offset_m, b.site_offset_m)
    assert a.params_hash == quick().hash
    assert fit.loss_trace[-1, 0] == 1500
    assert fit.loss_trace[-1, 1] < 0.3 * fit.loss_trace[0, 1]


def test_under_a_second_in_view_is_refused():
    k = observe(plain_walk(TIME_S), TIME_S)
    confidence = np.where(np.arange(len(TIME_S)) < 25, 0.9, 0.0)[:, None].repeat(33, axis=1)
    with pytest.raises(PblError, match=r"0\.80 s") as error:
        fit_session([dataclasses.replace(k, confidence=confidence)], ["a"], quick(250))
    assert error.value.code == "FIT_INPUT"


def test_huber_is_quadratic_then_linear_with_finite_gradient_at_zero():
    e = jnp.array([0.0, 1.0, 5.0, 7.0])
    np.testing.assert_allclose(huber(e**2, 5.0), [0, 0.5, 12.5, 5 * (7 - 2.5)], rtol=1e-6)
    gradient = jax.grad(lambda x: huber(jnp.sum(x**2), 5.0))(jnp.zeros(3))
    np.testing.assert_array_equal(gradient, 0)


def test_projection_by_hand_and_bounded_behind_the_camera():
    K = jnp.asarray(CAMERA.matrix)
    np.testing.assert_allclose(project_px(jnp.array([[0.5, -0.25, 5.0]]), K), [[960 + 150, 540 - 75]], rtol=1e-6)
    x = jnp.array([[0.3, 0.1, -2.0], [0.1, 0.1, 0.0]])
    assert np.all(np.isfinite(project_px(x, K)))
    assert np.all(np.isfinite(jax.grad(lambda y: jnp.sum(project_px(y, K)))(x)))


def distance_3d_cm2(x: jax.Array, detected: jax.Array, c: jax.Array, weight: float | jax.Array = 1.0) -> jax.Array:
    """Squared distances of points in a camera's axes, with their mean over the seen markers removed."""
    return square(residual_3d_cm(x - offset_m(x, detected, mean_weights(c, weight * jnp.ones(c.shape))), detected))


def test_markers_without_weight_do_not_move_the_centre_of_the_others():
    c = jnp.ones(3)
    model = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.9]])
    detected = model.at[2, 2].add(0.3)  # one point is 30 cm off
    np.testing.assert_allclose(distance_3d_cm2(model, detected, c), [100, 100, 400], rtol=1e-4)
    weight = jnp.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(distance_3d_cm2(model, detected, c, weight), [0, 0, 900], rtol=1e-4)
    assert np.all(np.isfinite(distance_3d_cm2(model, detected, jnp.array([0.0, 0.0, 1.0]), weight)))  # none left


def test_pose_prior_by_hand():
    names = ["hip_rotation_r", "knee_angle_r", "hip_rotation_l", "pro_sup_r", "lumbar_bending"]
    prior = pose_prior(names, [("hip_rotation", 0, 10), ("pro_sup", 90, 30), ("lumbar_bending", 0, 5)])
    neutral, whitener, log_weight = (jnp.asarray(a, jnp.float32) for a in prior)
    np.testing.assert_allclose(np.rad2deg(neutral), [[0, 0, 0, 90, 0]])
    np.testing.assert_allclose(whitener[0] * np.deg2rad(1), np.diag([1 / 10, 0, 1 / 10, 1 / 30, 1 / 5]), atol=1e-7)
    # 2 sd, free, 1 sd, 1 sd, 0; the second frame is at the neutral pose.
    q = jnp.deg2rad(jnp.array([[20.0, 77, -10, 60, 0], [0, 0, 0, 90, 0]]))
    z = pose_z(q, neutral, whitener)
    np.testing.assert_allclose(z[:, 0], [[2, 0, -1, -1, 0], [0, 0, 0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(pose_cost(square(z), log_weight), [3, 0], atol=1e-6)


def test_a_learned_prior_is_the_density_of_its_mixture():
    names = load_body().joint_names
    neutral, whitener, log_weight = pose_prior(names, [("pro_sup", 90, 30)], "people")
    learned = learned_poses("people")
    index = [names.index(n) for n in learned["joints"]]
    rng = np.random.default_rng(4)
    pose = np.zeros((6, len(names)))
    pose[:, index] = rng.normal(0, 0.3, (6, len(index)))
    pose[:, [names.index(f"pro_sup_{s}") for s in "rl"]] = np.pi / 2
    z = pose_z(jnp.asarray(pose), jnp.asarray(neutral), jnp.asarray(whitener))
    cost = pose_cost(square(z), jnp.asarray(log_weight))
    density = sum(
        c["weight"] * multivariate_normal(c["mean_deg"], c["covariance_deg2"]).pdf(np.degrees(pose[:, index]))
        for c in learned["components"]
    )
    want = -np.log(density)
    np.testing.assert_allclose(cost - cost[0], want - want[0], rtol=1e-3, atol=1e-3)


def test_the_pelvis_of_the_prior_is_against_the_vertical_whichever_way_it_faces():
    for tilt, list_ in ((12.0, 0.0), (0.0, -5.0)):
        ahead = Rotation.from_euler("ZXY", [tilt, list_, 0.0], degrees=True)
        for turn in (0.0, 90.0, 180.0, -60.0):
            pelvis = (Rotation.from_euler("Y", turn, degrees=True) * ahead).as_euler("ZXY")
            np.testing.assert_allclose(np.degrees(inclination(jnp.asarray(pelvis))), [tilt, list_], atol=0.02)
    assert posture(jnp.zeros(7), jnp.zeros(0, jnp.int32)).shape == (7,)  # a body without these joints


@pytest.mark.parametrize(
    ("entries", "learned", "expected"),
    [
        ([("hip_rotatoin", 0, 10)], "", "a joint of the body"),
        ([("hip_rotation", 0, 0)], "", "a positive number"),
        ([], "nobody", "people"),
    ],
)
def test_a_pose_prior_of_nothing_is_refused(entries, learned, expected):
    with pytest.raises(PblError, match=learned or entries[0][0]) as error:
        pose_prior(["hip_rotation_r"], entries, learned)
    assert error.value.code == "FIT_INPUT"
    assert expected in error.value.expected


def test_scale_prior_by_hand_leaves_the_whole_body_free():
    # Overall, pelvis, left thigh, left leg, right thigh, right leg, left arm, right arm.
    s = np.array([0.3, 0.1, 0, 0, -0.05, 0, 0.2, 0.2])
    each, thighs = 1 + 0.25 + 4 + 4, (0.05 / 0.02) ** 2
    assert s @ scale_precision(SCALE_NAMES, 0.1, 0.02) @ s == pytest.approx(each + thighs, rel=1e-5)


def test_root_position_from_pixels():
    rng = np.random.default_rng(1)
    x = rng.normal(0, 0.4, (3, 10, 3))
    root = np.array([[0.2, 0.1, 5.0], [-1.0, 0.3, 8.0], [1.0, 0.0, 3.0]])
    uv = (x + root[:, None]) @ CAMERA.matrix.T
    c = np.ones((3, 10))
    c[2, 4:] = 0
    c[1, 3:] = 0
    found = root_positions(x, uv[..., :2] / uv[..., 2:], c, np.tile(CAMERA.matrix, (3, 1, 1)))
    np.testing.assert_allclose(found[[0, 2]], root[[0, 2]], atol=1e-7)
    assert np.all(np.isnan(found[1]))  # three points are not enough


def test_pose_and_its_inverse():
    body = load_body()
    bounds = *fit_ranges(body), body.is_slide
    q, knee = np.zeros(40), body.joint_names.index("knee_angle_r")
    q[:6], q[knee] = [3.0, -1.0, 0.5, 0.1, -0.2, 3.0], -1.0
    back = pose_of(jnp.asarray(raw_of(q, *bounds)), *map(jnp.asarray, bounds))
    np.testing.assert_allclose(back, q, atol=0.04)  # joints at the end of their range are first moved inside
    some = np.array([0, 1, 2, 3, 4, 5, knee])
    np.testing.assert_allclose(back[some], q[some], atol=1e-5)
    far = pose_of(jnp.full(40, 50.0), *map(jnp.asarray, bounds))
    assert float(far[knee]) == pytest.approx(body.joint_range_rad[knee, 1], abs=1e-5)
    np.testing.assert_array_equal(far[:3], 50.0)


def test_short_gaps_are_bridged_and_long_ones_are_not():
    time_s = np.arange(100) / 30
    seen = np.ones(100, bool)
    seen[10:30] = False  # 0.7 s
    seen[50:90] = False  # 1.4 s
    used = bridge_gaps(seen, time_s, 1.0)
    assert used[:50].all()
    assert not used[50:90].any()
    assert longest_run_s(used, time_s) == pytest.approx(49 / 30)


def test_person_cut_by_the_border_is_not_in_view():
    k = observe(plain_walk(TIME_S), TIME_S)
    xy = k.xy_px.copy()
    xy[5, 27:33] += [0, 2000.0]  # feet below the picture
    assert np.flatnonzero(~whole_person_in_view(dataclasses.replace(k, xy_px=xy), 0.3)).tolist() == [5]


def test_markers_that_the_detector_never_gives_do_not_hide_the_person():
    k = observe(plain_walk(TIME_S), TIME_S)
    c = k.confidence.copy()
    c[:, :6] = 0.0
    assert whole_person_in_view(dataclasses.replace(k, confidence=c), 0.3).all()
    c[:, :60] = 0.0
    assert not whole_person_in_view(dataclasses.replace(k, confidence=c), 0.3).any()


def test_where_nothing_was_seen_nothing_is_known():
    k = observe(plain_walk(TIME_S), TIME_S)
    confidence = k.confidence.copy()
    confidence[20:23] = 0  # 0.1 s: bridged
    confidence[40:62] = 0  # 0.7 s: left unknown
    confidence[65:70, :11] = 0  # the face alone
    xy = np.where(confidence[..., None] > 0, k.xy_px, np.nan)
    xyz = np.where(confidence[..., None] > 0, k.xyz_cam_m, np.nan)
    used = check_trial(dataclasses.replace(k, xy_px=xy, xyz_cam_m=xyz, confidence=confidence), "a").used
    assert np.flatnonzero(~used).tolist() == list(range(40, 62))


def test_convergence_is_judged_by_the_second_half_and_needs_a_trace():
    def outcome(loss):
        trace = np.column_stack([np.arange(len(loss)), loss])
        return _converged(SimpleNamespace(qpos_sd=None, loss_trace=trace)).outcome  # type: ignore[arg-type]

    assert outcome([9.0, 3.0, 1.5, 1.1, 1.05, 1.02, 1.01, 1.0]) == "PASS"
    assert outcome([9.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.2, 1.0]) == "WARN"
    assert outcome([1.0]) == "WARN"


def test_an_unmeasured_camera_is_told():
    k = observe(plain_walk(TIME_S), TIME_S)
    camera = dataclasses.replace(k.camera, source="estimated: by somebody")
    guessed = dataclasses.replace(k, camera=camera, assumed=("distortion",))
    # Two trials, as `two_trials` has: the program is compiled already.
    checks = {c.check: c for c in fit_session([guessed, k], ["a", "b"], quick(250)).qc}
    assert checks["camera_intrinsics_measured"].outcome == "WARN"
    assert "by somebody" in checks["camera_intrinsics_measured"].advice
    assert checks["keypoints_fields_assumed"].outcome == "WARN"
    assert "do not state distortion:" in checks["keypoints_fields_assumed"].advice
    assert checks["camera_orientation_known"].outcome == "WARN"


def test_lens_distortion_is_undone():
    camera = dataclasses.replace(CAMERA, distortion=np.array([-0.25, 0.08, 0.001, -0.0005, 0.0]))
    x = np.random.default_rng(3).uniform([-1.5, -0.8, 3.0], [1.5, 0.8, 5.0], (40, 3))
    seen = cv2.projectPoints(x, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0].reshape(1, 40, 2)
    straight = x @ camera.matrix.T
    np.testing.assert_allclose(undistort_px(seen, camera)[0], straight[:, :2] / straight[:, 2:], atol=0.01)
