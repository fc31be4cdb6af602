"""Probe and frames against files whose frames, stamps and damage are known, and against OpenCV as a second decoder."""

import dataclasses
import errno
import gc
import hashlib
import io
import json
import os
import random
import shutil
import struct
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.container import OutputContainer

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.video import (
    Frame,
    VideoInfo,
    check_file,
    decode,
    frames,
    frames_kept,
    guess_camera,
    kept,
    load_camera,
    packet_times,
    probe,
    read_first,
    read_frames,
    release_frames,
)
from pbl_pipeline.video.coded_units import is_damaged
from research.benchmarks.hostile import KINDS
from tests import Faults, Limits, StandIn, refused
from tests.guard import guarded
from tests.integration import chain
from tests.quicktime import box
from tests.videos import constant_rate, noise_frames, numbered_frames, write_video

VARIABLE_S = np.cumsum(np.r_[0.0, np.random.default_rng(0).uniform(0.01, 0.05, 39)])


def grey(frame: Frame) -> int:
    """The number that `numbered_frames` wrote into the middle of the picture."""
    h, w = frame.image.shape[:2]
    return round(float(frame.image[h // 2 - 4 : h // 2 + 4, w // 2 - 4 : w // 2 + 4].mean()) / 8)


def stream_in(
    container: OutputContainer, codec: str, size: tuple[int, int], pixel_format: str = "yuv420p"
) -> av.VideoStream:
    stream = container.add_stream(codec, rate=30)
    assert isinstance(stream, av.VideoStream)
    (stream.width, stream.height), stream.pix_fmt = size, pixel_format
    return stream


def code_of(path: Path) -> str:
    with pytest.raises(PblError) as error:
        probe(path)
    assert error.value.key == str(path)
    return error.value.code


# --- what a whole file says


@pytest.mark.parametrize(
    ("suffix", "codec", "container", "decoder"),
    [
        ("mp4", "libx264", "mp4", "h264"),
        ("mov", "libx264", "mov", "h264"),
        ("mp4", "libx265", "mp4", "hevc"),
        ("mkv", "libx264", "matroska", "h264"),
        ("webm", "libvpx-vp9", "matroska", "vp9"),
        ("ts", "libx264", "mpegts", "h264"),
    ],
)
def test_variable_frame_rate_stamps_are_the_containers(tmp_path, suffix, codec, container, decoder):
    b_frames = 2 if "x26" in codec else 0
    path = write_video(tmp_path / f"v.{suffix}", numbered_frames(40), VARIABLE_S, codec, b_frames=b_frames)
    info = probe(path)
    tick = 1e-3 if container == "matroska" else 1 / 90_000
    assert info.n_frames == 40
    assert info.time_s[0] == 0.0
    assert np.abs(info.time_s - VARIABLE_S).max() <= 0.501 * tick
    assert info.variable_frame_rate
    assert info.fps == pytest.approx(1 / np.median(np.diff(VARIABLE_S)), rel=0.05)
    assert info.duration_s == pytest.approx(VARIABLE_S[-1] + 1 / info.fps, abs=2e-3)
    assert (info.width_px, info.height_px, info.rotation_deg) == (96, 64, 0)
    assert (info.container, info.codec, info.pixel_format) == (container, decoder, "yuv420p")
    assert info.size_bytes == path.stat().st_size
    assert info.sha256 == sha256_of(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    assert info.notes == ()
    assert np.array_equal(packet_times(path), info.time_s)
    assert [grey(f) for f in read_frames(path)] == [i % 30 for i in range(40)]


@pytest.mark.parametrize(
    ("suffix", "fps"), [("mp4", 30.0), ("mp4", 59.94), ("mkv", 59.94), ("mkv", 240.0), ("avi", 30.0)]
)
def test_constant_rate_is_not_called_variable(tmp_path, suffix, fps):
    """MKV rounds stamps to 1 ms: at 240 per second they alternate between 4 and 5 ms without the rate varying."""
    options = {"codec": "mpeg4", "ticks_per_s": 30} if suffix == "avi" else {}
    info = probe(write_video(tmp_path / f"v.{suffix}", numbered_frames(60), constant_rate(60, fps), **options))
    assert info.n_frames == 60
    assert not info.variable_frame_rate
    assert info.fps == pytest.approx(fps, rel=0.05)


@pytest.mark.parametrize("fps", [24.0, 29.97, 30.0, 60.0, 240.0])
def test_rates_of_stamps_that_are_rounded_to_milliseconds(tmp_path, fps):
    """The median interval makes 30.30 of 30, 23.81 of 24 and 250 of 240; a dropped frame changes nothing."""
    for stamps in (constant_rate(120, fps), np.delete(constant_rate(120, fps), [40, 71])):
        info = probe(write_video(tmp_path / "v.mkv", numbered_frames(len(stamps)), stamps, ticks_per_s=1000))
        assert info.fps == pytest.approx(fps, rel=1e-3)
        assert info.duration_s == pytest.approx(120 / fps, abs=2e-3)


def test_one_missing_frame_makes_the_rate_variable(tmp_path):
    info = probe(write_video(tmp_path / "v.mp4", numbered_frames(29), np.delete(constant_rate(30), 12)))
    assert info.variable_frame_rate
    assert info.fps == pytest.approx(30.0)


def test_a_single_frame_has_the_announced_rate(tmp_path):
    info = probe(write_video(tmp_path / "v.mkv", numbered_frames(1), [0.0]))
    assert info.n_frames == 1
    assert not info.variable_frame_rate
    assert info.fps == pytest.approx(30.0)


def test_read_frames_selects_by_index_and_keeps_the_stamps_of_probe(tmp_path):
    path = write_video(tmp_path / "v.mp4", numbered_frames(40), VARIABLE_S, b_frames=2)
    info = probe(path, threads=1)
    for start, stop, step in (
        (0, None, 1),
        (7, None, 1),
        (0, 10, 1),
        (5, 30, 4),
        (38, 90, 1),
        (5, 5, 1),
        (50, None, 1),
    ):
        frames = list(read_frames(path, start, stop, step, threads=3))
        assert [f.index for f in frames] == list(range(40))[start:stop:step]
        assert [f.time_s for f in frames] == info.time_s[start:stop:step].tolist()
        assert [grey(f) for f in frames] == [i % 30 for i in range(40)][start:stop:step]
    with pytest.raises(ValueError, match="step"):
        read_frames(path, step=0)
    with pytest.raises(ValueError, match="start"):
        read_frames(path, start=-1)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_pictures_are_bgr_and_as_a_player_shows_them(tmp_path, rotation, mirrored):
    """The picture has a blue block top left and a red one bottom right, and OpenCV turns it the same way."""
    path = write_video(tmp_path / "v.mp4", numbered_frames(3), constant_rate(3), rotation_deg=rotation, hflip=mirrored)
    with av.open(str(path)) as container:
        stored = next(container.decode(video=0))
        assert (stored.width, stored.height) == ((96, 64) if rotation % 180 == 0 else (64, 96))
    info = probe(path)
    assert (info.width_px, info.height_px, info.rotation_deg) == (96, 64, rotation)
    assert any("mirrored" in note for note in info.notes) == mirrored
    image = next(read_frames(path)).image
    assert (image.shape, image.dtype, image.flags.c_contiguous) == ((64, 96, 3), np.uint8, True)
    blue, red = (-4, 4) if mirrored else (4, -4)
    np.testing.assert_allclose(image[4, blue], (255, 0, 0), atol=12)
    np.testing.assert_allclose(image[-4, red], (0, 0, 255), atol=12)
    if not mirrored:
        assert cv2.VideoCapture(str(path)).read()[1].shape == image.shape
        assert np.abs(image.astype(float) - cv2.VideoCapture(str(path)).read()[1]).mean() < 4


def test_metadata_of_a_phone(tmp_path):
    metadata = {
        "com.apple.quicktime.creationdate": "2024-05-01T09:30:00+0200",
        "com.apple.quicktime.make": "Apple",
        "com.apple.quicktime.model": "iPhone 12",
    }
    options = {"movflags": "use_metadata_tags"}
    info = probe(
        write_video(tmp_path / "v.mov", numbered_frames(2), [0, 0.1], metadata=metadata, container_options=options)
    )
    assert (info.recorded_utc, info.make, info.model) == ("2024-05-01T07:30:00Z", "Apple", "iPhone 12")
    assert info.container == "mov"


@pytest.mark.parametrize("written", [None, "1904-01-01T00:00:00Z", "1970-01-01T00:00:00Z"])
def test_unknown_recording_time_is_none(tmp_path, written):
    metadata = {"creation_time": written} if written else {}
    info = probe(write_video(tmp_path / "v.mp4", numbered_frames(2), [0, 0.1], metadata=metadata))
    assert (info.recorded_utc, info.make, info.model) == (None, None, None)


# --- edit lists, and the recordings that have them


@pytest.fixture
def with_edit_list(tmp_path) -> Path:
    """Stamps below zero become an edit list: a player begins at the 21st picture."""
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled", "use_editlist": "1"}) as container:
        stream = stream_in(container, "libx264", (96, 64))
        for i, image in enumerate([*numbered_frames(60), None]):
            frame = None
            if image is not None:
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts, frame.time_base = i, Fraction(1, 30)
            for packet in stream.encode(frame):
                assert packet.pts is not None
                assert packet.dts is not None
                packet.pts, packet.dts = packet.pts - 20, packet.dts - 20
                container.mux(packet)
    return path


def test_frames_that_an_edit_list_hides_do_not_count(with_edit_list):
    path = with_edit_list
    info = probe(path)
    assert (info.n_frames, info.n_frames_announced) == (40, 60)
    assert info.notes == ("20 frames are hidden by the file's edit list and do not count",)
    np.testing.assert_allclose(info.time_s, constant_rate(40), atol=1e-4)
    np.testing.assert_allclose(packet_times(path), info.time_s, atol=1e-9)
    assert [grey(f) for f in read_frames(path)] == [(20 + i) % 30 for i in range(40)]


def test_frames_that_are_announced_and_cannot_be_counted_are_lost(with_edit_list, monkeypatch, faults):
    """A header that lies about sizes: FFmpeg opens the file as a player does, and not without its edit list."""
    monkeypatch.setattr(decode.Decoder, "n_announced", property(lambda _: 100))
    faults(decode, "_count_packets", MemoryError(12, "Cannot allocate memory"))
    assert "Cannot allocate memory" in refused("VIDEO_TRUNCATED", probe, with_edit_list).found


@pytest.mark.slow
@pytest.mark.parametrize(("clip", "n_frames", "n_announced"), [("walk", 75, 271), ("STS", 798, 841)])
def test_real_clips_with_edit_lists(shared_data, clip, n_frames, n_announced):
    """OpenCV decodes as many (../shared/data/README.md); the header announces more, and the file is whole."""
    path = shared_data / "real" / "video_mocap" / clip / "video.mp4"
    info = probe(path, threads=2)
    assert (info.n_frames, info.n_frames_announced) == (n_frames, n_announced)
    assert (info.width_px, info.height_px) == (720, 1280)
    assert not info.variable_frame_rate
    assert info.fps == pytest.approx(60.0)
    assert len(info.notes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("file", ["video_mocap/walk/video.mp4", "multiview/cam01.mp4", "multiview/cam02.mp4"])
def test_real_clips_decode_as_in_opencv(shared_data, file):
    path = shared_data / "real" / file
    capture = cv2.VideoCapture(str(path))
    for frame in read_frames(path, threads=2):
        there, theirs = capture.read()
        assert there
        if frame.index % 20 == 0:
            assert np.abs(frame.image.astype(np.int16) - theirs).mean() < 2.0
            assert frame.time_s * 1000 == pytest.approx(capture.get(cv2.CAP_PROP_POS_MSEC), abs=1.0)
    assert not capture.read()[0]


# --- files that are not whole videos


def test_missing_and_empty(tmp_path):
    assert code_of(tmp_path / "absent.mp4") == "VIDEO_MISSING"
    assert code_of(tmp_path) == "VIDEO_MISSING"
    (tmp_path / "empty.mp4").touch()
    assert code_of(tmp_path / "empty.mp4") == "VIDEO_EMPTY"
    refused("VIDEO_MISSING", read_frames, tmp_path / "absent.mp4")  # at the call, not at the first frame
    refused("VIDEO_EMPTY", check_file, tmp_path / "empty.mp4")


@pytest.mark.parametrize("name", ["lost_end.mp4", "text.mp4"])
def test_a_disk_that_fails_is_no_fault_of_the_recording(tmp_path, monkeypatch, name):
    """FFmpeg takes what it cannot read for the end of the file."""
    path = write_video(tmp_path / "whole.mp4", numbered_frames(10), constant_rate(10))
    content = path.read_bytes()[:-2000] if name == "lost_end.mp4" else b"not a video" * 1000
    lost = tmp_path / name
    lost.write_bytes(content)
    assert code_of(lost) in ("VIDEO_TRUNCATED", "VIDEO_NOT_A_VIDEO")

    def fails(file: io.BufferedReader, *n: int) -> bytes:
        if file.tell() and n == (1 << 20,):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return io.BufferedReader.read(file, *n)

    reader = type("Failing", (io.BufferedReader,), {"read": fails})
    monkeypatch.setattr(Path, "open", lambda self, *_, **__: reader(io.FileIO(self)))
    assert refused("VIDEO_MISSING", probe, lost).found == "the file cannot be read (Input/output error)"


def test_not_a_video(tmp_path):
    text, picture, noise, sound = (tmp_path / n for n in ("text.mp4", "picture.mp4", "noise.mov", "sound.mp4"))
    text.write_text("#EXTM3U\n#EXTINF:10,\nother.mp4\n")  # also a playlist, which must not be followed
    cv2.imwrite(str(tmp_path / "p.png"), np.zeros((64, 64, 3), np.uint8))
    picture.write_bytes((tmp_path / "p.png").read_bytes())
    noise.write_bytes(np.random.default_rng(0).bytes(50_000))
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        assert isinstance(stream, av.AudioStream)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    for path in (text, picture, noise, sound):
        assert code_of(path) == "VIDEO_NOT_A_VIDEO"


def encoded(suffix: str) -> bytes:
    return cv2.imencode(suffix, np.zeros((64, 64, 3), np.uint8))[1].tobytes()


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"\0\0\0\x18ftypheic" + bytes(1000), "HEIC"),
        (b"\0\0\0\x18ftypmif1" + bytes(1000), "HEIF"),
        (b"\xff\xd8\xff\xe0" + bytes(1000), "JPEG"),
        (b"RIFF\0\0\0\0WEBP" + bytes(1000), "WebP"),
        # These FFmpeg decodes.
        (encoded(".jpg"), "JPEG"),
        (encoded(".png"), "PNG"),
        (encoded(".tiff"), "TIFF"),
    ],
)
def test_a_photo_is_named_as_one(tmp_path, content, name):
    photo = tmp_path / "IMG_0001.mov"
    photo.write_bytes(content)
    for read in (probe, packet_times):
        assert refused("VIDEO_NOT_A_VIDEO", read, photo).found == f"a photo ({name})"


def on_a_screen(image: np.ndarray, top: int, bottom: int, side: int, grey: int) -> np.ndarray:
    """A picture between borders, with the clock, the progress bar and the handle of a phone's screen."""
    screen = cv2.copyMakeBorder(image, top, bottom, side, side, cv2.BORDER_CONSTANT, value=(grey,) * 3)
    if bottom:
        screen[8:20, 16:60] = 255
        screen[-30:-26, 10:-10] = screen[-10:-6, 60:-60] = 128
    return screen


def on_a_desktop(image: np.ndarray, i: int, wall: np.ndarray, dark: bool) -> np.ndarray:
    """A picture in a player's window before a picture on a desktop; the clock, the progress and the cursor move."""
    screen, (bar, text) = wall.copy(), ((45, 200) if dark else (230, 60))
    screen[60:80, 150:330] = screen[320:340, 150:330] = bar
    screen[66:74, 156:220], screen[328:331, 160 : 170 + 4 * i] = text, text
    screen[80:320, 150:330] = image
    screen[-24:], screen[-16:-8, -40 : -30 + i % 10] = 30, 220
    screen[20 + 5 * i : 30 + 5 * i, 340 + 2 * i : 346 + 2 * i] = 255
    return screen


@pytest.mark.parametrize(("left", "code"), [(1 << 20, "VIDEO_NOT_A_VIDEO"), (1 << 62, "MACHINE_SHORT")])
def test_too_little_memory_is_no_fault_of_the_file(
    tmp_path: Path, left: int, code: str, limits: Limits, faults: Faults
):
    """A file that asks for more than there is on a machine with memory, and a file on a machine without."""
    (tmp_path / "a.mp4").write_bytes(b"content")
    faults(decode.av, "open", MemoryError())
    limits(decode, _ENOUGH=left)
    refused(code, probe, tmp_path / "a.mp4")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_window_on_a_desktop_is_named_as_a_screen(tmp_path, dark):
    wall = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(384, 420, 3)), (0, 0), 12) * 800 + 120
    wall = wall.clip(0, 255).astype(np.uint8)
    frames = (on_a_desktop(image, i, wall, dark) for i, image in enumerate(scene(30)))
    assert code_of(write_video(tmp_path / "v.mp4", frames, constant_rate(30), crf=26)) == "VIDEO_SCREEN"


def scene(n: int) -> Iterator[np.ndarray]:
    """A person before a wall that is dark above: a flat background, and noise of the camera."""
    rng = np.random.default_rng(3)
    still = 120 + 25 * cv2.GaussianBlur(rng.normal(size=(240, 180, 3)), (0, 0), 8) * 28
    still[:60] = 40
    for i in range(n):
        image = still + rng.normal(0, 3, still.shape)
        image[90:200, 10 + 3 * i : 40 + 3 * i] = 200
        yield image.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("top", "bottom", "side", "grey"),
    [(70, 90, 0, 12), (90, 90, 20, 255), (0, 0, 60, 0)],
    ids=["a phone's player", "white, on all sides", "upright in a wide picture"],
)
def test_a_screen_recording_is_named_as_one(tmp_path, top, bottom, side, grey):
    frames = (on_a_screen(image, top, bottom, side, grey) for image in scene(30))
    assert code_of(write_video(tmp_path / "v.mp4", frames, constant_rate(30), crf=28)) == "VIDEO_SCREEN"


def test_a_dark_room_a_doorway_and_a_flat_picture_are_no_screen_recording(tmp_path):
    def dark(image: np.ndarray) -> np.ndarray:
        return (image * np.linspace(0, 1, 240)[:, None, None] ** 3).astype(np.uint8)

    def doorway(image: np.ndarray) -> np.ndarray:
        image[:200, :40] = image[:200, -50:] = 4
        return image

    def flat(image: np.ndarray) -> np.ndarray:
        return np.where(image == 200, image, 90).astype(np.uint8)

    def rail(image: np.ndarray) -> np.ndarray:
        image = cv2.GaussianBlur(image, (0, 0), 1.5)
        image[20:26] = image[150:154] = 10  # the person walks across one of them
        return image

    def steps(image: np.ndarray) -> np.ndarray:
        shelves = np.repeat(np.arange(0, 60, 10), 4)[:, None, None] * 4  # tilted by a third of a degree
        image[:24] = shelves
        turn = cv2.getRotationMatrix2D((90, 120), 0.33, 1.0)
        return cv2.GaussianBlur(cv2.warpAffine(image, turn, (180, 240), borderMode=cv2.BORDER_REPLICATE), (0, 0), 0.8)

    for change in (np.copy, dark, doorway, flat, rail, steps):
        frames = (change(image) for image in scene(30))
        assert probe(write_video(tmp_path / "v.mp4", frames, constant_rate(30))).n_frames == 30


@pytest.mark.slow
def test_no_recording_of_a_camera_is_taken_for_one_of_a_screen(shared_data):
    found = sorted((shared_data / "real").rglob("*.mp4"))
    assert len(found) == 6
    for path in found:
        assert probe(path).n_frames > 0


def test_not_one_frame_decodes(tmp_path):
    path = write_video(
        tmp_path / "v.mp4", noise_frames(10), constant_rate(10), container_options={"movflags": "+faststart"}
    )
    data = path.read_bytes()
    start = data.index(b"mdat") + 4
    path.write_bytes(data[:start] + bytes(len(data) - start))
    assert code_of(path) == "VIDEO_NO_FRAMES"


CONTAINERS = {
    "index first": ("mp4", "libx264", {"movflags": "+faststart"}),
    "index first, hevc": ("mov", "libx265", {"movflags": "+faststart"}),
    "index last": ("mp4", "libx264", {}),
    "fragments": ("mp4", "libx264", {"movflags": "frag_keyframe+empty_moov"}),
    "matroska": ("mkv", "libx264", {}),
    "webm": ("webm", "libvpx-vp9", {}),
    "avi": ("avi", "mpeg4", {}),
    "transport stream": ("ts", "libx264", {}),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    made = {}
    for name, (suffix, codec, options) in CONTAINERS.items():
        path = folder / f"{name.replace(' ', '_').replace(',', '')}.{suffix}"
        b_frames, ticks = (2 if "x26" in codec else 0), (30 if suffix == "avi" else 90_000)
        made[name] = write_video(
            path,
            noise_frames(40),
            constant_rate(40),
            codec,
            b_frames=b_frames,
            gop=10,
            ticks_per_s=ticks,
            container_options=options,
        )
    return made


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_file_cut_anywhere_in_its_pictures_is_truncated(whole, tmp_path, name):
    assert probe(whole[name]).n_frames == 40
    data = whole[name].read_bytes()
    for part in (0.15, 0.5, 0.97):
        path = tmp_path / f"{part}{whole[name].suffix}"
        path.write_bytes(data[: int(part * len(data))])
        assert code_of(path) == "VIDEO_TRUNCATED", part
        refused("VIDEO_TRUNCATED", lambda path: list(read_frames(path, threads=1)), path)


@pytest.mark.parametrize("name", ["index first", "index first, hevc", "matroska", "webm", "fragments"])
def test_a_file_whose_end_is_zeros_is_truncated(whole, tmp_path, name):
    """What a copy leaves that reserved the whole length and then broke off."""
    data = whole[name].read_bytes()
    path = tmp_path / f"v{whole[name].suffix}"
    path.write_bytes(data[: int(0.6 * len(data))] + bytes(len(data) - int(0.6 * len(data))))
    assert code_of(path) == "VIDEO_TRUNCATED"


def test_a_whole_recording_whose_first_stamp_is_not_0(tmp_path):
    """Recorders in a browser and cuts of a stream begin anywhere; FFmpeg counts the length from 0."""
    later = write_video(
        tmp_path / "a.mkv",
        numbered_frames(30),
        5 + constant_rate(30),
        ticks_per_s=1000,
        container_options={"avoid_negative_ts": "disabled"},
    )
    flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}
    cut = write_video(tmp_path / "a.mp4", numbered_frames(30), constant_rate(30), container_options=flags)
    data, at = bytearray(cut.read_bytes()), 0
    while (at := data.find(b"tfdt", at + 1)) > 0:
        (begins,) = struct.unpack_from(">Q", data, at + 8)
        struct.pack_into(">Q", data, at + 8, begins + 5 * 90_000)
    cut.write_bytes(data)
    for path in (later, cut):
        info = probe(path)
        assert (info.n_frames, info.time_s[0]) == (30, 0.0)
        assert info.duration_s == pytest.approx(1.0, abs=2e-3)


def test_truncation_says_what_is_left_and_what_to_do(whole, tmp_path):
    path = tmp_path / "v.mp4"
    data = whole["index first"].read_bytes()
    path.write_bytes(data[: len(data) // 2])
    error = refused("VIDEO_TRUNCATED", probe, path)
    assert "frames" in error.found
    assert f"the file at {len(data) // 2}" in error.found
    assert "copy" in error.next_step
    data = whole["index last"].read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert "nothing of it can be read" in refused("VIDEO_TRUNCATED", probe, path).found


@pytest.mark.parametrize("n", [64, 6000])
@pytest.mark.parametrize("name", ["index first", "index first, hevc"])
def test_damage_inside_is_not_passed_over(whole, tmp_path, name, n):
    data = bytearray(whole[name].read_bytes())
    middle = len(data) // 2
    data[middle : middle + n] = bytes(n)
    path = tmp_path / f"v{whole[name].suffix}"
    path.write_bytes(data)
    assert code_of(path) == "VIDEO_DAMAGED"


@pytest.mark.parametrize(
    ("codec", "configuration", "slice_", "other"),
    [("h264", b"\1\0\0\0\xff", b"\x65", b"\x06"), ("hevc", b"\1" + bytes(20) + b"\xff", b"\x26\1", b"\x4e\1")],
)
def test_what_no_coded_slice_contains(codec, configuration, slice_, other):
    def damaged(*units, cut=0):
        packet = b"".join(len(unit).to_bytes(4, "big") + unit for unit in units)
        return is_damaged(context, packet[: len(packet) - cut])

    context = av.CodecContext.create(codec, "r")
    context.extradata = configuration
    whole = slice_ + b"abc\0\0\3\0d"
    assert not damaged(other, whole)
    assert not damaged(whole, whole + bytes(5))  # zeros behind it
    assert not damaged(other + b"\0\0\0a", whole)  # not of a picture
    assert damaged(whole, slice_ + b"ab\0\0\0c")
    assert damaged(whole, whole, cut=1)
    assert damaged(b"", whole)
    context.extradata = None
    assert not damaged(slice_ + b"ab\0\0\0c")  # units with start codes


def _with_stamps(path: Path, times_s: list[float]) -> Path:
    """An MKV whose packets carry these stamps, in any order."""
    with av.open(str(path), "w") as container:
        stream = stream_in(container, "mjpeg", (96, 64), "yuvj420p")
        for image, t in zip(numbered_frames(len(times_s)), times_s, strict=True):
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")):
                packet.time_base = Fraction(1, 1000)
                packet.pts = packet.dts = round(1000 * t)
                container.mux(packet)
    return path


def test_a_repeated_stamp_is_left_out_and_said(tmp_path):
    times = constant_rate(200, 25.0)
    times[50] = times[49]
    path = _with_stamps(tmp_path / "v.mkv", times.tolist())
    info = probe(path)
    np.testing.assert_allclose(info.time_s, np.delete(times, 50), atol=1e-9)
    assert info.notes == ("1 frames whose time stamp repeats or runs backwards do not count",)
    assert [grey(f) for f in read_frames(path)] == [i % 30 for i in range(200) if i != 50]


def test_stamps_that_cannot_be_trusted(tmp_path):
    assert (
        code_of(_with_stamps(tmp_path / "v.mkv", np.repeat(constant_rate(20, 25.0), 2).tolist())) == "VIDEO_TIMESTAMPS"
    )
    raw = write_video(tmp_path / "v.h264", numbered_frames(10), constant_rate(10))  # a stream without a container
    assert code_of(raw) == "VIDEO_TIMESTAMPS"


def test_a_changing_picture_size_is_refused(tmp_path):
    path = tmp_path / "v.ts"
    parts = [
        write_video(tmp_path / f"{h}.ts", numbered_frames(10, h, 96), constant_rate(10), gop=5).read_bytes()
        for h in (64, 128)
    ]
    path.write_bytes(b"".join(parts))
    assert code_of(path) == "VIDEO_DAMAGED"


# --- memory


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_pictures_that_are_too_large_are_refused_before_one_is_decoded(tmp_path):
    large = write_video(tmp_path / "large.mp4", numbered_frames(1, 4352, 4352), [0.0])
    for read in (probe, read_first, lambda path: next(read_frames(path))):
        with guarded() as peak:
            assert "4352x4352" in refused("VIDEO_TOO_LARGE", read, large).found
        assert peak.grown_mib < 50
    # The container names another size than the pictures have.
    data, size = large.read_bytes(), struct.pack(">HH", 4352, 4352)
    assert data.count(size) == 1
    (tmp_path / "lying.mp4").write_bytes(data.replace(size, struct.pack(">HH", 64, 64)))
    with guarded() as peak:
        assert code_of(tmp_path / "lying.mp4").startswith("VIDEO_")
    assert peak.grown_mib < 50


@pytest.mark.parametrize("large_first", [True, False])
def test_of_two_video_streams_the_largest_is_taken_and_said(tmp_path, large_first):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        sides = (128, 64) if large_first else (64, 128)
        streams = [stream_in(container, "libx264", (side, side)) for side in sides]
        for i in range(5):
            for stream in streams:
                frame = av.VideoFrame.from_ndarray(np.zeros((stream.height, stream.width, 3), np.uint8), format="bgr24")
                frame.pts = i
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    info = probe(path)
    assert (info.width_px, info.n_frames) == (128, 5)
    assert "2 video streams: the one with the largest picture is used (128x128 px)" in info.notes
    assert next(read_frames(path)).image.shape == (128, 128, 3)


@pytest.mark.parametrize(
    "length", [b"\x01" + b"\xff" * 6 + b"\xfe", b"\x08\xff\xff\xff\xff", b"\x01" + bytes(7), b"\0"]
)
def test_a_webm_with_an_odd_length(tmp_path, length):
    path = tmp_path / "v.webm"
    path.write_bytes(b"\x1a\x45\xdf\xa3" + length + bytes(100))
    assert code_of(path) in ("VIDEO_TRUNCATED", "VIDEO_NOT_A_VIDEO")


def test_a_file_of_millions_of_boxes(tmp_path):
    many = box(b"ftyp", b"isom" + bytes(4)) + box(b"free", b"") * 2_000_000
    (tmp_path / "many.mp4").write_bytes(many)
    assert code_of(tmp_path / "many.mp4").startswith("VIDEO_")


def test_memory_does_not_grow_with_the_length(tmp_path):
    """3,000 frames of 58 KB are 173 MB; between the first third and the end the process may grow by 12 MB."""
    pictures = list(numbered_frames(30, 120, 160))
    path = write_video(tmp_path / "v.mp4", (pictures[i % 30] for i in range(3000)), constant_rate(3000))
    at_third, n = 0.0, 0
    for frame in read_frames(path, threads=2):
        n += 1
        if frame.index == 1000:
            at_third = _resident_mb()
    assert n == 3000
    assert _resident_mb() - at_third < 12
    before = _resident_mb()
    assert probe(path, threads=2).n_frames == 3000
    assert _resident_mb() - before < 12


# --- cameras


def _toml(path: Path, **changes: str) -> Path:
    fields = {
        "size": "[1920, 1080]",
        "matrix": "[[1500.0, 0.0, 960.0], [0.0, 1510.0, 540.0], [0.0, 0.0, 1.0]]",
        "distortions": "[0.1, -0.2, 0.001, 0.002]",
        "fisheye": "false",
    } | changes
    body = "\n".join(f"{key} = {value}" for key, value in fields.items() if value)
    path.write_text(f'[cam]\nname = "cam"\n{body}\n[metadata]\nerror = 0.0\n')
    return path


def test_camera_from_toml(tmp_path):
    camera = load_camera(_toml(tmp_path / "c.toml"), (1920, 1080))
    np.testing.assert_array_equal(camera.matrix, [[1500, 0, 960], [0, 1510, 540], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [0.1, -0.2, 0.001, 0.002, 0])
    assert camera.source == "file: c.toml [cam]"


def test_camera_scales_with_the_picture(tmp_path):
    """Halved: the point at the middle of a pixel block stays it, so cx = (960 + 0.5) / 2 - 0.5 = 479.75."""
    camera = load_camera(_toml(tmp_path / "c.toml"), (960, 540))
    np.testing.assert_allclose(camera.matrix, [[750, 0, 479.75], [0, 755, 269.75], [0, 0, 1]])
    assert "scaled by 0.5 from 1920x1080" in camera.source


def test_camera_from_json(tmp_path):
    path = tmp_path / "c.json"
    matrix = [[900.0, 0, 360], [0, 901.0, 640], [0, 0, 1]]
    path.write_text(
        json.dumps({"camera_matrix": matrix, "distortion": [0.1, 0, 0, 0, 0.3], "image_size_px": [720, 1280]})
    )
    camera = load_camera(path, (720, 1280))
    np.testing.assert_array_equal(camera.matrix, matrix)
    np.testing.assert_array_equal(camera.distortion, [0.1, 0, 0, 0, 0.3])


@pytest.mark.parametrize(
    ("size", "changes"),
    [
        ((1920, 1088), {}),
        ((1080, 1920), {}),
        ((1920, 1080), {"matrix": "[[1500.0, 0.0], [0.0, 1510.0]]"}),
        ((1920, 1080), {"matrix": "[[-1500.0, 0.0, 960.0], [0.0, 1510.0, 540.0], [0.0, 0.0, 1.0]]"}),
        ((1920, 1080), {"matrix": "[[1500.0, 0.0, 960.0], [0.0, 1510.0, 2540.0], [0.0, 0.0, 1.0]]"}),
        ((1920, 1080), {"matrix": "[[nan, 0.0, 960.0], [0.0, 1510.0, 540.0], [0.0, 0.0, 1.0]]"}),
        ((1920, 1080), {"distortions": "[0.1, 0.2]"}),
        ((1920, 1080), {"distortions": ""}),
        ((1920, 1080), {"distortions": "[-2.0, 0.0, 0.0, 0.0]"}),
        ((1920, 1080), {"size": '["a", "b"]'}),
        ((1920, 1080), {"fisheye": "true"}),
        ((1920, 1080), {"size": "[1920, 1080"}),
    ],
)
def test_unusable_cameras(tmp_path, size, changes):
    path = _toml(tmp_path / "c.toml", **changes)
    assert refused("CAMERA_INVALID", load_camera, path, size).key == str(path)


def test_camera_file_of_several(shared_data, tmp_path):
    path = shared_data / "real" / "multiview" / "Calib_qualisys.toml"
    assert load_camera(path, (1088, 1920), "cam_02").matrix[0, 0] == pytest.approx(1673.73, abs=0.01)
    for name in (None, "cam_9"):
        refused("CAMERA_INVALID", load_camera, path, (1088, 1920), name)
    refused("CAMERA_INVALID", load_camera, tmp_path / "absent.toml", (1088, 1920))


@pytest.mark.parametrize("size", [(720, 1280), (1280, 720)])
def test_guess_is_stated(size):
    camera = guess_camera(size)
    assert camera.matrix[0, 0] == camera.matrix[1, 1] == pytest.approx(0.7169 * 1280)
    assert camera.matrix[:2, 2].tolist() == [(size[0] - 1) / 2, (size[1] - 1) / 2]
    assert not camera.distortion.any()
    assert camera.source.startswith("guess: ")
    assert "70 deg" in camera.source
    assert "-7 to +18 %" in camera.source


def test_guess_for_a_probed_video(tmp_path):
    info = probe(write_video(tmp_path / "v.mp4", numbered_frames(2), [0, 0.1], rotation_deg=90))
    assert isinstance(info, VideoInfo)
    np.testing.assert_array_equal(guess_camera(info).matrix, guess_camera((96, 64)).matrix)
    assert dataclasses.asdict(guess_camera(info))["source"] == guess_camera((96, 64)).source


def test_guess_is_the_median_of_the_published_figures(shared_data):
    published = json.loads((shared_data / "real" / "norms" / "opencap_iphone_intrinsics.json").read_text())
    ratios = [
        np.mean([c["intrinsicMat"][0][0], c["intrinsicMat"][1][1]]) / np.max(c["imageSize"]) for c in published.values()
    ]
    assert len(ratios) == 78
    assert guess_camera((1280, 720)).matrix[0, 0] / 1280 == pytest.approx(np.median(ratios), abs=1e-4)
    assert min(ratios) == pytest.approx(0.6655, abs=3e-4)
    assert max(ratios) == pytest.approx(0.8452, abs=3e-4)


# --- Pictures that are kept from `probe` for `read_frames`.


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "a.mp4", numbered_frames(8), constant_rate(8), rotation_deg=90)


def pictures(path: Path) -> list[tuple[int, float, np.ndarray]]:
    return [(f.index, f.time_s, f.image) for f in read_frames(path, 1, 6, 2)]


@pytest.fixture
def decodes(faults: Faults) -> Callable[[Path], bool]:
    """True if the pictures of a file are decoded to be read."""
    opened = faults(frames, "Decoder")

    def read(path: Path) -> bool:
        opened.clear()
        list(read_frames(path))
        return bool(opened)

    return read


def test_kept_pictures_are_those_of_the_file(decodes: Callable[[Path], bool], video: Path) -> None:
    expected = pictures(video)
    with frames_kept():
        probe(video)
        found = pictures(video)
        assert not decodes(video)
    for (i, at_s, image), (j, other_s, other) in zip(expected, found, strict=True):
        assert (i, at_s) == (j, other_s)
        np.testing.assert_array_equal(image, other)
    assert decodes(video)


def test_memory_of_kept_pictures_stays_for_the_next_ones_alone(
    monkeypatch: pytest.MonkeyPatch, video: Path, stand_in: StandIn
) -> None:
    stays = list[bool]()
    for module in (kept, decode):
        monkeypatch.setattr(module, "keep_large_blocks", stays.append)
    probe(video)
    assert not stays[-1]
    with frames_kept():
        probe(video)
        release_frames(memory=False)
        assert stays[-1]
        pictures(other_video(video))  # is decoded again each time
        assert not stays[-1]
        probe(video)
        assert stays[-1]
        for room in (2e5, 8e5):  # for none, and for some of the pictures
            stand_in(share_of_memory=lambda room=room: room)
            probe(video)
            assert not stays[-1]
        stand_in(share_of_memory=lambda: 2**30)
        probe(video)
        assert stays[-1]
    assert not stays[-1]


def other_video(video: Path) -> Path:
    return Path(shutil.copy(video, video.with_name("b.mp4")))


def test_nothing_is_kept_unless_asked_for(decodes: Callable[[Path], bool], video: Path) -> None:
    probe(video)
    assert decodes(video)


def test_another_file_and_a_changed_one_are_decoded(decodes: Callable[[Path], bool], video: Path) -> None:
    other = other_video(video)
    with frames_kept():
        probe(video)
        assert decodes(other)
        other.replace(video)
        assert decodes(video)


def test_a_released_one_and_one_without_room_are_decoded(
    decodes: Callable[[Path], bool], video: Path, stand_in: StandIn
) -> None:
    with frames_kept():
        probe(video)
        release_frames()
        assert decodes(video)
        for room in (2e5, 8e5):  # for none, and for some of the pictures
            stand_in(share_of_memory=lambda room=room: room)
            probe(video)
            assert decodes(video)


def test_released_pictures_do_not_wait_for_the_collector_of_cycles(video: Path) -> None:
    def n_pictures() -> int:
        return sum(isinstance(o, av.VideoFrame) for o in gc.get_objects())

    gc.collect()
    before = n_pictures()
    gc.disable()
    try:
        with frames_kept():
            probe(video)
            pictures(video)
            assert n_pictures() > before
        assert n_pictures() == before
    finally:
        gc.enable()


# --- Video files that lie about themselves: a result or a coded error, whatever their bytes say.


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_a_result_or_a_coded_error(tmp_path: Path, kind: str):
    good = chain.small_video(tmp_path, "good", n=40).read_bytes()
    path, codes = tmp_path / "damaged.mp4", set()
    for seed in range(60):
        path.write_bytes(KINDS[kind](good, random.Random(seed)))
        try:
            probe(path)
        except PblError as error:
            codes.add(error.code)
    assert codes
    assert all(code.startswith("VIDEO_") for code in codes)
