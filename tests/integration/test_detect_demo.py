"""`pbl detect` on the demo recording and on bad input. Needs the assets; skips where they cannot be had."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from pbl_pipeline import assets
from pbl_pipeline.cli.detect import detect
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import KeypointParams, Keypoints, check_keypoints, detect_keypoints
from pbl_pipeline.tracking import PersonTrack, Tracking, TrackingParams, WatchParams, choose_subject, track_people
from pbl_pipeline.video import guess_camera, load_camera, read_frames
from tests import not_none
from tests.end_to_end import clips
from tests.unit.test_blazepose import BY_EYE, asset
from tests.videos import constant_rate, write_as_they_are, write_video

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("points_seen_once")]

SIZE = (1768, 994)


@pytest.fixture(scope="module")
def demo() -> Path:
    for name in ("blazepose_detector", "blazepose_landmarks_heavy", "demo_camera"):
        asset(name)
    return asset("demo_video")


@pytest.fixture(scope="module")
def tracking(demo) -> Tracking:
    return track_people(demo)


@pytest.fixture(scope="module")
def keypoints(demo, tracking) -> Keypoints:
    camera = load_camera(assets.fetch("demo_camera"), SIZE)
    return detect_keypoints(demo, tracking, not_none(choose_subject(tracking).person_id), camera)


def run(*args: object):
    return CliRunner().invoke(detect, [str(a) for a in args])


def code_of(result) -> str:
    assert isinstance(result.exception, PblError), result.output
    return result.exception.code


def hips_at(tracking: Tracking, frame: int) -> dict[int, np.ndarray]:
    return {p.person_id: p.roi_px[frame, :2] for p in tracking.persons if np.isfinite(p.roi_px[frame, 0])}


#: Middle of her hips by eye: frame, x, y (px).
HER_WAY = ((45, 1525, 750), (75, 1266, 740), (105, 959, 715), (135, 680, 715), (165, 370, 712), (180, 200, 730))


def test_both_people_are_tracked_and_she_is_one_person(tracking):
    # By eye: she walks from x = 1525 in frame 45 to x = 199 in frame 180; he stands on the wall, at x = 640 in
    # frame 60; from about frame 195 on he has landed on the lawn, at x = 1250 in frame 210.
    ids = {
        next(k for k, xy in hips_at(tracking, f).items() if np.hypot(xy[0] - x, xy[1] - y) < 60) for f, x, y in HER_WAY
    }
    assert len(ids) == 1
    man = {k for k, xy in hips_at(tracking, 60).items() if np.hypot(xy[0] - 635, xy[1] - 270) < 60}
    landed = {k for k, xy in hips_at(tracking, 210).items() if np.hypot(xy[0] - 1250, xy[1] - 740) < 80}
    assert man
    assert landed
    assert not ids & (man | landed)


def test_she_is_one_person_from_her_first_to_her_last_frame_in_view(tracking):
    """She comes from behind a tree, wholly in the picture from frame 43 on, and until 185 before she leaves it."""
    her = choose_subject(tracking).person_id
    (track,) = (p for p in tracking.persons if p.person_id == her)
    seen = np.flatnonzero(np.isfinite(track.box_px[:, 0]))
    assert seen[0] <= 43
    assert seen[-1] >= 185
    assert len(seen) == seen[-1] - seen[0] + 1
    frames = np.arange(45, 181)
    x, y = (np.interp(frames, [w[0] for w in HER_WAY], [w[k] for w in HER_WAY]) for k in (1, 2))
    apart = np.hypot(track.roi_px[frames, 0] - x, track.roi_px[frames, 1] - y)
    assert apart.max() < 60
    # Nobody else is ever where she is.
    for other in tracking.persons:
        if other.person_id != her:
            away = np.hypot(other.roi_px[frames, 0] - x, other.roi_px[frames, 1] - y)
            assert not (away < 150).any()


@pytest.mark.long
def test_landmarks_are_on_her_in_98_percent_of_these_frames(keypoints):
    frames = np.arange(43, 186)
    x, y = (np.interp(frames, [w[0] for w in HER_WAY], [w[k] for w in HER_WAY]) for k in (1, 2))
    hips = np.mean([keypoints.xy_px[frames, keypoints.names.index(f"{s}_hip")] for s in ("left", "right")], axis=0)
    assert (np.hypot(hips[:, 0] - x, hips[:, 1] - y) < 60).mean() >= 0.98


@pytest.mark.long
def test_looking_where_it_is_needed_is_as_good_as_looking_in_every_frame(demo, tracking, tmp_path):
    """Body circles of the walker, against the whole frame and all tiles searched in each of 40 frames."""
    everywhere = WatchParams(
        follow_interval_s=0.0, rest_interval_s=0.0, close_interval_s=0.0, search_interval_s=0.0, search_windows=99
    )
    frames = slice(80, 120)
    part = write_video(
        tmp_path / "part.mkv",
        (f.image for f in read_frames(demo, start=80, stop=120)),
        constant_rate(40),
        codec="ffv1",
        pixel_format="bgr0",
    )
    dense = track_people(part, TrackingParams(watch=everywhere))
    her = choose_subject(tracking).person_id
    (sparse,) = (p.roi_px[frames] for p in tracking.persons if p.person_id == her)
    (throughout,) = (p.roi_px for p in dense.persons if np.hypot(*(p.roi_px[25, :2] - (959, 715))) < 60)
    apart = np.hypot(*(sparse[:, :2] - throughout[:, :2]).T) / throughout[:, 2]
    assert np.median(apart) < 0.03
    assert np.percentile(apart, 95) < 0.08
    assert abs(np.median(np.log(sparse[:, 2] / throughout[:, 2]))) < 0.08


def test_the_walker_is_chosen_with_a_reason(tracking):
    choice = choose_subject(tracking)
    assert choice.status == "CHOSEN"
    assert abs(hips_at(tracking, 105)[not_none(choice.person_id)][0] - 959) < 60
    assert choice.score - choice.runner_up_score > 0.15
    assert "walks" in choice.reason


def test_keypoints_lie_where_a_human_sees_them(keypoints):
    names = keypoints.names
    for frame, (side, front, rear) in BY_EYE.items():
        other = "left" if side == "right" else "right"
        for point, truth in ((f"{side}_ankle", front), (f"{other}_ankle", rear)):
            assert np.hypot(*(keypoints.xy_px[frame, names.index(point)] - truth)) < 25, (frame, point)


def test_feet_alternate_as_she_walks(keypoints):
    """Right and left foot in front by turns. In these frames of double support the leading leg was told by eye from the
    near (left) arm, which swings against its leg: right 60, left 79, right 98, left 116, right 134, left 152,
    right 171, left 187."""
    names = keypoints.names
    # She walks towards small x.
    lead = keypoints.xy_px[:, names.index("left_ankle"), 0] - keypoints.xy_px[:, names.index("right_ankle"), 0]
    for frame, sign in [(60, 1), (79, -1), (98, 1), (116, -1), (134, 1), (152, -1), (171, 1), (187, -1)]:
        assert sign * lead[frame] > 100, frame


def test_the_keypoints_pass_their_checks(keypoints):
    """A clean recording: nothing to say against it, but that the legs were mixed up for some frames."""
    checks = {c.check: c.outcome for c in check_keypoints(keypoints)}
    assert {check for check, outcome in checks.items() if outcome != "PASS"} <= {"sides_exchanged_share"}, checks
    assert {"whole_person_s", "feet_cut_share", "picture_brightness", "picture_detail_share"} <= set(checks)
    assert {"leg_confidence", "leg_points_right_share", "side_changes"} <= set(checks)


@pytest.mark.parametrize(
    ("change", "check"),
    [
        (lambda image: (image * 0.05).astype(np.uint8), "picture_brightness"),
        (lambda image: cv2.blur(image, (61, 1)), "picture_detail_share"),
        (lambda image: cv2.resize(image, None, fx=0.16, fy=0.16, interpolation=cv2.INTER_AREA), "body_height_px"),
    ],
)
def test_a_recording_made_worse_is_told(demo, tracking, tmp_path, change, check):
    """35 frames in which she is in full view, made dark, blurred by movement, or filmed from far away."""
    frames = [change(f.image) for f in read_frames(demo, start=80, stop=115)]
    video = write_as_they_are(tmp_path / "w.avi", frames)
    scale = frames[0].shape[1] / SIZE[0]
    track = next(p for p in tracking.persons if p.person_id == choose_subject(tracking).person_id)
    roi = track.roi_px[80:115] * np.array([scale, scale, scale, 1.0])
    person = PersonTrack(1, track.box_px[80:115] * scale, roi, track.score[80:115], track.observed[80:115])
    size = (frames[0].shape[1], frames[0].shape[0])
    worse = Tracking(constant_rate(35), size, (person,), "test", "")
    found = detect_keypoints(video, worse, 1, guess_camera(size), KeypointParams(passes=1))
    bad = {c.check: c for c in check_keypoints(found)}[check]
    assert bad.outcome in ("WARN", "FAIL")
    assert bad.advice


def test_her_heading_does_not_turn_with_the_viewing_angle(keypoints):
    """She walks straight on, through 28 degrees of viewing angle. Without the turn by the viewing ray the axis through
    her hips turns with it (slope 0.8)."""
    seen = slice(60, 187)
    hips = (
        keypoints.xyz_cam_m[seen, keypoints.names.index("right_hip")]
        - keypoints.xyz_cam_m[seen, keypoints.names.index("left_hip")]
    )
    heading = np.degrees(np.arctan2(hips[:, 0], hips[:, 2]))
    middle = keypoints.xy_px[seen, keypoints.names.index("left_hip"), 0]
    view = np.degrees(np.arctan((middle - keypoints.camera.matrix[0, 2]) / keypoints.camera.matrix[0, 0]))
    assert abs(np.polyfit(view, heading, 1)[0]) < 0.35


@pytest.mark.parametrize("name", ["walk", "STS"])
def test_a_single_person_is_chosen_whatever_she_does(shared_data, demo, tmp_path, name):
    video = shared_data / "real" / "video_mocap" / name / "video.mp4"
    # Of the long recording the first 3 s suffice.
    frames = (f.image for f in read_frames(video, stop=180, step=2))
    times = constant_rate(38 if name == "walk" else 90)
    choice = choose_subject(track_people(write_video(tmp_path / "v.mp4", frames, times)))
    assert (choice.status, choice.person_id, choice.runner_up_id) == ("CHOSEN", 1, None)


def test_command_on_a_cut_of_the_demo(demo, tmp_path):
    video = write_video(tmp_path / "she.mp4", clips.cut(demo, 80, 125, slice(500, 1500)), constant_rate(45))
    result = run(video, "--out", tmp_path / "new" / "she.npz")
    assert result.exit_code == 0, result.output
    assert "CHOSEN" in result.output
    keypoints = Keypoints.load(tmp_path / "new" / "she.npz")
    assert keypoints.marker_set == "blazepose_33"
    assert keypoints.camera.source == guess_camera((1000, 600)).source
    # Frame 100 of the demo is frame 20 here, moved by the cut.
    ankle = keypoints.xy_px[20, keypoints.names.index("right_ankle")] + [500, 394]
    assert np.hypot(*(ankle - BY_EYE[100][1])) < 25
    # A human's choice of somebody who is not there.
    assert code_of(run(video, "--out", tmp_path / "she.npz", "--person", "9")) == "SUBJECT_UNKNOWN_PERSON"


def refused(folder: Path, pictures: Iterable[np.ndarray], n: int):
    """What is said of a film of `n` pictures, of which no keypoints are written."""
    video = write_video(folder / "film.mp4", pictures, constant_rate(n))
    result = run(video, "--out", folder / "film.npz")
    assert not (folder / "film.npz").exists()
    return result


def test_nobody_in_noise(demo, tmp_path):
    coarse = np.random.default_rng(1).integers(0, 256, (45, 18, 32, 3), np.uint8)
    result = refused(tmp_path, (np.kron(c, np.ones((20, 20, 1), np.uint8)) for c in coarse), 45)
    assert code_of(result) == "TRACK_NO_PERSON"
    assert "NO_PERSON" in result.output


def test_one_frame(demo, tmp_path):
    """Somebody is in it, but nobody can be followed: a code that says so."""
    result = refused(tmp_path, clips.cut(demo, 100, 101, slice(500, 1500)), 1)
    assert code_of(result) == "TRACK_NO_PERSON"
    assert "a video of 1 frame" in str(result.exception)


def test_her_and_her_mirror_image_need_a_choice(demo, tmp_path):
    video = clips.two_alike(demo, tmp_path / "two.mp4")
    result = run(video, "--out", tmp_path / "two.npz")
    assert code_of(result) == "SUBJECT_NEEDS_CHOICE"
    assert "--person" in str(result.exception)
    assert (tmp_path / "two.persons.png").stat().st_size > 10_000
    assert not (tmp_path / "two.npz").exists()
    by_hand = run(video, "--out", tmp_path / "two.npz", "--person", "2")
    assert by_hand.exit_code == 0, by_hand.output
    assert "MANUAL" in by_hand.output


def test_the_demo_upside_down_is_named_so(demo, tmp_path):
    """Turned without a word of it in the file, as some programs save what a phone filmed."""
    pictures = (f.image[::-1, ::-1] for f in read_frames(demo, start=60, stop=110))
    assert code_of(refused(tmp_path, pictures, 50)) == "VIDEO_UPSIDE_DOWN"


def test_the_demo_on_a_phones_screen_is_named_so(demo, tmp_path):
    frames = (
        cv2.copyMakeBorder(cv2.resize(f.image, (720, 404)), 500, 656, 0, 0, cv2.BORDER_CONSTANT, value=(12, 12, 12))
        for f in read_frames(demo, stop=60)
    )
    assert code_of(refused(tmp_path, frames, 60)) == "VIDEO_SCREEN"


def test_usage_errors(tmp_path):
    assert run(tmp_path / "v.mp4", "--out", tmp_path / "x.csv").exit_code == 2
    assert run(tmp_path / "v.mp4", "--out", tmp_path / "x.npz", "--person", "her").exit_code == 2
