"""Crops, the virtual camera of a crop, and the two-pass run, against synthetic geometry."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pbl_pipeline.keypoints import (
    KeypointDetector,
    KeypointParams,
    Keypoints,
    PersonKeypoints,
    PictureMeter,
    check_keypoints,
    detect_keypoints,
    side_changes,
    view_rotation,
)
from pbl_pipeline.keypoints.blazepose import MIRROR, NAMES
from pbl_pipeline.keypoints.crops import Regions, corrected, sampled_rows, smooth_at, smooth_rois
from pbl_pipeline.keypoints.detect import _detect_all
from pbl_pipeline.keypoints.mirrored_inference import MirroredInference
from pbl_pipeline.keypoints.virtual_camera import crop_matrix
from pbl_pipeline.tracking import PersonTrack, Tracking, body_box
from pbl_pipeline.video import Camera, read_frames, viewing_ray
from tests import refused
from tests.videos import constant_rate, write_as_they_are

CAMERA = Camera(np.array([[1300.0, 0, 960], [0, 1300.0, 540], [0, 0, 1]]), np.zeros(5), "test")
#: Of pictures of 200 x 100.
SMALL = Camera(np.array([[1300.0, 0, 100], [0, 1300.0, 50], [0, 0, 1]]), np.zeros(5), "test")
LENS = Camera(CAMERA.matrix, np.array([-0.2, 0.05, 0.001, -0.002, 0.0]), "test with distortion")


# --- names ------------------------------------------------------------------------------------------------------


def test_the_mirror_swaps_left_and_right_and_nothing_else():
    assert len(NAMES) == 33
    assert MIRROR[MIRROR].tolist() == list(range(33))
    for name, other in zip(NAMES, np.array(NAMES)[MIRROR], strict=True):
        assert {name.count("left"), other.count("right")} in ({0}, {1})
    assert NAMES[MIRROR[NAMES.index("left_heel")]] == "right_heel"
    assert NAMES[MIRROR[0]] == "nose"


# --- geometry ---------------------------------------------------------------------------------------------------


def test_crop_matrix_by_hand():
    upright = crop_matrix(np.array([100.0, 200.0, 64.0, 0.0]), 256)
    np.testing.assert_allclose(upright @ [128, 128, 1], [100, 200])
    np.testing.assert_allclose(upright @ [0, 0, 1], [68, 168])
    # Turned clockwise by 90 degrees, the top of the crop lies to the right.
    lying = crop_matrix(np.array([100.0, 200.0, 64.0, np.pi / 2]), 256)
    np.testing.assert_allclose(lying @ [128, 0, 1], [132, 200], atol=1e-9)


def test_view_rotation_at_the_principal_point_is_the_roll():
    turn = 0.3
    rotation = view_rotation(np.array([960.0, 540.0, 400.0, turn]), CAMERA)
    np.testing.assert_allclose(rotation, Rotation.from_euler("z", turn).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("camera", [CAMERA, LENS])
def test_view_rotation_looks_along_the_ray_and_keeps_the_crops_down(camera):
    roi = np.array([1700.0, 300.0, 400.0, 0.4])
    rotation = view_rotation(roi, camera)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    ray = viewing_ray(roi[:2], camera)[0]
    np.testing.assert_allclose(rotation[:, 2], ray / np.linalg.norm(ray), atol=1e-12)
    # A point a little down in the virtual camera appears below the centre in the crop's own down direction.
    import cv2

    below = ray / np.linalg.norm(ray) + 1e-4 * rotation[:, 1]
    pixel, _ = cv2.projectPoints(below[None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    direction = pixel.ravel() - roi[:2]
    np.testing.assert_allclose(direction / np.linalg.norm(direction), [-np.sin(0.4), np.cos(0.4)], atol=2e-3)


@pytest.mark.parametrize("centre_m", [(0.0, 0.0, 5.0), (2.4, 0.3, 5.0), (-2.4, -0.8, 5.0)])
def test_what_a_crop_shows_is_turned_by_the_viewing_ray(centre_m):
    """An independent stand-in for the network: it knows the body's shape, sees the crop alone, and finds the pose
    that explains the crop as a parallel projection. Turned by `view_rotation` that pose must be the true one."""
    rng = np.random.default_rng(3)
    shape = rng.normal(0, [0.2, 0.5, 0.15], (33, 3))
    truth = Rotation.from_euler("yxz", [0.6, 0.1, -0.05])
    points = truth.apply(shape) + centre_m
    pixels = points[:, :2] / points[:, 2:] * 1300 + [960, 540]
    roi = np.array([*(np.array(centre_m[:2]) / centre_m[2] * 1300 + [960, 540]), 520.0, 0.15])
    to_picture = crop_matrix(roi, 256)
    seen = np.linalg.solve(to_picture[:, :2], (pixels - to_picture[:, 2]).T).T

    def misfit(p):
        return (np.exp(p[3]) * Rotation.from_rotvec(p[:3]).apply(shape)[:, :2] + p[4:] - seen).ravel()

    solution = least_squares(misfit, [0, 0.5, 0, np.log(100), 128, 128])
    in_crop = Rotation.from_rotvec(solution.x[:3])
    in_camera = Rotation.from_matrix(view_rotation(roi, CAMERA)) * in_crop
    assert np.degrees((in_camera * truth.inv()).magnitude()) < 4.0
    if centre_m[0] != 0:
        rolled_only = Rotation.from_euler("z", 0.15) * in_crop
        assert np.degrees((rolled_only * truth.inv()).magnitude()) > 15.0


# --- crops over time --------------------------------------------------------------------------------------------


def test_smoothing_keeps_steady_movement_and_calms_jitter():
    time = np.arange(60) / 30
    steady = np.stack([100 + 50 * time, 200 - 10 * time, np.full(60, 300.0), 0.2 + 0 * time], axis=1)
    np.testing.assert_allclose(smooth_rois(steady, time, 0.1), steady, rtol=1e-6)
    noise = np.random.default_rng(0).normal(0, 5, (60, 2))
    shaken = steady.copy()
    shaken[:, :2] += noise
    left = smooth_rois(shaken, time, 0.1)[:, :2] - steady[:, :2]
    assert left.std() < 0.5 * noise.std()


def test_smoothing_leaves_gaps_and_turns_through_half_a_circle():
    time = np.arange(20) / 30
    roi = np.tile([100.0, 100, 50, np.pi], (20, 1))
    roi[::2, 3] = -np.pi
    roi[5:8] = np.nan
    smooth = smooth_rois(roi, time, 0.1)
    assert np.isnan(smooth[5:8]).all()
    np.testing.assert_allclose(np.abs(smooth[np.r_[:5, 8:20], 3]), np.pi, atol=1e-6)


def test_crops_do_not_depend_on_rounding_elsewhere() -> None:
    """An earlier stage computed on another device differs by some 1e-4 px; the answer to such a crop by pixels."""
    time = np.arange(60) / 30.0
    track = np.column_stack([100 + 50 * time, 400 - 7 * time, 300 + 3 * time, 0.02 * time])
    other = track + np.random.default_rng(0).choice([-1e-4, 1e-4], track.shape) * [1, 1, 1, 1e-3]
    exact, stepped = (KeypointParams(passes=1, crop_step_px=step) for step in (0.0, 0.25))
    regions = [
        np.array([Regions(t, time, p).at(i) for i in range(60)]) for p in (exact, stepped) for t in (track, other)
    ]
    assert not np.any(np.all(regions[0] == regions[1], axis=1))
    assert np.mean(np.all(regions[2] == regions[3], axis=1)) > 0.95
    assert np.abs(regions[2] - track)[:, :3].max() <= 0.125


def test_sampled_rows_are_spread_evenly_and_begin_and_end_each_run():
    time = np.arange(60) / 30
    rows = np.concatenate([np.arange(0, 20), np.arange(31, 60)])
    np.testing.assert_array_equal(
        sampled_rows(rows, time, 0.1), [0, 3, 6, 9, 12, 15, 18, 19, 31, 34, 37, 40, 43, 46, 49, 52, 55, 58, 59]
    )
    np.testing.assert_array_equal(sampled_rows(rows, time, 0.0), rows)
    np.testing.assert_array_equal(sampled_rows(rows[:1], time, 0.1), rows[:1])


@pytest.mark.parametrize(("rate_hz", "every"), [(24.0, 1), (30.0, 1), (60.0, 2), (120.0, 4), (240.0, 8)])
def test_frames_are_left_out_by_their_stamps(rate_hz: float, every: int) -> None:
    """At 30 Hz, also where a phone's stamps jitter by a fifth of a frame, and where it loses some frames."""
    rng, n = np.random.default_rng(0), 8 * every * 12 + 1
    for jitter in (0.0, 0.2):
        time = (np.arange(n) + rng.uniform(-jitter, jitter, n) * (np.arange(n) % every > 0)) / rate_hz
        np.testing.assert_array_equal(sampled_rows(np.arange(n), time, 1 / 30), np.arange(0, n, every))
        kept = np.delete(time, slice(20, 20 + every * 3))
        used = kept[sampled_rows(np.arange(len(kept)), kept, 1 / 30)]
        assert np.diff(used).max() <= np.diff(kept).max() + 1 / 30
        assert {kept[19], kept[20]} <= set(used)  # a gap is as long as it was


def test_the_track_wins_where_the_first_pass_contradicts_it():
    roi = np.array([500.0, 500.0, 400.0, 0.0])

    def seen(x, side, presence=1.0):
        empty = np.zeros((1, 2)), np.zeros((1, 3)), np.zeros(1)
        return PersonKeypoints(*empty, presence, np.array([x, 500.0, side, 0.1]))

    found = [seen(520, 420), seen(700, 400), seen(500, 700), seen(520, 420, presence=0.2)]
    better = [corrected(roi, one, min_presence=0.5, max_drift=0.3, max_growth=1.5) for one in found]
    np.testing.assert_allclose(better[0], [520, 500, 420, 0.1])
    np.testing.assert_allclose(better[1:], np.tile(roi, (3, 1)))


# --- a whole video ----------------------------------------------------------------------------------------------


class Cross:
    """A detector with three points: the region's centre, and two at its sides; nobody where the picture is dark."""

    name, model_sha256, marker_set, root_relative = "cross", "0" * 64, "test", True
    names: tuple[str, ...] = ("middle", "left", "right")

    def __init__(self):
        self.calls: list[bool] = []

    def detect(self, image, roi_px, camera, *, quick=False):
        self.calls.append(quick)
        x, y, side, _ = roi_px
        xy = np.array([[x, y], [x - side, y], [x + side, y]])
        return PersonKeypoints(
            xy, np.ones((3, 3)), np.full(3, 0.9), float(image.mean() > 50), roi_px + np.eye(4)[0] * 2
        )


@pytest.fixture
def case(tmp_path):
    """90 frames at 30 fps, 200x100; the person in frames 10..69 but 30..34; frames 50..54 are dark."""
    frames = [np.full((100, 200, 3), 0 if 50 <= i < 55 else 128, np.uint8) for i in range(90)]
    video = write_as_they_are(tmp_path / "v.avi", frames)
    roi = np.full((90, 4), np.nan)
    roi[10:70] = [60.0, 50.0, 70.0, 0.0]
    roi[30:35] = np.nan
    seen = np.isfinite(roi[:, 0])
    person = PersonTrack(1, body_box(roi), roi, seen.astype(float), seen)
    return video, Tracking(constant_rate(90), (200, 100), (person,), "test", "")


def test_two_passes_and_missing_values(case, tmp_path):
    video, tracking = case
    detector = Cross()
    keypoints = detect_keypoints(video, tracking, 1, SMALL, detector=detector)
    # Once in 0.1 s, and at the ends of both runs: frames 10..29 and 35..69.
    assert (detector.calls.count(True), detector.calls.count(False)) == (8 + 13, 55)
    there = np.zeros(90, bool)
    there[10:70] = True
    there[30:35] = there[50:55] = False
    assert np.array_equal(np.isfinite(keypoints.xy_px[:, 0, 0]), there)
    assert np.array_equal(keypoints.confidence[:, 0] > 0, there)
    # The first pass moved the crop by 2 px; around the dark frames the track's crop has a share.
    np.testing.assert_allclose(keypoints.xy_px[there, 0, 0], 62, atol=1.5)
    np.testing.assert_allclose(keypoints.xy_px[12, 0], [62, 50], atol=1e-3)
    # What lies beyond the picture was not seen.
    assert np.isnan(keypoints.xy_px[:, 1]).all()
    assert np.isnan(keypoints.xyz_cam_m[:, 1]).all()
    assert (keypoints.confidence[:, 1] == 0).all()
    np.testing.assert_allclose(keypoints.box_px[12], [0, 50, 146, 50], atol=1e-3)
    assert np.isnan(keypoints.box_px[~there]).all()
    keypoints.save(tmp_path / "k.npz")
    again = Keypoints.load(tmp_path / "k.npz")
    np.testing.assert_array_equal(again.xy_px, keypoints.xy_px)
    assert again.names == ("middle", "left", "right")


def test_a_method_leaves_frames_out(case, tmp_path):
    """Keypoints and their checks are those of a recording with the used frames alone."""
    video, tracking = case
    detector, params = Cross(), KeypointParams(passes=1, interval_s=1 / 15, sides=None)
    keypoints = detect_keypoints(video, tracking, 1, SMALL, params, detector)
    number = [*range(0, 90, 2), 89]
    assert keypoints.frame is not None
    assert keypoints.frame.tolist() == number
    assert len(detector.calls) == len([i for i in number if 10 <= i < 70 and not 30 <= i < 35])
    every = detect_keypoints(video, tracking, 1, SMALL, KeypointParams(passes=1, sides=None), Cross())
    assert every.frame is None
    for name in ("time_s", "xy_px", "xyz_cam_m", "confidence", "box_px"):
        np.testing.assert_array_equal(getattr(keypoints, name), getattr(every, name)[number])
    rate = {c.check: c.value for c in check_keypoints(keypoints)}
    assert rate["frame_rate_hz"] == pytest.approx(15, rel=0.05)
    keypoints.save(tmp_path / "k.npz")
    again = Keypoints.load(tmp_path / "k.npz")
    assert again.frame is not None
    assert again.frame.tolist() == number
    for wrong in ([*number[:-1], number[-2]], [-1, *number[1:]]):
        refused("FILE_FORMAT", dataclasses.replace, keypoints, frame=np.array(wrong))
    refused("FILE_FORMAT", dataclasses.replace, keypoints, frame=np.arange(3))


def test_of_the_used_frames_every_second_is_mirrored(case):
    video, tracking = case
    shared: list[np.ndarray] = []

    class Records(MirroredInference):
        def shared(self, found, mirrored, time_s, min_presence):
            assert len(found) == len(mirrored) == len(time_s)
            shared.append(mirrored)
            return list(found)

    class Mirrors(Cross):
        mirrored_inference = Records(Cross.names, 100.0, 20.0)

        def crop_of(self, roi_px):
            return np.eye(2, 3), (8, 8)

        def detect_crop(self, crop, roi_px, camera, *, quick=False):
            return self.detect(crop, roi_px, camera, quick=quick)

        def detect_once(self, crop, roi_px, camera, *, mirrored=False):
            return self.detect(crop, roi_px, camera)

    for interval_s, n in ((0.0, 90), (1 / 15, 46)):
        params = KeypointParams(passes=1, interval_s=interval_s, share_looks_s=0.07, sides=None)
        keypoints = detect_keypoints(video, tracking, 1, SMALL, params, Mirrors())
        assert len(keypoints.time_s) == n
        np.testing.assert_array_equal(shared.pop(), np.arange(n) % 2 == 1)
        assert not shared


def test_one_reading_sees_what_two_readings_of_the_video_see(case):
    """The plain way: the whole first pass, all crops, the whole second pass. Detectors in threads change nothing."""
    video, tracking = case
    params = KeypointParams(first_look_s=0.05)
    images = {frame.index: frame.image for frame in read_frames(video)}
    time, roi = tracking.time_s, smooth_rois(tracking.persons[0].roi_px, tracking.time_s, params.smooth_s)
    rows = np.flatnonzero(np.isfinite(roi[:, 0]))
    better = np.full_like(roi, np.nan)
    limits = params.min_presence, params.max_drift, params.max_growth
    for row in sampled_rows(rows, time, params.first_look_s):
        better[row] = corrected(roi[row], Cross().detect(images[row], roi[row], CAMERA), *limits)
    known = np.flatnonzero(np.isfinite(better[:, 0]))
    plain = {row: smooth_at(better[known], time[known], time[row], params.smooth_s) for row in rows}

    for n_detectors in (1, 3):
        detectors: list[KeypointDetector] = [Cross() for _ in range(n_detectors)]
        found = _detect_all(detectors, video, roi, np.arange(len(roi)), time, CAMERA, params, PictureMeter())
        assert [row for row, person in enumerate(found) if person is not None] == rows.tolist()
        for row in rows:
            person = found[row]
            assert person is not None
            np.testing.assert_array_equal(person.xy_px[0], plain[row][:2])


def test_an_error_in_a_thread_is_raised(case):
    video, tracking = case

    class Broken(Cross):
        def detect(self, image, roi_px, camera, *, quick=False):
            if len(self.calls) == 9:
                raise ValueError("broken")
            return super().detect(image, roi_px, camera, quick=quick)

    with pytest.raises(ValueError, match="broken"):
        detect_keypoints(video, tracking, 1, SMALL, detector=Broken())


def test_one_pass(case):
    video, tracking = case
    detector = Cross()
    keypoints = detect_keypoints(video, tracking, 1, SMALL, KeypointParams(passes=1), detector)
    assert detector.calls == [False] * 55
    np.testing.assert_allclose(keypoints.xy_px[12, 0], [60, 50], atol=1e-3)


def test_under_a_second_in_view_is_too_short(case):
    video, tracking = case
    roi = tracking.persons[0].roi_px.copy()
    roi[25:] = np.nan
    short = PersonTrack(1, body_box(roi), roi, np.zeros(90), np.isfinite(roi[:, 0]))
    found = Tracking(tracking.time_s, (200, 100), (short,), "test", "")
    error = refused("TRACK_TOO_SHORT", detect_keypoints, video, found, 1, CAMERA, None, Cross())
    assert error.found == "person 1 is in view for 0.50 s"


def test_a_clip_under_a_second_is_named_as_one(case):
    video, tracking = case
    person = tracking.persons[0]
    first = slice(0, 30)
    short = PersonTrack(1, *(getattr(person, f)[first] for f in ("box_px", "roi_px", "score", "observed")))
    clip = Tracking(tracking.time_s[first], (200, 100), (short,), "test", "")
    lasts = tracking.time_s[29] - tracking.time_s[0]
    assert lasts < 1.0
    error = refused("TRACK_TOO_SHORT", detect_keypoints, video, clip, 1, CAMERA, None, Cross())
    assert error.found == f"the whole video lasts {lasts:.2f} s"


def test_unknown_person_detector_and_changed_video(case, tmp_path):
    video, tracking = case
    refused("SUBJECT_UNKNOWN_PERSON", detect_keypoints, video, tracking, 7, CAMERA, None, Cross())
    refused("SOLVER_UNKNOWN", detect_keypoints, video, tracking, 1, SMALL, KeypointParams(detector="none"))
    shorter = write_as_they_are(tmp_path / "s.avi", [np.full((100, 200, 3), 128, np.uint8)] * 40)
    refused("VIDEO_CHANGED", detect_keypoints, shorter, tracking, 1, CAMERA, None, Cross())


# --- quality ----------------------------------------------------------------------------------------------------


def standing(n: int = 120) -> Keypoints:
    """Two hips that turn slowly by half a circle."""
    angle = np.linspace(0, np.pi, n)
    right = 0.1 * np.stack([np.cos(angle), np.zeros(n), np.sin(angle)], axis=-1)
    xyz = np.stack([-right, right], axis=1)
    size = (n, 2, 2), (n, 2), (n, 4)
    shape = [np.zeros(size[0]), np.full(size[1], 0.9), np.zeros(size[2])]
    names = ("left_hip", "right_hip")
    return Keypoints(constant_rate(n), names, "t", shape[0], xyz, True, shape[1], (200, 100), SMALL, shape[2])


def test_turning_round_is_no_change_of_sides_but_an_exchange_is():
    keypoints = standing()
    assert side_changes(keypoints).tolist() == []
    assert {c.outcome for c in check_keypoints(keypoints)} == {"PASS"}
    xyz = keypoints.xyz_cam_m
    xyz[40:60] = xyz[40:60, ::-1]
    # Missing for a while: what happened meanwhile is not known.
    xyz[80:100] = np.nan
    xyz[100:] = xyz[100:, ::-1]
    assert side_changes(keypoints).tolist() == [40, 60]
    check = {c.check: c for c in check_keypoints(keypoints)}["side_changes"]
    assert (check.outcome, check.value) == ("WARN", 2.0)
    assert check.advice


def test_checks_without_any_frame():
    keypoints = standing()
    keypoints.confidence[:] = 0
    assert [c.outcome for c in check_keypoints(keypoints)] == ["EMPTY"]
