"""Frames of a video in order, upright, and regions of them.

A region is cut from the brightness and colour planes of a decoded picture and then converted: a detector needs some
256 x 256 pixels, a phone's picture has 2 or 8 million, and cutting first takes a tenth of the time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from av.sidedata.sidedata import SideDataContainer
from av.video.reformatter import VideoReformatter

from .decode import Decoder, check_file
from .kept import decode_on_gpu, kept
from .types import Frame, cut_samples, square, to_blocks


@dataclasses.dataclass(frozen=True)
class Orientation:
    """Steps from the stored picture to the one that is shown: transpose, then flip left-right, then top-bottom."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False
    exact: bool = True

    @property
    def mirrored(self) -> bool:
        """True if left and right are swapped, which no rotation undoes."""
        return self.transpose ^ self.flip_x ^ self.flip_y

    @property
    def rotation_deg(self) -> int:
        """Clockwise rotation of the stored picture: 0, 90, 180 or 270; of a mirrored one before mirroring."""
        flip_x = self.flip_x ^ self.mirrored
        if self.transpose:
            return 90 if flip_x else 270
        return 180 if flip_x else 0

    def size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) after turning."""
        return (height, width) if self.transpose else (width, height)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return the upright picture, contiguous; (H, W, 3) -> (H', W', 3)."""
        if self.transpose:
            image = cv2.transpose(image)
        if self.flip_x or self.flip_y:
            image = cv2.flip(image, -1 if self.flip_x and self.flip_y else int(self.flip_x))
        return image


def orientation_of(frame: av.VideoFrame) -> Orientation:
    """Return the orientation in the frame's display matrix (ISO/IEC 14496-12, 6.2.2).

    The matrix [[a, b, u], [c, d, v], [x, y, w]] sends the stored point (p, q), p to the right and q down, to
    (a p + c q, b p + d q). Angles that are not multiples of 90 degrees are rounded to one (`exact` is then False).
    """
    # `frame.side_data` would keep a reference back to the frame: only the collector of cycles frees such a frame, and
    # until then FFmpeg keeps the memory of all pictures of the video.
    data = SideDataContainer(frame).get("DISPLAYMATRIX")  # pyright: ignore[reportCallIssue] - missing in its stub
    if data is None:
        return Orientation()
    a, b, _, c, d = (np.frombuffer(bytes(data), np.int32)[:5] / 65536.0).tolist()
    transpose = abs(b) + abs(c) > abs(a) + abs(d)
    to_x, to_y = (c, b) if transpose else (a, d)
    others = (a, d) if transpose else (b, c)
    exact = max(map(abs, others)) < 0.02 * max(abs(to_x), abs(to_y))
    return Orientation(transpose, flip_x=to_x < 0, flip_y=to_y < 0, exact=exact)


#: Pixel formats of phones and cameras with one plane each of brightness, blue and red difference: picture pixels per
#: sample of the latter two, across and down, and bits.
_PLANAR = {
    "yuv420p": (2, 2, 8),
    "yuvj420p": (2, 2, 8),
    "yuv422p": (2, 1, 8),
    "yuvj422p": (2, 1, 8),
    "yuv444p": (1, 1, 8),
    "yuvj444p": (1, 1, 8),
    "yuv420p10le": (2, 2, 10),
    "yuv422p10le": (2, 1, 10),
}
_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG
#: Fractions of red and blue in the brightness by FFmpeg's number of the colour space: ITU-R BT.709 and BT.2020; all
#: others BT.601, as FFmpeg's converter for files that state none.
_RED_BLUE = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593), 10: (0.2627, 0.0593)}
_BT_601 = (0.299, 0.114)


def cut_planes(
    frame: av.VideoFrame, turn: Orientation, matrix: np.ndarray, size_px: tuple[int, int]
) -> np.ndarray | None:
    """`Frame.cut` of a picture as it was decoded; None for a pixel format that has to be converted as a whole."""
    layout = _PLANAR.get(frame.format.name)
    if layout is None:
        return None
    across, down, bits = layout
    full = frame.format.name.startswith("yuvj") or int(frame.color_range) == _FULL_RANGE
    stored = _from_upright(turn, frame.width, frame.height) @ square(matrix)
    parts = []
    for plane, (x, y), black in zip(
        frame.planes,
        ((1, 1), (across, down), (across, down)),
        (0 if full else 16, 128, 128),
        strict=True,
    ):
        samples = np.frombuffer(memoryview(plane), np.uint8 if bits == 8 else "<u2")
        samples = samples.reshape(plane.height, -1)[:, : plane.width]
        # A colour sample lies in the middle of the pixels that share it.
        part = cut_samples(samples, to_blocks(stored, x, y), size_px, float(black << (bits - 8)))
        parts.append(part if bits == 8 else cv2.convertScaleAbs(part, alpha=2.0 ** (8 - bits)))
    return cv2.transform(cv2.merge(parts), _to_bgr(int(frame.colorspace), full))


@functools.cache
def _to_bgr(colorspace: int, full_range: bool) -> np.ndarray:
    """(3, 4) matrix from brightness, blue and red difference (0..255) to blue, green, red. Source: ITU-R BT.601-7,
    section 2.5, with the fractions of the colour space."""
    red, blue = _RED_BLUE.get(colorspace, _BT_601)
    green = 1.0 - red - blue
    matrix = np.array(
        [
            [1.0, 2 * (1 - blue), 0.0],
            [1.0, -2 * (1 - blue) * blue / green, -2 * (1 - red) * red / green],
            [1.0, 0.0, 2 * (1 - red)],
        ]
    )
    black = np.array([0.0, 128.0, 128.0])
    if not full_range:
        matrix = matrix * (np.array([255 / 219, 255 / 224, 255 / 224]))
        black[0] = 16.0
    return np.column_stack([matrix, -matrix @ black])


@functools.cache
def _from_upright(turn: Orientation, width: int, height: int) -> np.ndarray:
    """(2, 3) matrix from pixel centres of the upright picture to those of the stored one, `width` x `height`; do not
    modify it."""
    upright_width, upright_height = turn.size(width, height)
    x = [-1.0, 0.0, upright_width - 1.0] if turn.flip_x else [1.0, 0.0, 0.0]
    y = [0.0, -1.0, upright_height - 1.0] if turn.flip_y else [0.0, 1.0, 0.0]
    return np.array([y, x] if turn.transpose else [x, y])


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1, *, threads: int | None = None
) -> Iterator[Frame]:
    """Stream the frames `range(start, stop, step)` upright, with the indices and stamps of `probe`.

    Frame `index` has `time_s` equal to `probe(path).time_s[index]`, whatever `start` is. Decoding begins at the start
    of the file (frames count from there) and ends after the last frame asked for; only the frames asked for are
    converted to `image` (H, W, 3) uint8 BGR, each when its `image` is first read, in the thread that reads it. Only a
    few frames are in memory besides those that the caller keeps, and those of `kept.frames_kept`, which are not decoded
    again.

    Raises
    ------
    PblError
        As `probe`. A file that lost its end raises VIDEO_TRUNCATED after the last frame that decodes.
    ValueError
        `start` negative or `step` below 1.
    """
    if start < 0 or step < 1:
        raise ValueError(f"start must be 0 or more and step 1 or more, not {start} and {step}")
    return _frames(check_file(path), start, stop, step, threads)


class _ToBgr:
    """Converter of decoded pictures to upright BGR, one per thread for the whole file: a new one per frame would start
    its threads each time."""

    def __init__(self) -> None:
        self._local = threading.local()

    def __call__(self, frame: av.VideoFrame, turn: Orientation) -> np.ndarray:
        """Return the picture (H, W, 3); its rows may lie apart in memory, as those of a region of an array."""
        if not hasattr(self._local, "converter"):
            self._local.converter = VideoReformatter()
        plane = self._local.converter.reformat(frame, format="bgr24", threads=1).planes[0]
        # A view of the converter's memory, new for each picture: a copy would cost more than the conversion.
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
        return turn.apply(rows[:, : 3 * plane.width].reshape(plane.height, plane.width, 3))


def _frames(path: Path, start: int, stop: int | None, step: int, threads: int | None) -> Iterator[Frame]:
    if stop is not None and stop <= start:
        return
    with contextlib.ExitStack() as stack:
        pictures = kept(path)
        if pictures is None:
            decoder = stack.enter_context(Decoder(path, threads))
            decode_on_gpu(decoder)
            time_base, stamped = decoder.time_base, iter(decoder)
        else:
            time_base, stamped = pictures.time_base, iter(pictures.stamped)
        to_bgr = _ToBgr()
        turn, first_pts, last = Orientation(), 0, None if stop is None else range(start, stop, step)[-1]
        for index, (pts, frame) in enumerate(stamped):
            if index == 0:
                turn, first_pts = orientation_of(frame), pts
            if index >= start and (index - start) % step == 0:
                # Same arithmetic as probe, so that the stamps are equal to the last bit.
                time_s = float(np.int64(pts - first_pts) * float(time_base))
                whole, part = functools.partial(to_bgr, frame, turn), functools.partial(cut_planes, frame, turn)
                yield Frame(index, time_s, whole, part, turn.size(frame.width, frame.height))
            if last is not None and index >= last:
                return
