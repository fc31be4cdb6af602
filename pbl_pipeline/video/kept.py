"""Decoded pictures of one video in memory, so that probe, tracking and keypoints share one decoding.

Decoding takes as long as all their other work outside the networks. Pictures are kept within `frames_kept` if those of
the whole video fit into this process's share of the memory; longer videos are decoded each time.

They are copied into memory that held those of the recording before: clearing new memory takes the system several times
as long as the copy.
"""

from __future__ import annotations

import contextlib
import dataclasses
import weakref
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from pbl_pipeline.resources import share_of_memory

from .decode import Decoder

#: Largest fraction of the process's share of the memory for pictures.
_FRACTION = 1 / 8


@dataclasses.dataclass(frozen=True)
class Pictures:
    """The pictures of a video that was read to its end without an error, each with its stamp."""

    file: tuple[object, ...]
    time_base: Fraction
    stamped: list[tuple[int, av.VideoFrame]]


class _Shelf:
    """The last video that was read whole in this process, while pictures are to be kept."""

    def __init__(self) -> None:
        self.wanted = 0
        self.pictures: Pictures | None = None
        self.blocks: list[np.ndarray] = []  # memory of released pictures

    def return_block(self, block: np.ndarray) -> None:
        """Keep the memory of a picture that was freed, while pictures are to be kept."""
        if self.wanted:
            self.blocks.append(block)


_shelf = _Shelf()


@contextlib.contextmanager
def frames_kept() -> Iterator[None]:
    """Keep the pictures of the last video that `probe` read in this block, for `read_frames` of the same file."""
    _shelf.wanted += 1
    try:
        yield
    finally:
        _shelf.wanted -= 1
        if not _shelf.wanted:
            release_frames()


def release_frames(memory: bool = True) -> None:
    """Release the kept pictures; without `memory`, theirs stays with this process for those of the next recording."""
    _shelf.pictures = None
    if memory:
        _shelf.blocks = []


def kept(path: Path) -> Pictures | None:
    """Return the pictures of a file, if they are kept and the file is still the same."""
    pictures = _shelf.pictures
    return pictures if pictures is not None and pictures.file == _identity(path) else None


def keeping(decoder: Decoder) -> Iterator[tuple[int, av.VideoFrame]]:
    """Yield the pictures of a decoder, and keep them if that is wanted and the end is reached."""
    release_frames(memory=False)
    room = share_of_memory() * _FRACTION if _shelf.wanted else 0.0
    file, stamped = _identity(decoder.path), []
    for pts, frame in decoder:
        # The memory of a reference picture counts in full, although the decoder also holds it.
        room -= sum(plane.buffer_size for plane in frame.planes)
        if room >= 0:
            # The first one states the orientation, which the copy does not.
            stamped.append((pts, _in_used_memory(frame) if stamped else frame))
        else:
            stamped.clear()
            release_frames()
        yield pts, frame
    if room >= 0:
        _shelf.pictures = Pictures(file, decoder.time_base, stamped)


def _in_used_memory(frame: av.VideoFrame) -> av.VideoFrame:
    """Return a copy of a picture in a block of released memory; the picture itself in a format that PyAV does not take
    from arrays, or whose conversion uses facts that PyAV does not copy (10 bits: where the colour samples lie)."""
    ends, blocks = np.cumsum([plane.buffer_size for plane in frame.planes]), _shelf.blocks
    fits = len(ends) == 3 and not frame.interlaced_frame and frame.format.components[0].bits == 8
    if blocks and not (fits and len(blocks[-1]) == ends[-1]):
        blocks.clear()
    if not fits:
        return frame
    block = blocks.pop() if blocks else np.empty(ends[-1], np.uint8)
    planes = []
    for plane, part in zip(frame.planes, np.split(block, ends[:-1]), strict=True):
        part[:] = np.frombuffer(memoryview(plane), np.uint8)
        planes.append(part.reshape(plane.height, -1)[:, : plane.width])
    try:
        copy = av.VideoFrame.from_dlpack(planes, frame.format.name)
    except (NotImplementedError, ValueError):  # odd sizes, and formats without a plane for each component
        return frame
    copy.colorspace, copy.color_range = frame.colorspace, frame.color_range
    copy.color_trc, copy.color_primaries = frame.color_trc, frame.color_primaries
    # The last array that the copy holds is freed with it.
    weakref.finalize(planes[-1], _shelf.return_block, block).atexit = False
    return copy


def _identity(path: Path) -> tuple[object, ...]:
    state = path.stat()
    return path.resolve(), state.st_ino, state.st_size, state.st_mtime_ns
