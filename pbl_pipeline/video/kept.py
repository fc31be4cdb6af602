"""Decoded pictures of one video in memory, so that probe, tracking and keypoints share one decoding.

Decoding takes as long as all their other work outside the networks. Pictures are kept within `frames_kept` if those of
the whole video fit into this process's share of the memory; longer videos are decoded each time. Meanwhile the memory
of freed pictures stays with the process for those of the next recording.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av

from pbl_pipeline.resources import keep_large_blocks, return_free_memory, share_of_memory

from . import gpu_decoding
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
        self.size = 0  # bytes of a picture


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
        keep_large_blocks(False)
        return_free_memory()
        gpu_decoding.release()


def kept(path: Path) -> Pictures | None:
    """Return the pictures of a file, if they are kept and the file is still the same."""
    pictures = _shelf.pictures
    return pictures if pictures is not None and pictures.file == _identity(path) else None


def decode_on_gpu(decoder: Decoder) -> float:
    """Let the GPU decode the pictures, where it can, within `frames_kept` and while no others are kept. Return the
    bytes that they may take."""
    room = share_of_memory() * _FRACTION
    if _shelf.wanted and _shelf.pictures is None:
        decoder.pictures = gpu_decoding.decoded(decoder.path, room)
    return room


def keeping(decoder: Decoder) -> Iterator[tuple[int, av.VideoFrame]]:
    """Yield the pictures of a decoder, and keep them if that is wanted and the end is reached."""
    release_frames(memory=False)
    if not _shelf.wanted:
        yield from decoder
        return
    file, stamped = _identity(decoder.path), []
    room = decode_on_gpu(decoder)
    keep_large_blocks(True)
    for pts, frame in decoder:
        size = sum(plane.buffer_size for plane in frame.planes)
        if size != _shelf.size:  # the places of the last ones do not suit
            return_free_memory()
            _shelf.size = size
        # The memory of a reference picture counts in full, although the decoder also holds it.
        room -= size
        if room >= 0:
            stamped.append((pts, frame))
        elif room + size >= 0:  # the first one too many
            stamped.clear()
            release_frames()
        yield pts, frame
    if room >= 0:
        _shelf.pictures = Pictures(file, decoder.time_base, stamped)


def _identity(path: Path) -> tuple[object, ...]:
    state = path.stat()
    return path.resolve(), state.st_ino, state.st_size, state.st_mtime_ns
