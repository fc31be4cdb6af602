"""The synthetic walker: is it a normal walk, and is what is said of its noise, camera and clock true?"""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline.body import load_body, marker_positions, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import (
    LEVEL_R_NC,
    NO_NOISE,
    PHONE_SIZE_PX,
    Noise,
    PhoneSensor,
    pelvis_positions,
    true_markers,
)
from research.walker.observe import observe
from research.walker.views import observe_markers, observe_views
from research.walker.walk import person, walk_qpos
from tests import not_none

TIME_S = np.arange(300) / 30
FINE_S = np.arange(0, 4, 1 / 200)
JOINT = {n: i for i, n in enumerate(load_body().joint_names)}
SET = marker_set("bml_movi_87")


def column(qpos: np.ndarray, joint: str) -> np.ndarray:
    return np.rad2deg(qpos[:, JOINT[joint]])


# --- the walk


@pytest.mark.slow
def test_joints_stay_within_their_ranges_whatever_the_seed():
    low, high = load_body().joint_range_rad.T
    for seed in range(60):
        q = walk_qpos(TIME_S, seed)
        assert np.all(q > low), seed
        assert np.all(q < high), seed


def test_knees_bend_twice_in_a_stride_and_most_in_swing():
    peaks, first = [], []
    for seed in range(20):
        flexion = -column(walk_qpos(FINE_S, seed), "knee_angle_r")
        top = (flexion[1:-1] > flexion[:-2]) & (flexion[1:-1] >= flexion[2:])
        heights = flexion[1:-1][top]
        peaks.append(heights[heights > 40].mean())
        first.append(heights[heights < 40].mean())
    assert 60 < np.mean(peaks) < 65
    assert 15 < np.mean(first) < 25
    assert 2 < np.std(peaks) < 8


def test_the_standing_foot_stays_on_the_floor():
    """Hips, knees, ankles and travel belong together: neither height nor place of the standing foot changes much."""
    feet = [SET.names.index(n) for n in ("LHeel", "RHeel", "LBigToe", "RBigToe")]
    speeds, spreads = [], []
    for seed in range(10):
        q = walk_qpos(FINE_S, seed, path="straight")
        x = true_markers(q, SET)[:, feet]
        lowest = x[..., 2].argmin(axis=1)
        along = np.gradient(x, FINE_S, axis=0)[np.arange(len(x)), lowest, 0]
        travel = np.gradient(pelvis_positions(q)[:, 0], FINE_S)
        speeds.append(np.median(along / travel))
        spreads.append(np.std(x[..., 2].min(axis=1)))
    assert np.abs(np.median(speeds)) < 0.15
    assert np.median(spreads) < 0.02


def test_arms_swing_against_the_legs():
    q = walk_qpos(TIME_S, 3)
    assert np.corrcoef(column(q, "arm_flex_r"), column(q, "hip_flexion_r"))[0, 1] < -0.8
    assert np.corrcoef(column(q, "arm_flex_r"), column(q, "arm_flex_l"))[0, 1] < -0.8


def test_derivatives_are_continuous():
    """Third differences of a smooth curve shrink with the step: 1000 times for a step 10 times shorter."""
    for path in ("eight", "straight", "treadmill"):
        largest = []
        for step in (0.01, 0.001):
            time = np.arange(0, 4, step)
            largest.append(np.abs(np.diff(walk_qpos(time, 5, path=path), 3, axis=0)).max())
        assert largest[1] < largest[0] / 500, path


def test_strides_are_alike_but_not_the_same():
    stride = 1.1
    q = walk_qpos(TIME_S, 2, stride_s=stride)
    later = walk_qpos(TIME_S + stride, 2, stride_s=stride)
    difference = np.rad2deg(np.abs(later - q)[:, JOINT["hip_flexion_r"]])
    assert 0.3 < np.median(difference) < 4


def test_people_differ_and_a_seed_does_not():
    q = [walk_qpos(TIME_S, seed) for seed in (1, 1, 2)]
    assert np.array_equal(q[0], q[1])
    assert np.rad2deg(np.abs(q[0] - q[2])[:, 6:20]).mean() > 3
    # A function of time: every second frame of a faster camera.
    fast = walk_qpos(np.arange(599) / 60, 1)
    np.testing.assert_allclose(fast[::2], q[0], atol=1e-9)


def test_pelvis_angles_hold_against_the_heading():
    """In the walking direction the pelvis has the same course wherever the person goes."""
    for seed in range(6):
        q = walk_qpos(TIME_S, seed, path="eight")
        p = pelvis_positions(q)
        travel = np.arctan2(np.gradient(p[:, 1]), np.gradient(p[:, 0]))
        upright = Rotation.from_euler("x", 90, degrees=True)
        turned = Rotation.from_euler("ZXY", q[:, [JOINT[f"pelvis_{n}"] for n in ("tilt", "list", "rotation")]])
        world = upright * turned
        forward = world.apply([1.0, 0, 0])
        off = np.angle(np.exp(1j * (np.arctan2(forward[:, 1], forward[:, 0]) - travel)))
        # The pelvis turns by 4 deg (amplitude), and its way by 6 deg because it sways over the standing foot.
        assert np.rad2deg(np.std(off)) < 10
        assert abs(np.rad2deg(np.mean(off))) < 5
        pitch = np.rad2deg(np.arcsin(forward[:, 2]))
        assert -8 < pitch.mean() < 12  # the body's pelvis is level in walking: 2 deg, persons differ by 4
        assert pitch.std() < 3
        assert np.abs(np.diff(q[:, JOINT["pelvis_rotation"]])).max() < 0.3  # no jump by a turn


def test_a_long_walk_does_not_wind_up():
    q = walk_qpos(np.arange(0, 360, 1 / 30), 0, path="eight")
    assert np.abs(q[:, JOINT["pelvis_rotation"]]).max() < 2 * np.pi
    assert np.linalg.norm(pelvis_positions(q), axis=1).max() < 8


def test_impossible_walks_are_refused():
    with pytest.raises(PblError, match="straight"):
        walk_qpos(TIME_S, 0, path="straight", speed_m_per_s=1.3)
    with pytest.raises(PblError, match="spiral"):
        walk_qpos(TIME_S, 0, path="spiral")
    with pytest.raises(PblError, match="no_such"):
        observe(walk_qpos(TIME_S), TIME_S, never_seen=["no_such"])


# --- the person


def test_people_have_the_sizes_that_are_said():
    scale, offset = zip(*(person(seed) for seed in range(300)), strict=True)
    overall = np.array(scale)[:, 0] - 1
    own = np.array(scale)[:, 1:] - np.array(scale)[:, :1]
    assert np.std(overall) == pytest.approx(0.05, rel=0.15)
    assert np.std(own) == pytest.approx(0.05, rel=0.1)
    assert np.std(offset) == pytest.approx(0.006, rel=0.02)
    assert np.array_equal(person(3)[0], person(3)[0])


def test_true_markers_are_those_of_the_fit():
    q = walk_qpos(TIME_S[:64], 1)
    scale, offset = person(1)
    fit = marker_positions(load_body(), SET, q, scale, offset)
    np.testing.assert_allclose(true_markers(q, SET, scale, offset), fit, atol=2e-5)
    assert np.abs(true_markers(q, SET) - fit).max() > 0.02


# --- the camera


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["static", "handheld"])
def test_the_whole_person_is_in_the_picture_at_4_to_6_m(motion):
    for seed in range(30):
        q = walk_qpos(TIME_S, seed)
        scale, offset = person(seed)
        seen = observe(q, TIME_S, scale=scale, site_offset_m=offset, seed=seed, noise=NO_NOISE, camera_motion=motion)
        xy = seen.keypoints.xy_px
        assert np.all(xy > 0), seed
        assert np.all(xy < np.array(PHONE_SIZE_PX) - 1), seed
        assert 4 < np.linalg.norm(pelvis_positions(q), axis=1).mean() < 6


@pytest.mark.parametrize(("motion", "tilt"), [("static", (-6.0, 2.0)), ("handheld", (0.0, 0.0))])
def test_projecting_the_truth_gives_the_pixels(motion, tilt):
    q = walk_qpos(TIME_S, 4)
    seen = observe(q, TIME_S, noise=NO_NOISE, camera_motion=motion, tilt_deg=tilt, root_relative=False, seed=4)
    k = seen.keypoints
    np.testing.assert_allclose(np.einsum("tij,tkj->tki", seen.R_nc, k.xyz_cam_m), true_markers(q, SET), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(seen.R_nc), 1, atol=1e-9)
    for t in (0, 150, 299):
        rotation = cv2.Rodrigues(seen.R_nc[t].T)[0]
        xy = cv2.projectPoints(
            np.ascontiguousarray(seen.markers_world_m[t]), rotation, np.zeros(3), k.camera.matrix, None
        )[0][:, 0]
        np.testing.assert_allclose(k.xy_px[t], xy, atol=1e-6)
    if motion == "static":
        ahead = seen.R_nc[0, :, 2]
        assert np.rad2deg(np.arcsin(ahead[2])) == pytest.approx(-6, abs=1e-6)
        assert np.rad2deg(np.arcsin(seen.R_nc[0, 2, 0] / np.cos(np.deg2rad(6)))) == pytest.approx(-2, abs=0.02)
        assert np.ptp(seen.R_nc, axis=0).max() == 0


def test_a_level_static_camera_looks_along_x():
    assert np.allclose(observe(walk_qpos(TIME_S[:40]), TIME_S[:40]).R_nc, LEVEL_R_NC)


def test_a_held_phone_follows_with_a_smooth_tremor_of_a_few_degrees():
    time = np.arange(0, 10, 1 / 200)
    q = walk_qpos(time, 0, path="eight")
    R = observe(q, time, camera_motion="handheld", noise=NO_NOISE, seed=0).R_nc
    p = pelvis_positions(q)
    to_pelvis = np.einsum("tij,ti->tj", R, p)
    off = np.rad2deg(np.arctan2(np.linalg.norm(to_pelvis[:, :2], axis=1), to_pelvis[:, 2]))
    assert 0.5 < np.median(off) < 5
    assert off.max() < 12
    turn = np.rad2deg(Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude()) * 200
    assert 5 < np.median(turn) < 40  # deg/s: held, not swung
    jerk = np.abs(np.diff(R, 3, axis=0)).max() * 200**3
    assert jerk < 100  # rad/s^3; a jump of 0.1 deg would give 14,000


def test_the_phone_log_at_the_true_offset_is_the_camera():
    sensor = PhoneSensor(clock_offset_s=0.08)
    q = walk_qpos(TIME_S, 6, path="eight")
    seen = observe(q, TIME_S, camera_motion="handheld", sensor=sensor, seed=6)
    k = seen.keypoints
    assert seen.clock_offset_s == 0.08
    time_s, quaternion = not_none(k.phone_time_s), not_none(k.phone_quat_wxyz)
    assert np.allclose(np.diff(time_s), 0.01)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1)
    measured = Slerp(time_s, Rotation.from_quat(quaternion, scalar_first=True))
    truth = Rotation.from_matrix(seen.R_nc)

    def error_deg(offset_s: float) -> float:
        return float(np.rad2deg(np.sqrt(np.mean((measured(TIME_S + offset_s) * truth.inv()).magnitude() ** 2))))

    errors = {o: error_deg(o) for o in (-0.08, 0.0, 0.04, 0.08, 0.12, 0.16)}
    assert min(errors, key=lambda o: errors[o]) == 0.08
    assert 0.4 < errors[0.08] < 1.3  # 0.3 deg on three axes, and the drift
    assert errors[-0.08] > 1.5 * errors[0.08]


def test_the_log_errs_by_what_is_said():
    q, rms = walk_qpos(TIME_S, 0), []
    for seed in range(8):
        sensor = PhoneSensor(white_deg=0.3, drift_deg=0.0, clock_offset_s=0.0)
        seen = observe(q, TIME_S, with_phone=True, sensor=sensor, seed=seed, noise=NO_NOISE)
        off = Rotation.from_matrix(LEVEL_R_NC).inv() * Rotation.from_quat(
            seen.keypoints.phone_quat_wxyz, scalar_first=True
        )
        rms.append(np.rad2deg(off.as_rotvec()))
    assert np.std(rms) == pytest.approx(0.3, rel=0.03)


# --- the noise


def residuals(noise: Noise, fps: float = 30.0, seed: int = 0, seconds: float = 20.0):
    """Errors (T, J) across, along the line of sight and in the picture, and the keypoints."""
    time = np.arange(0, seconds, 1 / fps)
    q = walk_qpos(time, seed, path="eight")
    seen = observe(q, time, noise=noise, root_relative=False, seed=seed)
    x_cam = np.einsum("tji,tkj->tki", seen.R_nc, seen.markers_world_m)
    error = seen.keypoints.xyz_cam_m - x_cam
    ray = x_cam / np.linalg.norm(x_cam, axis=-1, keepdims=True)
    side = np.cross(ray, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    true_px = x_cam @ seen.keypoints.camera.matrix.T
    px = seen.keypoints.xy_px - true_px[..., :2] / true_px[..., 2:]
    return np.sum(error * side, -1), np.sum(error * ray, -1), px, seen


ONLY_FRAME = dataclasses.replace(NO_NOISE, across_m=0.008, along_m=0.025)


def test_noise_is_8_mm_across_and_25_mm_along_with_its_memory():
    across, along, px, _ = residuals(ONLY_FRAME)
    assert np.std(across) == pytest.approx(0.008, rel=0.05)
    assert np.std(along) == pytest.approx(0.025, rel=0.05)
    assert abs(np.corrcoef(across.ravel(), along.ravel())[0, 1]) < 0.05
    assert np.abs(px).max() < 1e-6
    for error in (across, along):
        assert np.corrcoef(error[:-1].ravel(), error[1:].ravel())[0, 1] == pytest.approx(0.9, abs=0.01)


def test_the_memory_is_kept_in_seconds_at_another_frame_rate():
    _, along, _, _ = residuals(ONLY_FRAME, fps=60.0)
    assert np.corrcoef(along[:-2].ravel(), along[2:].ravel())[0, 1] == pytest.approx(0.9, abs=0.015)
    assert np.corrcoef(along[:-1].ravel(), along[1:].ravel())[0, 1] == pytest.approx(0.9**0.5, abs=0.01)


def test_each_marker_has_an_error_of_10_mm_that_stays():
    constant = []
    for seed in range(12):
        _, _, _, seen = residuals(dataclasses.replace(NO_NOISE, constant_m=0.010), seed=seed, seconds=1.0)
        x_cam = np.einsum("tji,tkj->tki", seen.R_nc, seen.markers_world_m)
        error = seen.keypoints.xyz_cam_m - x_cam
        assert np.ptp(error, axis=0).max() < 1e-9
        constant.append(error[0])
    assert np.std(constant) == pytest.approx(0.010, rel=0.05)


def test_pixels_shares_and_confidence_are_as_said():
    _, along, px, seen = residuals(Noise())
    k = seen.keypoints
    lost = k.confidence == 0
    assert lost.mean() == pytest.approx(0.05, rel=0.1)
    assert np.array_equal(lost, np.isnan(k.xy_px[..., 0]))
    assert np.array_equal(lost, np.isnan(k.xyz_cam_m[..., 0]))
    found = ~lost
    off = found & seen.outlier
    assert off.sum() / found.sum() == pytest.approx(0.02, rel=0.15)
    assert np.std(px[found & ~off]) == pytest.approx(3.0, rel=0.03)
    length = np.linalg.norm(px[off], axis=-1)
    assert length.min() > 15
    assert 50 < np.median(length) < 70
    x_cam = np.einsum("tji,tkj->tki", seen.R_nc, seen.markers_world_m)
    length_m = np.linalg.norm((k.xyz_cam_m - x_cam)[off], axis=-1)
    assert 0.3 < np.median(length_m) < 0.5
    assert np.std(along[found & ~off]) == pytest.approx(np.hypot(0.025, 0.010), rel=0.05)
    # Nothing tells an outlier but where it lies.
    assert k.confidence[off].mean() == pytest.approx(k.confidence[found & ~off].mean(), abs=0.01)
    assert 0.88 < k.confidence[found].mean() < 0.92
    assert 0.02 < k.confidence[found].std() < 0.06


def test_shares_can_be_chosen():
    _, _, _, seen = residuals(Noise(outlier_share=0.3, drop_share=0.2))
    assert (seen.keypoints.confidence == 0).mean() == pytest.approx(0.2, rel=0.05)
    assert seen.outlier.sum() / (seen.keypoints.confidence > 0).sum() == pytest.approx(0.3, rel=0.05)


def test_static_and_handheld_see_the_same_walk_with_the_same_noise():
    q = walk_qpos(TIME_S, 8)
    a, b = (observe(q, TIME_S, camera_motion=m, seed=8) for m in ("static", "handheld"))
    assert np.array_equal(a.markers_world_m, b.markers_world_m)
    assert np.array_equal(a.outlier, b.outlier)
    assert np.array_equal(a.keypoints.confidence, b.keypoints.confidence)
    assert a.keypoints.phone_time_s is None
    assert b.keypoints.phone_time_s is not None


def test_same_seed_same_data_other_seed_other_noise():
    q = walk_qpos(TIME_S, 0)
    a, b, c = (observe(q, TIME_S, seed=s, camera_motion="handheld") for s in (0, 0, 1))
    for name in ("xy_px", "xyz_cam_m", "confidence", "phone_quat_wxyz"):
        assert np.array_equal(getattr(a.keypoints, name), getattr(b.keypoints, name), equal_nan=True), name
        assert not np.array_equal(getattr(a.keypoints, name), getattr(c.keypoints, name), equal_nan=True), name


def test_a_marker_never_seen_and_a_span_with_nothing_seen():
    q = walk_qpos(TIME_S, 0)
    k = observe(q, TIME_S, never_seen=["LHeel"], unseen_s=[(4.0, 5.0)]).keypoints
    heel = k.names.index("LHeel")
    assert np.all(k.confidence[:, heel] == 0)
    assert np.flatnonzero(k.confidence.max(axis=1) == 0).tolist() == list(range(120, 150))
    assert np.all(np.isnan(k.xyz_cam_m[120:150]))


def test_keypoints_survive_the_file(tmp_path):
    k = observe(walk_qpos(TIME_S), TIME_S, camera_motion="handheld").keypoints
    k.save(tmp_path / "k.npz")
    back = Keypoints.load(tmp_path / "k.npz")
    np.testing.assert_allclose(back.xyz_cam_m, k.xyz_cam_m, atol=1e-6)
    np.testing.assert_allclose(not_none(back.phone_quat_wxyz), not_none(k.phone_quat_wxyz))


# --- several cameras, laboratory markers


@pytest.mark.parametrize("with_3d", [False, True])
def test_views_project_the_truth(with_3d):
    q = walk_qpos(TIME_S, 3)
    seen = observe_views(q, TIME_S, noise=NO_NOISE, with_3d=with_3d)
    truth = true_markers(q, SET)
    assert len(seen.views) == len(seen.poses) == 4
    for k, pose in zip(seen.views, seen.poses, strict=True):
        R_cn = np.asarray(pose.R_nc).T
        rotation, shift = cv2.Rodrigues(R_cn)[0], -R_cn @ pose.p_nc
        for t in (0, 299):
            xy = cv2.projectPoints(
                np.ascontiguousarray(truth[t]), rotation, shift, k.camera.matrix, k.camera.distortion
            )[0][:, 0]
            np.testing.assert_allclose(k.xy_px[t], xy, atol=1e-6)
            in_picture = (xy > 0).all() and (xy < np.array(k.image_size_px) - 1).all()
            assert in_picture
        assert np.isnan(k.xyz_cam_m).all() != with_3d
    ahead = np.array([p.R_nc[:, 2] for p in seen.poses])
    assert np.linalg.matrix_rank(ahead, tol=0.3) >= 2


def test_laboratory_markers_are_the_truth_and_a_millimetre():
    q = walk_qpos(TIME_S, 3)
    scale, offset = person(3)
    seen = observe_markers(q, TIME_S, scale=scale, site_offset_m=offset, noise_m=0.001, drop_share=0.1)
    error = seen.xyz_world_m - true_markers(q, SET, scale, offset)
    lost = seen.confidence == 0
    assert lost.mean() == pytest.approx(0.1, rel=0.1)
    assert np.array_equal(lost, np.isnan(error[..., 0]))
    assert np.nanstd(error) == pytest.approx(0.001, rel=0.02)
