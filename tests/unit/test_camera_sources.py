"""Whose intrinsics a video gets, and what its file says of lens and time; on files made with known content."""

import dataclasses
import functools
import json
import re
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import CAMERA_KINDS, Camera, check_timing, find_camera, probe, read_frames
from pbl_pipeline.video.camera import reaches_corners
from pbl_pipeline.video.container_tags import read_tags
from pbl_pipeline.video.lens_calibration import preset_camera, presets, quarter_turn
from research.phone_cameras import build
from tests import not_none, refused
from tests.inputs import keypoints, video_info
from tests.quicktime import MILLISECONDS, edit_list, insert, meta
from tests.videos import constant_rate, numbered_frames, write_video

APPLE = {
    "com.apple.quicktime.make": "Apple",
    "com.apple.quicktime.model": "iPhone 13",
    "com.apple.quicktime.creationdate": "2026-03-01T10:15:30+0100",
}
LENS = "com.apple.quicktime.camera.lens_model"
FOCAL = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def small(path, **options):
    return write_video(path, numbered_frames(6), constant_rate(6), **options)


def preset(**facts) -> Camera:
    """The published camera of a phone's video with these facts."""
    return not_none(preset_camera(video_info(**facts)))


# --- what the file says


@pytest.mark.parametrize("iso", [False, True])
@pytest.mark.parametrize("value", [27, "27", 27.0, "27.00mm"])
def test_the_lens_stands_with_the_track(tmp_path, value, iso):
    path = small(tmp_path / "a.mov")
    lens = "iPhone 13 back dual wide camera 5.1mm f/1.6"
    insert(path, of_track=meta({LENS: lens, FOCAL: value}, iso), of_file=meta(APPLE, iso))
    info = probe(path)
    assert (info.make, info.model, info.lens, info.focal_35mm) == ("Apple", "iPhone 13", lens, 27.0)
    assert info.recorded_utc == "2026-03-01T09:15:30Z"
    assert info.n_frames == 6
    camera = find_camera(info)
    assert camera.source.startswith("metadata: 27 mm on 35 mm film, iPhone 13 back")


def test_a_file_without_tags(tmp_path):
    info = probe(small(tmp_path / "a.mp4"))
    assert (info.lens, info.focal_35mm, info.capture_fps) == (None, None, None)
    assert check_timing(info) == ()
    assert find_camera(info).source.startswith("guess: ")


def test_boxes_that_make_no_sense_end_the_reading(tmp_path):
    path = small(tmp_path / "a.mov")
    whole = insert(path, of_track=meta({LENS: "x", FOCAL: 27}), of_file=meta(APPLE)).read_bytes()
    there = {k.lower(): v for k, v in APPLE.items()} | {LENS: "x", FOCAL: "27"}
    assert read_tags(path).items == there
    rng = np.random.default_rng(1)
    for at in rng.integers(whole.index(b"moov"), len(whole) - 4, 300):
        path.write_bytes(whole[:at] + rng.bytes(4) + whole[at + 4 :])
        tags = read_tags(path)
        assert all(isinstance(v, str) for v in tags.items.values())
    for at in range(8, len(whole), 97):
        path.write_bytes(whole[:at])
        assert read_tags(path).items.items() <= there.items()


# --- time


def test_android_slow_motion_is_said_and_fails(tmp_path):
    path = insert(small(tmp_path / "a.mp4"), of_file=meta({"com.android.capture.fps": 240.0}))
    info = probe(path)
    assert info.capture_fps == 240
    assert any("240 and stored at 30" in n and "8 times too slow" in n for n in info.notes)
    (check,) = check_timing(info)
    assert (check.outcome, check.value) == ("FAIL", pytest.approx(8, rel=1e-3))
    assert "original" in check.advice


def test_android_at_the_rate_it_says_passes(tmp_path):
    info = probe(insert(small(tmp_path / "a.mp4"), of_file=meta({"com.android.capture.fps": 30.0})))
    assert [c.outcome for c in check_timing(info)] == ["PASS"]
    assert not any("slow" in n for n in info.notes)


def _filtered(path, codec_options=None, **set_on):
    """A video whose encoder states the shape of its pixels or fields."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options=codec_options or {})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for name, value in set_on.items():
            setattr(stream.codec_context, name, value)
        for image in numbered_frames(12):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    return path


def test_pixels_that_are_not_square_are_refused_with_the_remedy(tmp_path):
    """At 4:3 the speed was 0.90 instead of 1.17 m/s, with a note."""
    wide = _filtered(tmp_path / "a.mp4", sample_aspect_ratio=Fraction(4, 3))
    error = refused("VIDEO_PIXELS", probe, wide)
    assert "4:3" in error.found
    assert "scale=iw*sar:ih,setsar=1" in error.next_step
    assert probe(_filtered(tmp_path / "b.mp4", sample_aspect_ratio=Fraction(1280, 1281))).n_frames == 12


def test_interlaced_pictures_are_refused_with_the_remedy(tmp_path):
    fields = _filtered(tmp_path / "a.mp4", {"flags": "+ilme+ildct", "x264-params": "tff=1"})
    error = refused("VIDEO_PIXELS", probe, fields)
    assert "12 of 12 pictures are interlaced" in error.found
    assert "bwdif" in error.next_step


@pytest.mark.parametrize(
    ("stored", "capture", "outcome", "said"),
    [
        (30, 10.0, "FAIL", "time lapse"),  # passed with a factor of 1
        (24, 30.0, "PASS", ""),  # low light in real time, which failed as slow motion
        (30, 120.0, "FAIL", "slow motion"),
        (240, 240.0, "PASS", ""),
        (30, 60.0, "WARN", "cannot be told"),  # half speed, or a phone of 60 frames a second in low light
        (15, 30.0, "WARN", "cannot be told"),
        (60, 30.0, "WARN", "cannot be told"),  # frames doubled by an editor, or played twice as fast
    ],
)
def test_rates_that_android_states(tmp_path, stored, capture, outcome, said):
    path = write_video(tmp_path / "a.mp4", numbered_frames(48), constant_rate(48, stored))
    info = probe(insert(path, of_file=meta({"com.android.capture.fps": capture})))
    (check,) = check_timing(info)
    assert check.outcome == outcome
    assert said in check.advice
    assert not said or check.value == pytest.approx(capture / stored, rel=1e-3)
    assert any("stored at" in n for n in info.notes) == bool(said)


def test_slow_motion_with_an_edit_list(tmp_path):
    """240 frames a second of real time; the edit list plays the second half at an eighth and hides nothing."""
    path = write_video(
        tmp_path / "slow.mov",
        numbered_frames(48),
        constant_rate(48, 240),
        ticks_per_s=2400,
        container_options=MILLISECONDS,
    )
    insert(path, of_track=edit_list([(100, 0, 1.0), (800, 240, 0.125)]))
    info = probe(path)
    np.testing.assert_allclose(np.diff(info.time_s), 1 / 240, atol=1e-3)
    assert any("edit list asks players for other speeds (0.125)" in n for n in info.notes)
    assert any("slow motion of 240 frames a second" in n for n in info.notes)


def test_hevc_portrait_with_its_rotation_flag(tmp_path):
    path = tmp_path / "a.mov"
    write_video(path, numbered_frames(6, 96, 64), constant_rate(6), codec="libx265", rotation_deg=90)
    info = probe(insert(path, of_file=meta(APPLE)))
    assert (info.codec, info.width_px, info.height_px, info.rotation_deg) == ("hevc", 64, 96, 90)
    assert next(iter(read_frames(path))).image[2, 2].tolist() == pytest.approx([255, 0, 0], abs=40)
    assert info.n_frames == 6


# --- intrinsics


def test_the_order_of_sources(tmp_path):
    file = tmp_path / "camera.json"
    content = {"camera_matrix": [[940, 0, 360], [0, 942, 640], [0, 0, 1]], "distortion": [0] * 5}
    file.write_text(json.dumps(content | {"image_size_px": [720, 1280], "focal_sd_px": 4.705}))
    full = video_info(model="iPhone 13", focal_35mm=27.0)
    given = find_camera(full, file)
    assert given.source.startswith("file: camera.json, focal length within 0.5 % (sd)")
    assert given.focal_rel_sd == pytest.approx(0.005)
    assert find_camera(full).source.startswith("metadata: ")
    assert find_camera(dataclasses.replace(full, focal_35mm=None)).source.startswith(
        "preset: main camera of the iPhone"
    )
    assert find_camera(video_info()).source.startswith("guess: ")
    spread = [find_camera(v).focal_rel_sd for v in (full, video_info(model="iPhone 13"), video_info())]
    assert sorted(spread) == spread
    assert spread[0] > given.focal_rel_sd


def test_focal_length_from_film():
    camera = find_camera(video_info(focal_35mm=36.0, width_px=1600, height_px=1200))
    # 36 mm along 36 mm of film is as long as the picture; along the diagonals (43.267 mm, 2000 px) it is 1664 px.
    assert camera.focal_px == pytest.approx(np.sqrt(1600 * 2000 * 36 / 43.2666), rel=1e-4)
    assert not camera.distortion.any()
    assert find_camera(video_info(focal_35mm=3000.0)).source.startswith("guess")


def test_film_and_published_calibration_agree_on_one_phone():
    film = find_camera(video_info(model="iPhone 13", focal_35mm=27.0))
    known = find_camera(video_info(model="iPhone 13"))
    assert film.focal_px == pytest.approx(known.focal_px, rel=film.focal_rel_sd)
    np.testing.assert_array_equal(film.distortion, known.distortion)
    assert "distortion of that model" in film.source
    # Zoomed, or another lens of that phone: nothing is known of its distortion.
    for other in (13.0, 54.0):
        camera = find_camera(video_info(model="iPhone 13", focal_35mm=other))
        assert not camera.distortion.any()
        assert "no distortion" in camera.source


def test_presets_are_those_published(shared_data):
    published = json.loads((shared_data / "real/norms/opencap_iphone_intrinsics.json").read_text())
    assert build(published) == presets()
    for key, entry in published.items():
        height, width = (int(row[0]) for row in entry["imageSize"])
        camera = preset(model=key.split("/")[0], width_px=width, height_px=height)
        np.testing.assert_allclose(camera.matrix, entry["intrinsicMat"], atol=1e-3)
        np.testing.assert_allclose(camera.distortion, entry["distortion"][0], atol=1e-6)


@pytest.mark.parametrize("name", ["iPhone 11", "iphone12,1", " iPhone  11 "])
def test_a_preset_by_name_or_identifier(name):
    # Of this phone both formats are published, and differ.
    assert preset(model=name).matrix[0, 0] == pytest.approx(912.2, abs=0.1)
    assert preset(model=name, width_px=2160, height_px=3840).matrix[0, 0] == pytest.approx(2702.8, abs=0.1)


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("iPhone 3G", None),
        (None, None),
        ("iPhone 13", "iPhone 13 front camera 2.71mm f/2.2"),
        ("iPhone 13", "1.54mm f/2.4"),
        ("iPhone 13 Pro", "iPhone 13 Pro back telephoto camera 9mm f/2.8"),
    ],
)
def test_no_preset(model, lens):
    assert preset_camera(video_info(model=model, lens=lens)) is None
    assert find_camera(video_info(model=model, lens=lens)).source.startswith("guess")


def test_a_preset_scales_and_turns_with_the_recording():
    of_phone = functools.partial(preset, model="iPhone 11")
    portrait = of_phone()
    points = np.array([[0.3, -0.2, 2.0], [-0.4, 0.6, 2.5], [0.1, 0.9, 3.0]])
    seen = _project(points, portrait)
    # 1080p portrait: the same view, 1.5 times as many pixels.
    larger = of_phone(width_px=1080, height_px=1920)
    np.testing.assert_allclose(_project(points, larger) + 0.5, 1.5 * (seen + 0.5), atol=1e-6)
    # The phone turned counter-clockwise (flag 0): right in the portrait picture is up, so (x, y) -> (y, W - 1 - x).
    level = of_phone(width_px=1280, height_px=720, rotation_deg=0)
    np.testing.assert_allclose(
        _project(points @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), level),
        np.stack([seen[:, 1], 719 - seen[:, 0]], 1),
        atol=1e-6,
    )
    on_its_head = of_phone(width_px=1280, height_px=720, rotation_deg=180)
    np.testing.assert_allclose(
        _project(points @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), on_its_head),
        np.stack([1279 - seen[:, 1], seen[:, 0]], 1),
        atol=1e-6,
    )
    # Upright, the phone on its head (flag 270): half a turn.
    upside_down = of_phone(rotation_deg=270)
    np.testing.assert_allclose(_project(points * [-1, -1, 1], upside_down), [719, 1279] - seen, atol=1e-6)
    # Copies whose pictures were turned: the shape tells more than the flag.
    for width, height, flag, same in ((720, 1280, 0, portrait), (1280, 720, 90, level)):
        copy = of_phone(width_px=width, height_px=height, rotation_deg=flag)
        np.testing.assert_array_equal(copy.matrix, same.matrix)


def test_four_quarter_turns_are_none():
    matrix, distortion = np.array([[900.0, 0, 300], [0, 910, 600], [0, 0, 1]]), np.array([0.1, -0.2, 0.01, -0.02, 0.3])
    turned, bent = matrix, distortion
    for width in (720, 1280, 720, 1280):
        turned, bent = quarter_turn(turned, bent, width)
    np.testing.assert_allclose(turned, matrix)
    np.testing.assert_allclose(bent, distortion)


def test_every_preset_holds_over_the_whole_picture():
    for model in presets()["names"]:
        for width, height, turned in ((720, 1280, 90), (1920, 1080, 0), (1440, 1080, 180)):
            camera = preset(model=model, width_px=width, height_px=height, rotation_deg=turned)
            assert reaches_corners(camera.matrix, camera.distortion, (width, height))


def test_the_uncertainty_is_kept_with_the_keypoints(tmp_path):
    lens = Camera(np.array([[900.0, 0, 500], [0, 900, 500], [0, 0, 1]]), np.zeros(5), "preset: x", 0.04)
    keypoints(camera=lens).save(tmp_path / "k.npz")
    assert Keypoints.load(tmp_path / "k.npz").camera.focal_rel_sd == 0.04
    keypoints().save(tmp_path / "without.npz")
    assert np.isnan(Keypoints.load(tmp_path / "without.npz").camera.focal_rel_sd)
    with np.load(tmp_path / "without.npz") as f:
        assert "focal_rel_sd" not in f.files


def _project(points: np.ndarray, camera: Camera) -> np.ndarray:
    flat, _ = cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return flat.reshape(-1, 2)


# --- the kind of a source
@pytest.mark.parametrize(
    ("source", "kind", "calibrated"),
    [
        ("measured: camera.json, of apple-iphone-13", "measured", True),
        ("file: camera.json", "file", True),
        ("metadata: 27 mm on 35 mm film", "metadata", False),
        ("preset: iPhone 13", "preset", False),
        ("guess: 70 deg", "guess", False),
        ("a stand of ours, measured: 2020", "other", False),
    ],
)
def test_the_kind_of_a_source(source: str, kind: str, calibrated: bool):
    camera = Camera(np.eye(3), np.zeros(5), source)
    assert (camera.kind, camera.calibrated) == (kind, calibrated)
    assert camera.kind in CAMERA_KINDS


def test_the_column_knows_every_kind():
    from pbl_schemas.keypoints import Keypoints

    line = next(line for line in Keypoints.definition.splitlines() if line.strip().startswith("camera_kind"))
    assert re.findall(r"'(\w+)'", line) == list(CAMERA_KINDS)
