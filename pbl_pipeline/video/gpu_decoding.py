"""Decoding by the process that owns the GPU (`models.gpu_server`), of all pictures of a video at once.

The decoder of the GPU makes the same pictures as FFmpeg's, to the last bit, and states whether each decoded without an
error. Where anything is unusual or damaged, FFmpeg decodes the file and states what it is.
"""

from __future__ import annotations

import itertools
import json
import socket
import weakref
from pathlib import Path

import av
import cv2
import numpy as np
from av.bitstream import BitStreamFilterContext

from pbl_pipeline.models import gpu_address
from pbl_pipeline.models.network import DECODING, PATIENCE_S, receive_line, send_line, share_memory
from pbl_pipeline.models.nvdec import CODECS

from .coded_units import is_damaged
from .decode import FFMPEG_ERRORS, Decoder

#: Formats of the pictures: colour at half the resolution, 8 bits.
_FORMATS = ("yuv420p", "yuvj420p")


class _Connection:
    """A connection, and memory that is shared with the process that owns the GPU, for the pictures of one video."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(gpu_address.running_server(gpu_address.DECODER))
        send_line(self._socket, DECODING)
        self._receive()
        self._memory = share_memory(self._socket, size)
        self._last: weakref.ref[np.ndarray] | None = None

    def free(self) -> bool:
        """True if no picture of the last video is used any more."""
        return self._last is None or self._last() is None

    def close(self) -> None:
        self._socket.close()

    def decode(self, codec: str, like: av.VideoFrame, packets: list[tuple[int, bytes]]) -> list[av.VideoFrame]:
        """Return the pictures of `packets` in the order of showing, of the size and format of `like`.

        Raises RuntimeError: not all pictures decode without an error.
        """
        stamps, pieces = zip(*packets, strict=True)
        n, width, height = len(packets), like.width, like.height
        asked = {"codec": codec, "size_px": (width, height), "stamps": stamps, "lengths": [len(p) for p in pieces]}
        send_line(self._socket, asked)
        self._socket.sendall(b"".join(pieces))
        found = self._receive()["stamps"]
        if found != sorted(stamps):
            raise RuntimeError(f"{len(found)} pictures of {n} packets, or other stamps")
        memory = np.frombuffer(self._memory, np.uint8, n * height * 3 // 2 * width)
        self._last = weakref.ref(memory)
        frames, shape = [], (height // 2, width // 2)
        two = [np.empty(shape, np.uint8) for _ in range(2)]  # new memory for each picture takes ten times as long
        for stamp, picture in zip(found, memory.reshape(n, height * 3 // 2, width), strict=True):
            colours = picture[height:]
            colours.reshape(2, *shape)[:] = cv2.split(colours.reshape(*shape, 2), two)  # not in pairs, as FFmpeg's
            frame = av.VideoFrame.from_numpy_buffer(picture, like.format.name)
            frame.pts, frame.color_range, frame.colorspace = stamp, like.color_range, like.colorspace
            frames.append(frame)
        return frames

    def _receive(self) -> dict:
        answer = json.loads(receive_line(self._socket))
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer


_connection: _Connection | None = None


def release() -> None:
    """Give back the memory of the pictures."""
    global _connection
    if _connection is not None:
        _connection.close()
        _connection = None


def decoded(path: Path, room: float) -> list[av.VideoFrame] | None:
    """Decode all pictures of a video file, in the order of showing; None where FFmpeg has to decode it.

    They lie in the memory of those before, if these are no longer used. `room`: bytes that they may take.
    """
    if not gpu_address.gpu_wanted():
        return None
    try:
        with Decoder(path, threads=1) as decoder:
            return _decoded(decoder, room)
    except (*FFMPEG_ERRORS, EOFError, OSError, RuntimeError, StopIteration, ValueError):
        release()
        return None


def _decoded(decoder: Decoder, room: float) -> list[av.VideoFrame] | None:
    global _connection
    stream, codec = decoder.stream, decoder.stream.codec_context
    size = decoder.n_announced * codec.width * codec.height * 3 // 2
    known = codec.name in CODECS and codec.format is not None and codec.format.name in _FORMATS
    # Of other heights PyAV makes no picture from given memory.
    if not known or codec.width % 2 or codec.height % 4 or not 0 < max(size, decoder.path.stat().st_size) <= room:
        return None
    # First, so that a GPU without a decoder does not cost a reading of each file.
    if _connection is None or _connection.size < size or not _connection.free():
        release()
        _connection = _Connection(size)
    packets = [p for p in itertools.islice(decoder.container.demux(stream), decoder.n_announced + 2) if p.size]
    stamps = [p.pts for p in packets if p.pts is not None]  # the filter empties the packets
    usual = len(stamps) == len(packets) == decoder.n_announced > 0
    if not usual or any(p.is_corrupt or p.is_discard or is_damaged(codec, bytes(p)) for p in packets):
        return None
    first = next(frame for p in packets for frame in stream.decode(p))
    to_annex_b = BitStreamFilterContext(f"{codec.name}_mp4toannexb", stream)
    pieces = [bytes(q) for p in packets for q in to_annex_b.filter(p)]
    frames = _connection.decode(codec.name, first, list(zip(stamps, pieces, strict=True)))
    same = frames[0].pts == first.pts and np.array_equal(frames[0].to_ndarray(), first.to_ndarray())
    return [first, *frames[1:]] if same else None
