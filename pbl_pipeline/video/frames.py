"""Frames of a video, one after the other."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from .cut_planes import cut_planes
from .decode import Decoder, check_file
from .orientation import Orientation, orientation_of
from .types import Frame


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1, *, threads: int | None = None
) -> Iterator[Frame]:
    """Stream the frames `range(start, stop, step)` upright, with the indices and stamps of `probe`.

    Frame `index` has `time_s` equal to `probe(path).time_s[index]`, whatever `start` is. Decoding begins at the start
    of the file (frames count from there) and ends after the last frame asked for; only the frames asked for are
    converted to `image` (H, W, 3) uint8 BGR, each when its `image` is first read, in whichever thread does so. At most
    a few frames are in memory beside those that the caller keeps.

    Raises
    ------
    PblError
        As `probe`. A file that lost its end raises VIDEO_TRUNCATED after the last frame that decodes, when the
        reading gets there.
    ValueError
        `start` negative or `step` below 1.
    """
    if start < 0 or step < 1:
        raise ValueError(f"start must be 0 or more and step 1 or more, not {start} and {step}")
    return _frames(check_file(path), start, stop, step, threads)


class _ToBgr:
    """Decoded picture to upright BGR. One converter per thread for the whole file: a new one per frame would set itself
    up, with threads of its own, each time."""

    def __init__(self) -> None:
        self._local = threading.local()

    def __call__(self, frame: av.VideoFrame, turn: Orientation) -> np.ndarray:
        """The picture (H, W, 3); its rows may lie apart in memory, as those of a region of an array do."""
        if not hasattr(self._local, "converter"):
            self._local.converter = VideoReformatter()
        plane = self._local.converter.reformat(frame, format="bgr24", threads=1).planes[0]
        # The converter's own memory, which is new for each picture: a copy would cost more than the conversion.
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
        return turn.apply(rows[:, : 3 * plane.width].reshape(plane.height, plane.width, 3))


def _frames(path: Path, start: int, stop: int | None, step: int, threads: int | None) -> Iterator[Frame]:
    if stop is not None and stop <= start:
        return
    with Decoder(path, threads) as decoder:
        to_bgr = _ToBgr()
        turn, first_pts, last = Orientation(), 0, None if stop is None else range(start, stop, step)[-1]
        for index, (pts, frame) in enumerate(decoder):
            if index == 0:
                turn, first_pts = orientation_of(frame), pts
            if index >= start and (index - start) % step == 0:
                # Same arithmetic as probe, so that the stamps are equal to the last bit.
                time_s = float(np.int64(pts - first_pts) * float(decoder.time_base))
                whole = functools.partial(to_bgr, frame, turn)
                yield Frame(index, time_s, whole, functools.partial(cut_planes, frame, turn))
            if last is not None and index >= last:
                return
