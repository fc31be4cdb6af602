"""Heads covered in pictures and in files: geometry by hand, what a file still says, what is refused, real people."""

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pbl_pipeline.deidentify import (
    HOW,
    REASONS,
    Head,
    HeadParams,
    Heads,
    cover,
    covered_picture,
    deidentify,
    sidecar_of,
)
from pbl_pipeline.deidentify.heads_of_video import around_both, body_end, head_circle, head_of_person, held, off_course
from pbl_pipeline.deidentify.types import BODY, DISAGREE, HELD, KEYPOINTS, NONE
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import BlazePoseLandmarks, Keypoints
from pbl_pipeline.runs import ranges
from pbl_pipeline.tracking import PersonTrack
from pbl_pipeline.video import Camera, probe, read_frames, read_metadata
from tests.command import pbl
from tests.unit.test_blazepose import asset
from tests.videos import constant_rate, numbered_frames, write_video

CAMERA = Camera(np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), np.zeros(5), "guess")
SIZE = (640, 480)
PHONE = {
    "com.apple.quicktime.location.ISO6709": "+48.2082+016.3738/",
    "com.apple.quicktime.make": "Apple",
    "com.apple.quicktime.model": "iPhone 13",
    "com.apple.quicktime.creationdate": "2026-03-01T09:15:00+0100",
    "com.android.capture.fps": "120",
    "title": "Mrs Somebody",
}


def a_head(circles: Sequence[tuple[float, float, float] | None], source: int = KEYPOINTS, **changes) -> Head:
    rows = np.array([(np.nan,) * 3 if c is None else c for c in circles], float)
    known = np.isfinite(rows).all(axis=1)
    box = np.full((len(rows), 4), np.nan)
    body = np.zeros((len(rows), 33, 2), np.float32)
    head = Head(rows, np.where(known, source, NONE).astype(np.uint8), box, body, BlazePoseLandmarks.names)
    return dataclasses.replace(head, **changes)


def heads_of(n: int, size: tuple[int, int], *heads: Head) -> Heads:
    return Heads(constant_rate(n), size, heads)


# --- pictures


@pytest.mark.parametrize("how", ["blur", "pixelate"])
@pytest.mark.parametrize("radius", [12.0, 60.0, 200.0])
def test_nothing_as_fine_as_an_eye_is_left_in_the_circle_and_nothing_changes_outside(how, radius):
    """A grating whose stripes are as wide as an eye (a tenth of a circle of 0.2 m is 2 cm): its contrast is gone."""
    n, half = 640, max(1, round(radius * 0.1))
    x = np.arange(n)
    image = np.where((x // half) % 2, 255, 0).astype(np.uint8)[None, :, None].repeat(n, 0).repeat(3, 2)
    before = image.copy()
    cover(image, [np.array([[320.0, 320.0, radius]])], how)
    apart = np.hypot(*np.meshgrid(x - 320.0, x - 320.0))
    np.testing.assert_array_equal(image[apart > radius + 1.5], before[apart > radius + 1.5])
    inside = image[apart < radius - 1.5].astype(float)
    assert inside.std() < 0.12 * 127.5
    assert abs(inside.mean() - 127.5) < 26


@pytest.mark.parametrize("how", ["blur", "pixelate"])
def test_circles_that_leave_the_picture_are_covered_as_far_as_they_are_in_it(how):
    image = np.random.default_rng(1).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    before = image.copy()
    cover(image, [np.array([[0.0, 0.0, 20.0], [79.0, 59.0, 10.0]]), np.array([[500.0, 500.0, 30.0]])], how)
    assert (image[:8, :8] != before[:8, :8]).mean() > 0.9
    assert (image[-4:, -4:] != before[-4:, -4:]).mean() > 0.8
    np.testing.assert_array_equal(image[:25, 40:], before[:25, 40:])


def test_a_skeleton_shows_lines_on_black_and_no_point_of_a_face():
    names = BlazePoseLandmarks.names
    xy = np.full((1, 33, 2), np.nan, np.float32)
    for name, at in {"left_hip": (100, 100), "left_knee": (100, 150), "nose": (100, 20), "left_ear": (110, 20)}.items():
        xy[0, names.index(name)] = at
    head = a_head([(100, 20, 10)], body_px=xy)
    picture = covered_picture(np.full((200, 200, 3), 255, np.uint8), heads_of(1, (200, 200), head), 0, "skeleton")
    drawn = np.argwhere(picture.any(axis=2))
    assert picture[125, 100].any()
    assert drawn[:, 0].min() >= 95
    assert len(drawn) < 500


# --- where a head is


def person(n: int, scale: float = 300.0, at: tuple[float, float] = (320.0, 240.0)) -> Keypoints:
    """A standing body of plain proportions (m, y down, the middle of the hips at 0), `scale` px for a metre."""
    names = BlazePoseLandmarks.names
    body = np.zeros((33, 3))
    for i, name in enumerate(names):
        side = 0.2 if name.startswith("left") else -0.2 if name.startswith("right") else 0.0
        part = name.split("_")[1] if side else name
        y = {"shoulder": -0.5, "elbow": -0.2, "hip": 0.0, "knee": 0.4, "ankle": 0.8, "heel": 0.85, "foot": 0.85}
        body[i] = side, y.get(part, 0.0), 0.1 * (i % 3)
        if "ear" in name or "eye" in name or name == "nose" or "mouth" in name:
            body[i] = side / 3, -0.7, 0.0
    xy = np.tile(body[None, :, :2] * scale + np.array(at), (n, 1, 1))
    return Keypoints(
        time_s=constant_rate(n),
        names=names,
        marker_set="blazepose_33",
        xy_px=xy.astype(np.float32),
        xyz_cam_m=np.tile(body[None], (n, 1, 1)).astype(np.float32),
        root_relative=True,
        confidence=np.ones((n, 33), np.float32),
        image_size_px=SIZE,
        camera=CAMERA,
        box_px=np.tile(np.array([200, 0, 440, 480.0]), (n, 1)),
    )


def track_of(n: int, roi: tuple[float, float, float, float]) -> PersonTrack:
    rows = np.tile(np.array(roi), (n, 1))
    return PersonTrack(1, np.tile(np.array([200, 0, 440, 480.0]), (n, 1)), rows, np.ones(n), np.ones(n, bool))


def test_the_circle_is_around_the_ears_and_as_large_as_a_head_at_that_scale():
    found = head_circle(person(1, scale=300), HeadParams(head_radius_m=0.2))
    np.testing.assert_allclose(found, [[320, 240 - 0.7 * 300, 60]], atol=0.01)


def test_without_ears_the_other_points_of_the_face_count_and_without_a_face_nothing():
    seen = person(2)
    xy = seen.xy_px.copy()
    xy[:, [7, 8]] = np.nan
    xy[1, :11] = np.nan
    found = head_circle(dataclasses.replace(seen, xy_px=xy), HeadParams())
    assert found[0, 0] == pytest.approx(320, abs=1)
    assert np.isnan(found[1]).all()


def test_the_upper_end_of_a_body_lies_along_its_own_axis():
    """Upright: above the centre. Turned clockwise by 90 degrees: to the right."""
    params = HeadParams(up=0.5, body_radius=0.25)
    found = body_end(np.array([[100, 200, 80, 0.0], [100, 200, 80, np.pi / 2]]), params)
    np.testing.assert_allclose(found, [[100, 180, 10], [120, 200, 10]], atol=1e-9)


def test_points_that_the_body_contradicts_are_in_doubt_and_both_places_are_covered():
    seen = person(9)
    agrees = head_of_person(track_of(9, (320, 240, 2 * 0.7 * 300 / 0.76, 0.0)), seen, HeadParams())
    assert set(agrees.source) == {KEYPOINTS}
    lies = head_of_person(track_of(9, (320, 240, 2 * 0.7 * 300 / 0.76, np.pi / 2)), seen, HeadParams())
    assert set(lies.source) == {DISAGREE}
    x, y, r = lies.circle_px[0]
    for at in ((320, 30), (320 + 210, 240)):
        assert np.hypot(at[0] - x, at[1] - y) < r
    xy = seen.xy_px.copy()
    xy[4] = np.nan
    unseen = head_of_person(track_of(9, (320, 240, 300, 0.0)), dataclasses.replace(seen, xy_px=xy), HeadParams())
    assert unseen.source[4] == BODY


def test_a_jump_of_one_frame_is_seen():
    circle = np.tile(np.array([100.0, 100, 20]), (9, 1))
    circle[4, 0] = 150
    np.testing.assert_allclose(off_course(circle), [0, 0, 0, 0, 50, 0, 0, 0, 0])


def test_the_circle_around_two_by_hand():
    np.testing.assert_allclose(around_both(np.array([0, 0, 1.0]), np.array([4, 0, 1.0])), [2, 0, 3])
    np.testing.assert_allclose(around_both(np.array([0, 0, 5.0]), np.array([1, 0, 1.0])), [0, 0, 5])


# --- held over time


def test_gaps_are_interpolated_and_grow_and_ends_are_held():
    params = HeadParams(hold_s=0.1, leave_s=0.1, bridge_s=1.0, hold_growth=3.0, hold_most=2.0)
    time_s = np.arange(12) / 30
    head = held(
        a_head([None] * 4 + [(100, 100, 10)] + [None] * 2 + [(130, 100, 10)] + [None] * 4), time_s, SIZE, params
    )
    np.testing.assert_allclose(head.circle_px[5], [110, 100, 11])
    np.testing.assert_allclose(head.circle_px[6], [120, 100, 11])
    assert head.source.tolist() == [NONE] + [HELD] * 3 + [KEYPOINTS] + [HELD] * 2 + [KEYPOINTS] + [HELD] * 3 + [NONE]
    np.testing.assert_allclose(head.circle_px[3], [100, 100, 11])


def test_who_leaves_through_the_edge_or_was_seen_briefly_is_not_held_as_long():
    params = HeadParams(hold_s=1.0, leave_s=0.1)
    time_s = np.arange(30) / 30
    middle = held(a_head([(100, 100, 10)] * 15 + [None] * 15), time_s, SIZE, params)
    leaving = held(a_head([(5, 100, 10)] * 15 + [None] * 15), time_s, SIZE, params)
    brief = held(a_head([(100, 100, 10)] * 6 + [None] * 24), time_s, SIZE, params)
    assert (middle.source == HELD).sum() == 15  # half a second, as long as it was seen
    assert (leaving.source == HELD).sum() == 3
    assert (brief.source == HELD).sum() == 6


def test_where_the_place_is_in_doubt_the_place_of_the_sure_frames_is_covered_too():
    head = a_head([(100, 100, 10)] * 3 + [(300, 300, 10)] + [(106, 100, 10)] * 3)
    head.source[3] = DISAGREE
    done = held(head, np.arange(7) / 30, SIZE, HeadParams())
    found = heads_of(7, SIZE, done)
    x, y, _ = np.concatenate(found.circles(3)).T
    assert sorted(x) == pytest.approx([103, 300])
    assert sorted(y) == pytest.approx([100, 300])
    assert found.reasons()[3] == ("disagree",)


def test_a_frame_hides_where_the_head_is_in_the_frames_around():
    found = heads_of(5, SIZE, a_head([(10, 10, 5), (20, 10, 5), (30, 10, 5), None, (50, 10, 5)]))
    assert [len(c) for c in found.circles(1, 0.04)] == [3]
    assert found.circles(3) == []
    assert [c[:, 0].tolist() for c in found.circles(3, 0.04)] == [[30, 50]]


def test_reasons_by_hand():
    """Frame 0 nobody; 1 sure; 2 held; 3 the second person stands in front of the first one's head."""
    first = a_head([None, (100, 100, 10), (100, 100, 10), (100, 100, 10)])
    first.source[2] = HELD
    box = np.full((4, 4), np.nan)
    box[3] = 90, 90, 200, 400
    second = a_head([None, None, None, (150, 100, 10)], box_px=box)
    found = heads_of(4, SIZE, first, second)
    assert found.reasons() == [("no_head",), (), ("held",), ("overlap",)]
    assert set(itertools.chain(*found.reasons())) <= set(REASONS)
    assert ranges([bool(r) for r in found.reasons()]) == [(0, 0), (2, 3)]


# --- files


def a_video(path: Path, n: int = 12, **options) -> Path:
    return write_video(path, numbered_frames(n), constant_rate(n) ** 1.1, **options)


def one_head(n: int, size: tuple[int, int] = (96, 64)) -> Heads:
    return heads_of(n, size, a_head([(40, 30, 10)] * n))


@pytest.mark.parametrize("how", HOW)
def test_frames_stamps_and_the_way_up_are_those_of_the_original(tmp_path, how):
    path = a_video(tmp_path / "wälk ☃.mov", rotation_deg=90)
    done = deidentify(path, tmp_path / "öut ☃.mp4", how, heads=one_head(12))
    before, after = probe(path), probe(done.path)
    assert (after.width_px, after.height_px, after.n_frames) == (before.width_px, before.height_px, before.n_frames)
    np.testing.assert_allclose(after.time_s, before.time_s, atol=1 / 90_000)
    assert after.rotation_deg == 0
    if how != "skeleton":
        for a, b in zip(read_frames(path), read_frames(done.path), strict=True):
            # Away from the circle the picture is the same but for its coding: the blue and the red corner.
            np.testing.assert_allclose(b.image[4:12, 4:12].mean((0, 1)), a.image[4:12, 4:12].mean((0, 1)), atol=8)
    assert done.status == "CERTAIN"
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([path.name, done.path.name, done.sidecar.name])


def test_a_picture_of_odd_size_keeps_its_size(tmp_path):
    frames = [np.full((35, 51, 3), 90, np.uint8)] * 3
    path = write_video(tmp_path / "odd.mkv", frames, constant_rate(3), codec="ffv1", pixel_format="bgr0")
    done = deidentify(path, tmp_path / "out.mp4", heads=one_head(3, (51, 35)))
    assert (probe(done.path).width_px, probe(done.path).height_px) == (51, 35)


def with_sound(path: Path, metadata: dict[str, str]) -> Path:
    """A video with a track of silence and tags."""
    tags = {"movflags": "use_metadata_tags"}
    with av.open(str(path), "w", options=tags) as out:
        out.metadata.update(metadata)
        video, sound = out.add_stream("libx264", rate=30), out.add_stream("aac", rate=16_000)
        assert isinstance(video, av.VideoStream)
        video.width, video.height, video.pix_fmt = 96, 64, "yuv420p"
        for image in numbered_frames(6):
            out.mux(video.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16_000
        out.mux([*sound.encode(frame), *video.encode(None), *sound.encode(None)])
    return path


def test_sound_and_tags_are_gone_and_what_is_asked_for_is_kept(tmp_path):
    path = with_sound(tmp_path / "phone.mp4", PHONE)
    assert read_metadata(path)["title"] == "Mrs Somebody"
    done = deidentify(path, tmp_path / "bare.mp4", heads=one_head(6))
    with av.open(str(done.path)) as file:
        assert [s.type for s in file.streams] == ["video"]
    left = read_metadata(done.path)
    assert not {k: v for k, v in left.items() if v in set(PHONE.values()) - {"120"}}
    assert left["com.android.capture.fps"] == "120"  # the warning about slow motion must not be lost
    raw = done.path.read_bytes() + done.sidecar.read_bytes()
    assert not [v for v in (*PHONE.values(), "phone", str(tmp_path)) if v != "120" and v.encode() in raw]
    info = probe(done.path)
    assert (info.make, info.model, info.recorded_utc) == (None, None, None)

    kept = deidentify(path, tmp_path / "kept.mp4", heads=one_head(6), keep=["device", "time"])
    info = probe(kept.path)
    assert (info.make, info.model, info.recorded_utc) == ("Apple", "iPhone 13", "2026-03-01T08:15:00Z")
    assert b"+48.2082" not in kept.path.read_bytes()
    placed = deidentify(path, tmp_path / "place.mp4", heads=one_head(6), keep=["place"])
    assert b"+48.2082" in placed.path.read_bytes()
    assert probe(placed.path).make is None


def test_the_sidecar_lists_what_to_look_at(tmp_path):
    path = a_video(tmp_path / "walk.mp4")
    head = a_head([None] * 2 + [(40, 30, 10)] * 10)
    head.source[7] = HELD
    done = deidentify(path, tmp_path / "out.mp4", heads=heads_of(12, (96, 64), head))
    assert done.sidecar == tmp_path / "out.deidentified.json" == sidecar_of(tmp_path / "out.deidentified.mp4")
    said = json.loads(done.sidecar.read_text())
    assert (said["status"], said["n_frames"], said["n_uncertain"], said["n_heads"]) == ("REVIEW", 12, 3, 1)
    assert [(u["first"], u["last"], u["why"]) for u in said["uncertain"]] == [(0, 1, ["no_head"]), (7, 7, ["held"])]
    assert said["uncertain"][1]["first_s"] == pytest.approx((7 / 30) ** 1.1, abs=1e-3)
    assert said["frames_by_reason"] == {"no_head": 2, "held": 1}
    assert said["original_sha256"] == probe(path).sha256
    assert said["sha256"] == probe(done.path).sha256


def test_nothing_is_overwritten_unless_asked_and_the_recording_never(tmp_path):
    path = a_video(tmp_path / "walk.mp4")
    deidentify(path, tmp_path / "out.mp4", heads=one_head(12))
    for out, overwrite in ((tmp_path / "out.mp4", False), (path, True)):
        with pytest.raises(PblError, match=r"^FILE_UNWRITABLE: "):
            deidentify(path, out, heads=one_head(12), overwrite=overwrite)
    again = deidentify(path, tmp_path / "out.mp4", "pixelate", heads=one_head(12), overwrite=True)
    assert json.loads(again.sidecar.read_text())["how"] == "pixelate"


def test_a_failure_leaves_no_file(tmp_path):
    path = a_video(tmp_path / "walk.mp4")
    info = dataclasses.replace(probe(path), n_frames=11)
    with pytest.raises(PblError, match=r"^VIDEO_CHANGED: "):
        deidentify(path, tmp_path / "out.mp4", heads=one_head(12), info=info)
    assert [p.name for p in tmp_path.iterdir()] == ["walk.mp4"]


def test_calls_that_cannot_work(tmp_path):
    path = a_video(tmp_path / "walk.mp4")
    wrong: list[dict[str, Any]] = [{"how": "mosaic"}, {"keep": ["name"]}, {"out": tmp_path / "out.mov"}]
    for arguments in wrong:
        with pytest.raises(PblError, match=r"^USAGE: "):
            deidentify(path, **({"out": tmp_path / "out.mp4"} | arguments), heads=one_head(12))
    (tmp_path / "text.mp4").write_text("not a video")
    assert pbl("deidentify", tmp_path / "text.mp4").error_code == "VIDEO_NOT_A_VIDEO"
    assert pbl("deidentify", tmp_path / "none.mp4").error_code == "VIDEO_MISSING"


@pytest.mark.slow
def test_a_video_without_a_head_is_written_and_says_so(tmp_path):
    asset("face_detector")
    path = a_video(tmp_path / "näme ☃.mp4", n=8)
    done = pbl("deidentify", path)
    assert (done.code, done.error_code) == (1, "HEAD_NOT_FOUND")
    said = json.loads((tmp_path / "näme ☃.deidentified.json").read_text())
    assert said["status"] == "NO_HEAD"
    assert [(u["first"], u["last"], u["why"]) for u in said["uncertain"]] == [(0, 7, ["no_head"])]
    assert probe(tmp_path / "näme ☃.deidentified.mp4").n_frames == 8
    assert pbl("deidentify", path).error_code == "FILE_UNWRITABLE"
