"""Failure has a face: each thing a video can lack, made and told; a clean one passes."""

import dataclasses

import cv2
import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, Picture, PictureMeter, check_keypoints, visibility
from pbl_pipeline.keypoints.blazepose import NAMES
from pbl_pipeline.keypoints.picture import detail_of
from pbl_pipeline.video import Camera, Frame
from tests import not_none

SIZE = (720, 1280)
CAMERA = Camera(np.array([[900.0, 0, 360], [0, 900.0, 640], [0, 0, 1]]), np.zeros(5), "test")
FEET = [i for i, n in enumerate(NAMES) if n.endswith(("ankle", "heel", "foot_index"))]
CLEAN = Picture(np.arange(10) / 2, np.tile([30.0, 110.0, 190.0], (10, 1)), np.full(10, 0.02))


def person(n: int = 150, fps: float = 30.0, height_px: float = 700.0, top_px: float = 200.0) -> Keypoints:
    """33 points from head to feet, spread over `height_px`, that sway a little; all found, in good light."""
    y = top_px + height_px * np.linspace(0, 1, len(NAMES))
    x = 360 + 0.1 * height_px * np.where(["left" in name for name in NAMES], 1.0, -1.0)
    xy = np.stack([x, y], axis=1)[None] + 10 * np.sin(np.arange(n) / 8)[:, None, None] * np.array([1.0, 0.0])
    xyz = np.concatenate([(xy - xy[:, 23:25].mean(axis=1, keepdims=True)) / 900, np.zeros((n, 33, 1))], axis=2)
    return Keypoints(
        time_s=np.arange(n) / fps,
        names=NAMES,
        marker_set="blazepose_33",
        xy_px=xy,
        xyz_cam_m=xyz,
        root_relative=True,
        confidence=np.full((n, 33), 0.9),
        image_size_px=SIZE,
        camera=CAMERA,
        box_px=boxes(xy),
        picture=CLEAN,
    )


def boxes(xy: np.ndarray) -> np.ndarray:
    low, high = xy.min(axis=1), xy.max(axis=1)
    return np.clip(np.concatenate([low - 0.1 * (high - low), high + 0.1 * (high - low)], axis=1), 0, [*SIZE, *SIZE])


def lost(keypoints: Keypoints, frames: slice, points: list[int] | slice = slice(None)) -> Keypoints:
    """The same where these points were not found in these frames."""
    xy, xyz, c, box = (
        np.array(a) for a in (keypoints.xy_px, keypoints.xyz_cam_m, keypoints.confidence, keypoints.box_px)
    )
    where = np.ix_(range(len(xy))[frames], range(33)[points] if isinstance(points, slice) else points)
    xy[where], xyz[where], c[where] = np.nan, np.nan, 0.0
    if points == slice(None):
        box[frames] = np.nan
    return dataclasses.replace(keypoints, xy_px=xy, xyz_cam_m=xyz, confidence=c, box_px=box)


def outcome(keypoints: Keypoints, check: str) -> tuple[str, float | None]:
    found = {c.check: c for c in check_keypoints(keypoints)}[check]
    assert bool(found.advice) == (found.outcome != "PASS")
    return found.outcome, found.value


# --- checks of a trial ------------------------------------------------------------------------------------------


def test_a_clean_recording_passes_every_check():
    checks = check_keypoints(person())
    assert {c.check: c.outcome for c in checks} == {
        "frames_seen_s": "PASS",
        "whole_person_s": "PASS",
        "frames_without_person_share": "PASS",
        "feet_cut_share": "PASS",
        "head_cut_share": "PASS",
        "body_height_px": "PASS",
        "picture_brightness": "PASS",
        "picture_detail_share": "PASS",
        "frame_rate_hz": "PASS",
        "leg_confidence": "PASS",
        "side_changes": "PASS",
    }
    assert all(c.advice == "" for c in checks)


def test_frames_without_the_person():
    whole = person()
    assert outcome(lost(whole, slice(60, 75)), "frames_without_person_share") == ("WARN", pytest.approx(0.1))
    assert outcome(lost(whole, slice(20, 130)), "frames_without_person_share")[0] == "FAIL"
    # Before she comes and after she left she is not lost.
    assert outcome(lost(lost(whole, slice(0, 20)), slice(130, 150)), "frames_without_person_share") == ("PASS", 0.0)


def test_feet_below_the_picture_and_head_above():
    low = person(top_px=640.0)  # feet at 1340
    cut = lost(low, slice(None), [i for i in range(33) if low.xy_px[0, i, 1] > SIZE[1]])
    assert outcome(cut, "feet_cut_share") == ("FAIL", 1.0)
    assert outcome(cut, "head_cut_share") == ("PASS", 0.0)
    some = lost(low, slice(0, 30), [i for i in range(33) if low.xy_px[0, i, 1] > SIZE[1]])
    some = dataclasses.replace(some, xy_px=np.where(np.arange(150)[:, None, None] < 30, some.xy_px, person().xy_px))
    assert outcome(some, "feet_cut_share") == ("WARN", pytest.approx(0.2))
    high = person(top_px=-40.0)
    cut = lost(high, slice(None), [i for i in range(33) if high.xy_px[0, i, 1] < 0])
    assert outcome(cut, "head_cut_share") == ("FAIL", 1.0)
    # Feet that something hides in the middle of the picture are not cut by it.
    assert outcome(lost(person(), slice(None, 100), FEET), "feet_cut_share") == ("PASS", 0.0)


@pytest.mark.parametrize(("height_px", "expected"), [(400.0, "PASS"), (80.0, "WARN"), (40.0, "FAIL")])
def test_too_far_away(height_px, expected):
    assert outcome(person(height_px=height_px), "body_height_px") == (expected, pytest.approx(height_px))


@pytest.mark.parametrize(("n", "expected"), [(150, "PASS"), (75, "WARN"), (20, "FAIL")])
def test_too_short_in_view(n, expected):
    assert outcome(person(n), "whole_person_s")[0] == expected


@pytest.mark.parametrize(("fps", "expected"), [(60.0, "PASS"), (25.0, "PASS"), (15.0, "WARN"), (8.0, "FAIL")])
def test_too_few_frames_a_second(fps, expected):
    assert outcome(person(300, fps), "frame_rate_hz") == (expected, pytest.approx(fps))


def test_too_dark_for_any_point():
    nobody = dataclasses.replace(lost(person(), slice(None)), picture=measured(scene(gain=0.03)))
    assert {c.check: c.outcome for c in check_keypoints(nobody)} == {
        "frames_seen_s": "EMPTY",
        "picture_brightness": "FAIL",
    }


def test_what_a_file_cannot_tell_is_left_out():
    without = dataclasses.replace(person(), picture=None)
    names = {c.check for c in check_keypoints(without)}
    assert "picture_brightness" not in names
    assert "picture_detail_share" not in names


# --- the picture ------------------------------------------------------------------------------------------------


def scene(gain: float = 1.0, blur_x: int = 1, sigma: float = 0.0, shrink: float = 1.0) -> np.ndarray:
    """A frame with a textured figure, made darker, blurred along x, out of focus, or seen from further away."""
    rng = np.random.default_rng(1)
    image = np.full((1280, 720, 3), 90, np.uint8)
    patches = cv2.resize(rng.integers(20, 220, (24, 10, 3), np.uint8), (240, 600), interpolation=cv2.INTER_NEAREST)
    image[340:940, 240:480] = patches
    if shrink != 1.0:
        small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        image = cv2.resize(small, (720, 1280), interpolation=cv2.INTER_LINEAR)
    image = cv2.blur(image, (blur_x, 1))
    if sigma:
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    return np.clip(np.rint(image * gain + rng.normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8)


def measured(image: np.ndarray) -> Picture:
    meter = PictureMeter()
    for k in range(3):
        meter.add(k / 2, image, np.array([360.0, 640.0, 640.0, 0.1]))
    return meter.result()


@pytest.mark.parametrize(
    ("change", "check", "expected"),
    [
        ({}, "picture_brightness", "PASS"),
        ({}, "picture_detail_share", "PASS"),
        ({"gain": 0.5}, "picture_brightness", "PASS"),
        ({"gain": 0.25}, "picture_brightness", "WARN"),
        ({"gain": 0.04}, "picture_brightness", "FAIL"),
        ({"blur_x": 60}, "picture_detail_share", "WARN"),
        ({"blur_x": 110}, "picture_detail_share", "FAIL"),
        ({"sigma": 25.0}, "picture_detail_share", "FAIL"),
        ({"gain": 0.3}, "picture_detail_share", "PASS"),
    ],
)
def test_darkness_and_blur_are_told(change, check, expected):
    assert outcome(dataclasses.replace(person(), picture=measured(scene(**change))), check)[0] == expected


def test_detail_by_hand():
    """Stripes of period p along one axis: a sine's steps are 2 pi / p of its size."""
    x = np.arange(256)
    wave = 128 + 100 * np.sin(2 * np.pi * x / 64)
    both = (wave[:, None] + wave[None, :]) / 2
    # Var = 2 (a^2 / 2), steps along one axis only its own sine: (2 pi / p)^2 a^2 / 2.
    assert detail_of(both) == pytest.approx(np.sqrt(2) * 64 / (2 * np.pi) / 256, rel=0.03)
    assert detail_of(3 * both / 4 + 10) == pytest.approx(detail_of(both), rel=1e-3)
    assert np.isnan(detail_of(np.full((256, 100), 7.0)))


def test_the_meter_hands_every_frame_on_and_converts_two_a_second():
    converted = []

    def frame(i: int) -> Frame:
        def convert():
            converted.append(i)
            return np.full((100, 80, 3), 100, np.uint8)

        return Frame(i, i / 30, convert)

    roi = np.tile([40.0, 50.0, 60.0, 0.0], (90, 1))
    roi[:10] = np.nan
    meter = PictureMeter()
    assert [f.index for f in meter.watch((frame(i) for i in range(90)), roi)] == list(range(90))
    assert len(converted) == 6  # 0.33 s, then every 0.5 s
    assert converted[0] == 10
    assert meter.result().luma.shape == (6, 3)
    assert np.all(meter.result().luma == 100)


def test_a_person_out_of_the_picture_is_not_measured():
    meter = PictureMeter()
    meter.add(0.0, np.zeros((100, 100, 3), np.uint8), np.array([-40.0, 50.0, 60.0, 0.0]))
    assert len(meter.result().time_s) == 0
    assert np.isnan(meter.result().bright)


def test_the_picture_survives_the_file(tmp_path):
    person().save(tmp_path / "k.npz")
    again = not_none(Keypoints.load(tmp_path / "k.npz").picture)
    np.testing.assert_allclose(again.luma, CLEAN.luma)
    np.testing.assert_allclose(again.detail, CLEAN.detail)
    data = dict(np.load(tmp_path / "k.npz"))
    np.savez(tmp_path / "bad.npz", **{k: v for k, v in data.items() if k != "picture_luma"})
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        Keypoints.load(tmp_path / "bad.npz")


# --- whole-body visibility --------------------------------------------------------------------------------------


def test_visibility_names_first_last_and_gaps():
    k = lost(person(), slice(0, 15), FEET)  # whole from 0.5 s on
    k = lost(k, slice(30, 45), FEET)  # partial view for 0.53 s: bridged
    k = lost(k, slice(60, 100), FEET)  # 1.37 s: not
    shown = visibility(k)
    assert shown.first_s == pytest.approx(0.5)
    assert shown.last_s == pytest.approx(149 / 30)
    assert [(round(g.start_s, 2), round(g.stop_s, 2), g.bridged) for g in shown.gaps] == [
        (0.97, 1.5, True),
        (1.97, 3.33, False),
    ]
    assert np.flatnonzero(~shown.counts).tolist() == [*range(15), *range(60, 100)]
    assert shown.whole_share == pytest.approx((150 - 15 - 15 - 40) / 150)
    assert shown.counts_s == pytest.approx((150 - 15 - 40) / 30)
    assert "not used: 2.0 to 3.3 s; 1 gap of partial view" in shown.text()


def test_a_short_gap_without_any_sight_is_not_bridged():
    shown = visibility(lost(person(), slice(60, 72)))
    assert [g.bridged for g in shown.gaps] == [False]
    assert np.flatnonzero(~shown.counts).tolist() == list(range(60, 72))


def test_feet_that_are_cut_off_all_the_time_are_not_the_whole_person():
    low = person(top_px=640.0)
    cut = lost(low, slice(None), FEET)
    assert not visibility(cut).whole.any()
    # A detector that knows no feet says nothing of them.
    assert visibility(lost(person(), slice(None), FEET)).whole.all()


def test_nobody_whole():
    shown = visibility(lost(person(), slice(None), [*FEET[:4], 0, 1, 2]))
    # Points that are never given do not count; here they come back once.
    assert shown.whole.all()
    k = lost(person(), slice(1, None), FEET)
    k.confidence[0] = 0.1
    shown = visibility(k)
    assert not shown.whole.any()
    assert np.isnan(shown.first_s)
    assert shown.text() == "the whole person is never in view"
