"""Frames of a video, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from av.video.reformatter import VideoReformatter

from ._decode import Decoder, check_file
from ._orientation import Orientation, orientation_of
from ._types import Frame


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1, *, threads: int | None = None
) -> Iterator[Frame]:
    """Stream the frames `range(start, stop, step)` upright, with the indices and stamps of `probe`.

    Frame `index` has `time_s` equal to `probe(path).time_s[index]`, whatever `start` is. Decoding begins at the start
    of the file (frames count from there) and ends after the last frame asked for; only the frames asked for are
    converted to `image` (H, W, 3) uint8 BGR. At most a few frames are in memory.

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


def _frames(path: Path, start: int, stop: int | None, step: int, threads: int | None) -> Iterator[Frame]:
    if stop is not None and stop <= start:
        return
    with Decoder(path, threads) as decoder:
        # One converter for the whole file: a new one per frame would set itself up, with threads of its own, each time.
        to_bgr = VideoReformatter()
        turn, first_pts, last = Orientation(), 0, None if stop is None else range(start, stop, step)[-1]
        for index, (pts, frame) in enumerate(decoder):
            if index == 0:
                turn, first_pts = orientation_of(frame), pts
            if index >= start and (index - start) % step == 0:
                # Rows of some widths are padded for the converter; users get plain arrays.
                image = np.ascontiguousarray(turn.apply(to_bgr.reformat(frame, format="bgr24", threads=1).to_ndarray()))
                # Same arithmetic as probe, so that the stamps are equal to the last bit.
                yield Frame(index, float(np.int64(pts - first_pts) * float(decoder.time_base)), image)
            if last is not None and index >= last:
                return
