"""Which lens recorded a video, and a calibration turned to how the phone was held."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from pbl_pipeline.video import (
    Camera,
    PhoneLens,
    VideoInfo,
    about_phone,
    find_camera,
    load_lens_calibration,
    phone_lens,
    probe,
    read_first,
    turned_camera,
)
from tests import refused
from tests.inputs import video_info as probed
from tests.quicktime import insert, meta
from tests.unit.test_camera_sources import small
from tests.videos import constant_rate, numbered_frames, write_video

CAMERA = Camera(
    np.array([[1500.0, 0, 940.0], [0, 1510.0, 560.0], [0, 0, 1]]),
    np.array([0.1, -0.2, 0.003, -0.002, 0.04]),
    "measured: a board",
    0.003,
)
SIZE = (1920, 1080)
FIELDS = {
    "camera_matrix": CAMERA.matrix.tolist(),
    "distortion": CAMERA.distortion.tolist(),
    "image_size_px": list(SIZE),
    "video": {"rotation_deg": 0},
    "phone": {"make": "Apple", "model": "iPhone 13", "lens": "back camera", "focal_35mm": 27, "rate": 60},
}


def video(**changes) -> VideoInfo:
    """A probed video of a phone that names itself."""
    return probed(**{"make": "Apple", "model": "iPhone 13", **changes})


@pytest.mark.parametrize("turn_deg", [0, 90, 180, 270, -90, -270])
def test_a_turned_picture_shows_the_same_points(turn_deg):
    """The picture of points, turned, is the picture of the turned points by the turned camera."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (40, 2)), np.ones(40)])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, CAMERA.distortion)[0].reshape(-1, 2)
    (width, height), matrix = SIZE, CAMERA.matrix
    # One quarter clockwise: the left edge becomes the upper one, read from below.
    for _ in range(turn_deg // 90 % 4):
        seen = np.column_stack([height - 1 - seen[:, 1], seen[:, 0]])
        points = np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])
        width, height = height, width
    turned = turned_camera(CAMERA, SIZE, turn_deg)
    again = cv2.projectPoints(points, np.zeros(3), np.zeros(3), turned.matrix, turned.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(again, seen, atol=1e-8)
    assert (turned.source, turned.focal_rel_sd) == (CAMERA.source, CAMERA.focal_rel_sd)
    assert turned_camera(turned, (width, height), -turn_deg).matrix == pytest.approx(matrix)


@pytest.mark.parametrize(
    ("fps", "capture", "rate"),
    [(24, None, 30), (29.97, None, 30), (50, None, 60), (59.9, None, 60), (119, None, 120), (30, 240.0, 240)],
)
def test_the_rate_at_which_the_sensor_was_read(fps, capture, rate):
    lens = phone_lens(video(fps=fps, capture_fps=capture))
    assert lens is not None
    assert lens.rate == rate


def test_upright_and_turned_recordings_are_stored_alike():
    upright = phone_lens(video(width_px=1080, height_px=1920, rotation_deg=90))
    across = phone_lens(video(width_px=1920, height_px=1080, rotation_deg=180))
    copy = phone_lens(video(width_px=1080, height_px=1920, rotation_deg=0))  # its pictures were turned
    assert upright == across
    assert copy != across


def test_another_focal_length_is_another_lens():
    lens = PhoneLens("Apple", "iPhone 13", "", SIZE, 30, 27.0)
    assert lens.same_focal(27.0)
    assert lens.same_focal(None)
    assert not lens.same_focal(52.0)
    assert dataclasses.replace(lens, focal_35mm=None).same_focal(52.0)


def test_the_model_is_said_once():
    assert PhoneLens("Apple", "iPhone 13", "iPhone 13 back camera", SIZE, 30).name == "Apple iPhone 13 back camera"
    assert PhoneLens("Google", "Pixel 8", "", SIZE, 30).name == "Google Pixel 8"
    assert PhoneLens("", "X", "wide", SIZE, 30).name == "X wide"


def test_a_recording_without_a_model_has_no_lens():
    assert phone_lens(video(model=None)) is None
    assert phone_lens(video(fps=float("nan"))) is None


def test_what_pbl_calibrate_writes_of_the_phone_is_read_back(tmp_path):
    path = tmp_path / "board.mov"
    write_video(path, numbered_frames(6, 96, 64), constant_rate(6, 60), rotation_deg=90)
    insert(
        path,
        of_track=meta({"com.apple.quicktime.camera.focal_length.35mm_equivalent": 26}),
        of_file=meta({"com.apple.quicktime.make": "Apple", "com.apple.quicktime.model": "iPhone 15"}),
    )
    info = probe(path)
    fields = {"camera_matrix": [[80, 0, 32], [0, 80, 48], [0, 0, 1]], "distortion": [0] * 5, "image_size_px": [64, 96]}
    (tmp_path / "camera.json").write_text(json.dumps({**fields, **about_phone(info)}))
    found = load_lens_calibration(tmp_path / "camera.json")
    assert found.lens == phone_lens(info) == PhoneLens("Apple", "iPhone 15", "", (96, 64), 60, 26.0)
    assert (found.size_px, found.rotation_deg) == ((64, 96), 90)
    # The same from a file that names no phone, and a recording of it.
    (tmp_path / "plain.json").write_text(json.dumps(fields))
    assert load_lens_calibration(tmp_path / "plain.json", like=path).lens == found.lens


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"model": "iPhone 15"}, "a calibration of iPhone 13, and a video of iPhone 15"),
        ({"lens": "ultra wide camera"}, "a calibration of back camera, and a video of ultra wide camera"),
        ({"focal_35mm": 54.0}, "a calibration of 27 mm on 35 mm film, and a video of 54.0 mm on 35 mm film"),
        ({"make": "APPLE", "model": "iPhone 13", "focal_35mm": 27.2}, None),
        ({"make": None, "model": None}, None),
    ],
)
def test_a_calibration_of_another_phone_is_refused(tmp_path, changes, found):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(FIELDS))
    recorded = video(width_px=1920, height_px=1080, **changes)
    if found is None:
        assert find_camera(recorded, path).source.startswith("file: camera.json")
        return
    assert refused("CAMERA_INVALID", find_camera, recorded, path).found == found


@pytest.mark.parametrize(
    ("size", "flag", "turn"),
    [
        ((1920, 1080), 0, 0),
        ((1920, 1080), 180, 180),
        ((1080, 1920), 90, 90),
        ((1080, 1920), 270, 270),
        ((1920, 1080), 90, 0),  # copies whose pictures were turned
        ((960, 540), 0, 0),
    ],
)
def test_a_landscape_calibration_serves_however_the_phone_was_held(tmp_path, size, flag, turn):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(FIELDS))
    found = find_camera(video(width_px=size[0], height_px=size[1], rotation_deg=flag), path)
    expected = turned_camera(CAMERA, SIZE, turn)
    if size == (960, 540):
        assert found.matrix[0, 0] == CAMERA.matrix[0, 0] / 2
    else:
        np.testing.assert_array_equal(found.matrix, expected.matrix)
    np.testing.assert_array_equal(found.distortion, expected.distortion)
    assert found.source == "file: camera.json" + (
        f", turned by {turn} deg" if turn else ", scaled by 0.5 from 1920x1080 px" if size[0] == 960 else ""
    )


def test_turned_pictures_of_which_no_flag_is_known_are_refused(tmp_path):
    upright = video(width_px=1080, height_px=1920, rotation_deg=90)
    for changes in ({"video": None}, {"video": {"rotation_deg": 90}}):  # the second: turned by nothing, and yet lies
        (tmp_path / "camera.json").write_text(json.dumps({**FIELDS, **changes}))
        assert "turned" in refused("CAMERA_INVALID", find_camera, upright, tmp_path / "camera.json").found


def test_the_first_picture_says_what_the_whole_video_does(tmp_path):
    path = tmp_path / "a.mov"
    write_video(path, numbered_frames(6, 96, 64), constant_rate(6), rotation_deg=270)
    insert(path, of_file=meta({"com.apple.quicktime.model": "iPhone 15"}))
    first, whole = read_first(path), probe(path)
    assert (first.width_px, first.height_px, first.rotation_deg, first.model) == (64, 96, 270, "iPhone 15")
    assert all(getattr(whole, f.name) == getattr(first, f.name) for f in dataclasses.fields(first))


@pytest.mark.parametrize(
    "changes",
    [
        {"phone": None},
        {"phone": {"make": "Apple", "model": None}},
        {"phone": {**FIELDS["phone"], "rate": 25}},
        {"video": {"rotation_deg": 45}},
        {"video": None},
        {"image_size_px": [1920.5, 1080]},
        {"camera_matrix": [[0, 0, 0]] * 3},
    ],
)
def test_files_that_name_no_phone(tmp_path, changes):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**FIELDS, **changes}))
    refused("CAMERA_INVALID", load_lens_calibration, path)


def test_recordings_and_texts_that_name_no_phone(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(FIELDS))
    (tmp_path / "camera.toml").write_text("[a]\nsize = [1920, 1080]\n")
    for file, like in (("camera.json", small(tmp_path / "copy.mp4")), ("camera.toml", None), ("none.json", None)):
        refused("CAMERA_INVALID", load_lens_calibration, tmp_path / file, like)
