"""Covers the heads in one picture, or draws the bodies alone."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

#: Standard deviation of the Gaussian, in radii of the circle: a face is about 0.75 of a radius wide.
BLUR_RADII = 0.4
#: Side of a cell, in radii.
CELL_RADII = 0.4
#: The blur is computed on a picture in which a radius has this many pixels.
_RADIUS_PX = 10.0
_SHIFT = 4  # OpenCV's circles carry this many fractional bits


def cover(image: np.ndarray, circles: Sequence[np.ndarray], how: str) -> None:
    """Hide all circles (for each head (N, 3): centre x, y, radius in px) in `image` (H, W, 3) uint8 BGR, in place.

    `how` is "blur", a Gaussian of `BLUR_RADII`, or "pixelate", the means of cells of `CELL_RADII`. Both scale with the
    head, so that as little is left of a near face as of a far one.
    """
    for rows in circles:
        _cover_one(image, np.asarray(rows, float), how)


def outline(circles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(height, width) uint8, 255 within the circles (N, 3); size is (width, height)."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    for x, y, r in np.asarray(circles, float):
        centre = (round(x * (1 << _SHIFT)), round(y * (1 << _SHIFT)))
        cv2.circle(mask, centre, max(1, round(r * (1 << _SHIFT))), 255, -1, cv2.LINE_8, _SHIFT)
    return mask


def _cover_one(image: np.ndarray, circles: np.ndarray, how: str) -> None:
    height, width = image.shape[:2]
    low = np.floor((circles[:, :2] - circles[:, 2:]).min(axis=0)) - 1
    high = np.ceil((circles[:, :2] + circles[:, 2:]).max(axis=0)) + 2
    x0, y0 = (int(v) for v in np.clip(low, 0, [width, height]))
    x1, y1 = (int(v) for v in np.clip(high, 0, [width, height]))
    if x1 <= x0 or y1 <= y0:
        return
    part = image[y0:y1, x0:x1]
    mask = outline(circles - [x0, y0, 0], (x1 - x0, y1 - y0))
    radius = float(circles[:, 2].max())
    hidden = _blurred(part, radius) if how == "blur" else _cells(part, radius)
    part[mask > 0] = hidden[mask > 0]


def _blurred(part: np.ndarray, radius: float) -> np.ndarray:
    height, width = part.shape[:2]
    factor = max(1.0, radius / _RADIUS_PX)
    small = _smaller(part, factor)
    sd = BLUR_RADII * radius / factor
    small = cv2.GaussianBlur(small, (0, 0), max(sd, 0.5))
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def _cells(part: np.ndarray, radius: float) -> np.ndarray:
    height, width = part.shape[:2]
    small = _smaller(part, max(1.0, CELL_RADII * radius))
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def _smaller(part: np.ndarray, factor: float) -> np.ndarray:
    size = (max(1, round(part.shape[1] / factor)), max(1, round(part.shape[0] / factor)))
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA)
