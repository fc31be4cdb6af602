"""Bring a decoded picture upright, as a player does with the display matrix a phone writes."""

from __future__ import annotations

import dataclasses

import av
import cv2
import numpy as np


@dataclasses.dataclass(frozen=True)
class Orientation:
    """How the stored picture becomes the one a person sees: transpose, then flip left-right, then top-bottom."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False
    exact: bool = True

    @property
    def mirrored(self) -> bool:
        """True when left and right are swapped, which no turning undoes."""
        return self.transpose ^ self.flip_x ^ self.flip_y

    @property
    def rotation_deg(self) -> int:
        """Clockwise turn of the stored picture: 0, 90, 180 or 270; of a mirrored one before it is mirrored."""
        flip_x = self.flip_x ^ self.mirrored
        if self.transpose:
            return 90 if flip_x else 270
        return 180 if flip_x else 0

    def size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) after turning."""
        return (height, width) if self.transpose else (width, height)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The upright picture, contiguous; (H, W, 3) -> (H', W', 3)."""
        if self.transpose:
            image = cv2.transpose(image)
        if self.flip_x or self.flip_y:
            image = cv2.flip(image, -1 if self.flip_x and self.flip_y else int(self.flip_x))
        return image


def orientation_of(frame: av.VideoFrame) -> Orientation:
    """From the frame's display matrix (ISO/IEC 14496-12, 6.2.2).

    The matrix [[a, b, u], [c, d, v], [x, y, w]] sends the stored point (p, q), p to the right and q down, to
    (a p + c q, b p + d q). Angles that are not multiples of 90 degrees are rounded to one (`exact` is then False).
    """
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return Orientation()
    a, b, _, c, d = (np.frombuffer(bytes(data), np.int32)[:5] / 65536.0).tolist()
    transpose = abs(b) + abs(c) > abs(a) + abs(d)
    to_x, to_y = (c, b) if transpose else (a, d)
    others = (a, d) if transpose else (b, c)
    exact = max(map(abs, others)) < 0.02 * max(abs(to_x), abs(to_y))
    return Orientation(transpose, flip_x=to_x < 0, flip_y=to_y < 0, exact=exact)
