"""Decoding by the process that owns the GPU, here with FFmpeg in the place of the GPU's decoder."""

import contextlib
import dataclasses
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import pytest

from pbl_pipeline.models import nvdec
from pbl_pipeline.models.gpu_server import Server
from pbl_pipeline.video import decode, frames_kept, gpu_decoding, probe, read_frames, release_frames
from tests import Environment, Machine, StandIn, refused
from tests.videos import constant_rate, noise_frames, write_video


class FFmpegDecoder:
    """`nvdec.Nvdec` without a GPU."""

    def __init__(self) -> None:
        self.n_connections = self.n_videos = 0
        self.error = ""
        self.changed = False  # decode to other pictures
        self.server: Server

    @contextlib.contextmanager
    def pinned(self, memory: np.ndarray) -> Iterator[None]:
        self.n_connections += 1
        yield

    def decode(
        self, codec: str, size_px: tuple[int, int], packets: Iterable[tuple[int, bytes]], into: np.ndarray
    ) -> list[int]:
        if self.error:
            raise RuntimeError(self.error)
        context = av.VideoCodecContext.create(codec, "r")
        assert isinstance(context, av.VideoCodecContext)
        frames = []
        for stamp, data in packets:
            packet = av.Packet(data)
            packet.pts = stamp
            frames += context.decode(packet)
        frames += context.decode(None)
        for frame, to in zip(frames, into, strict=True):
            assert (frame.width, frame.height) == tuple(size_px)
            to[:] = frame.reformat(format="nv12").to_ndarray() ^ self.changed
        self.n_videos += 1
        return [frame.pts for frame in frames]


@pytest.fixture
def decoder(tmp_path: Path, machine: Machine) -> Iterator[FFmpegDecoder]:
    found = FFmpegDecoder()
    address = str(tmp_path / "gpu.sock")
    found.server = Server(address, any_device=True, idle_s=float("inf"), decoder=cast(nvdec.Nvdec, found))
    threading.Thread(target=found.server.run, daemon=True).start()
    machine(gpu=address)
    yield found
    gpu_decoding.release()
    found.server.close()


def pictures(path: Path) -> list[tuple[float, bytes]]:
    return [(f.time_s, f.image.tobytes()) for f in read_frames(path)]


def video(folder: Path, name: str = "a", suffix: str = "mp4", **options: Any) -> Path:
    return write_video(folder / f"{name}.{suffix}", noise_frames(12), constant_rate(12), **options)


@pytest.mark.parametrize(
    "options", [{"b_frames": 2, "rotation_deg": 90}, {"codec": "libx265"}, {"pixel_format": "yuvj420p"}]
)
def test_pictures_and_facts_are_those_of_ffmpeg(
    decoder: FFmpegDecoder, tmp_path: Path, options: dict[str, Any]
) -> None:
    path = video(tmp_path, **options)
    expected, facts = pictures(path), probe(path)
    assert not decoder.n_videos
    with frames_kept():
        found = probe(path)
        np.testing.assert_array_equal(found.time_s, facts.time_s)
        others = [field.name for field in dataclasses.fields(facts) if field.name != "time_s"]
        assert [getattr(found, name) for name in others] == [getattr(facts, name) for name in others]
        assert decoder.n_videos == 1
        assert pictures(path) == expected


def test_memory_serves_the_next_video_once_no_picture_is_used(decoder: FFmpegDecoder, tmp_path: Path) -> None:
    with frames_kept():
        probe(path := video(tmp_path))
        held, expected = next(read_frames(path, 1)), pictures(path)[1][1]
        release_frames(memory=False)
        probe(video(tmp_path, "b", crf=40))
        assert decoder.n_connections == 2  # the memory of the first is still used
        assert held.image.tobytes() == expected
        for name in "abab":
            release_frames(memory=False)
            probe(tmp_path / f"{name}.mp4")
        assert (decoder.n_videos, decoder.n_connections) == (6, 2)


def test_a_stage_alone_is_decoded_by_the_gpu_and_leaves_what_is_kept(decoder: FFmpegDecoder, tmp_path: Path) -> None:
    path, other = video(tmp_path), video(tmp_path, "b", crf=40)
    expected, of_other = pictures(path)[2:7], pictures(other)
    with frames_kept():
        for n in (1, 2):
            assert [(f.time_s, f.image.tobytes()) for f in read_frames(path, 2, 7)] == expected
            assert decoder.n_videos == n  # nothing of it is kept
        probe(path)
        assert pictures(other) == of_other
        assert decoder.n_videos == 3
        assert [(f.time_s, f.image.tobytes()) for f in read_frames(path, 2, 7)] == expected
        assert decoder.n_videos == 3
    assert pictures(path)[2:7] == expected
    assert decoder.n_videos == 3


def unusual(folder: Path, kind: str) -> Path:
    if kind == "more colour":
        return video(folder, pixel_format="yuv444p")
    if kind == "ten bits":
        return video(folder, codec="libx265", pixel_format="yuv420p10le")
    if kind == "no count of pictures":
        return video(folder, suffix="mkv")
    if kind == "a height that is not a multiple of four":
        lower = (picture[:62] for picture in noise_frames(12))
        return write_video(folder / "a.mp4", lower, constant_rate(12))
    if kind == "another codec":
        return video(folder, codec="mpeg4", ticks_per_s=30)
    return video(folder)


@pytest.mark.parametrize(
    "kind",
    [
        "more colour",
        "ten bits",
        "another codec",
        "a height that is not a multiple of four",
        "no count of pictures",
        "more than announced",
        "an error",
        "other pictures",
        "no room",
    ],
)
def test_ffmpeg_decodes_all_else(
    monkeypatch: pytest.MonkeyPatch, decoder: FFmpegDecoder, tmp_path: Path, kind: str, stand_in: StandIn
) -> None:
    path = unusual(tmp_path, kind)
    expected = pictures(path)
    decoder.error, decoder.changed = "damage" * (kind == "an error"), kind == "other pictures"
    if kind == "more than announced":
        monkeypatch.setattr(decode.Decoder, "n_announced", property(lambda _: 11))
    if kind == "no room":
        stand_in(share_of_memory=lambda: 8e4)
    with frames_kept():
        assert probe(path).n_frames == 12
        assert pictures(path) == expected
    assert decoder.n_videos == (kind == "other pictures")


def test_ffmpeg_decodes_where_the_gpu_is_not_wanted_or_has_no_decoder(
    environment: Environment, decoder: FFmpegDecoder, tmp_path: Path
) -> None:
    path = video(tmp_path)
    with frames_kept():
        decoder.server._decoder = None
        assert probe(path).n_frames == 12
        environment(PBL_ONNX_DEVICE="cpu")
        assert probe(path).n_frames == 12
    assert not decoder.n_connections


def test_zeros_inside_are_damage_though_the_gpu_may_pass_over_them(decoder: FFmpegDecoder, tmp_path: Path) -> None:
    path = video(tmp_path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    path.write_bytes(data)
    with frames_kept():
        refused("VIDEO_DAMAGED", probe, path)
    assert not decoder.n_videos


@pytest.mark.skipif(Path("/proc/driver/nvidia").exists(), reason="NVIDIA's driver is here")
def test_nvdec_needs_the_driver() -> None:
    with pytest.raises(RuntimeError, match="libcuda"):
        nvdec.Nvdec()
