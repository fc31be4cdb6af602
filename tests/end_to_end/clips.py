"""Short videos cut from the demo recording: one good, the others what a lab's folder holds besides."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pbl_pipeline.video import read_frames
from tests.videos import constant_rate, write_video

#: Columns and rows in which she walks and he, on the wall above, is not to be seen.
WINDOW = slice(250, 1450), slice(394, 994)


def cut(demo: Path, start: int, stop: int, x: slice = WINDOW[0], y: slice = WINDOW[1]) -> Iterator[np.ndarray]:
    """Part of the pictures from frame `start` until before `stop`."""
    for frame in read_frames(demo, start=start, stop=stop):
        yield frame.image[y, x]


def walking(demo: Path, path: Path) -> Path:
    """3 s with five foot contacts (frames 79, 98, 116, 135, 153 of the demo)."""
    return write_video(path, cut(demo, 75, 165), constant_rate(90), container_options={"movflags": "+faststart"})


def standing(demo: Path, path: Path) -> Path:
    """She stands for 3 s: her picture at mid-stance (frame 88), held by a hand that trembles by 2 px, with noise."""
    picture = next(cut(demo, 88, 89, slice(None), slice(None)))
    rng = np.random.default_rng(0)

    def frames() -> Iterator[np.ndarray]:
        for i in range(90):
            dx, dy = round(2 * np.sin(0.9 * i)), round(2 * np.cos(0.7 * i))
            part = picture[390 + dy : 990 + dy, 500 + dx : 1500 + dx].astype(np.int16)
            yield np.clip(part + rng.integers(-4, 5, part.shape), 0, 255).astype(np.uint8)

    return write_video(path, frames(), constant_rate(90))


def short(demo: Path, path: Path) -> Path:
    """She is in view for 0.8 s of 2 s; the rest is the empty lawn of the same place, before she comes."""

    def frames() -> Iterator[np.ndarray]:
        yield from cut(demo, 90, 114, slice(500, 1300))
        yield from cut(demo, 0, 36, slice(500, 1300))

    return write_video(path, frames(), constant_rate(60))


def empty_scene(demo: Path, path: Path) -> Path:
    """The lawn and the fence, without anybody."""
    return write_video(path, cut(demo, 0, 34, slice(500, 1300)), constant_rate(34))


def two_alike(demo: Path, path: Path) -> Path:
    """She and her mirror image walk towards each other."""

    def frames() -> Iterator[np.ndarray]:
        for image in cut(demo, 75, 115, slice(700, 1500)):
            yield np.hstack([image, image[:, ::-1]])

    return write_video(path, frames(), constant_rate(40))


def truncated(whole: Path, path: Path) -> Path:
    """The first 60 % of the bytes of a video, as an upload leaves that was broken off."""
    data = whole.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    return path
