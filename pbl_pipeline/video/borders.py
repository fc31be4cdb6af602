"""Borders of one colour around a video's picture, which no camera records: a screen recording, or an edited copy."""

from __future__ import annotations

import av
import numpy as np

#: Longer side (px) of the reduced grey picture, and every how many frames it is looked at.
_SIDE_PX, EVERY = 160, 10
#: Grey levels (of 255) by which a border may differ from its colour, over place and time, and by which the picture
#: beside it differs: between the two lies a sharp edge, which a light that falls off over a wall does not have.
_LEVELS, _EDGE_LEVELS = 6, 20
#: Least width of the borders on two opposite sides, and least extent of the picture along them, as fractions of the
#: whole: a player fills the screen in one direction.
_LEAST_WIDTH, _LEAST_EXTENT = 0.03, 0.5
#: Fraction of a row that differs so: of the picture's at its edges at least (a room may be as dark as the border), of
#: the border's beside it at most at any time (the edge is straight), and on average (a clock, a progress bar).
_AT_EDGE, _BESIDE, _OUTSIDE = 0.3, 0.05, 0.2


class BorderMeter:
    """Where a video's picture has another grey than its edges, at a reduced size: ever, and how often by far."""

    def __init__(self) -> None:
        self._n = 0
        self._colours: np.ndarray = np.empty(0)
        self._ever: np.ndarray = np.empty(0, bool)
        self._often: np.ndarray = np.empty(0, np.int64)

    def add(self, frame: av.VideoFrame) -> None:
        """Look at a frame; all have one size."""
        scale = _SIDE_PX / max(frame.width, frame.height)
        width, height = max(2, round(frame.width * scale)), max(2, round(frame.height * scale))
        grey = frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray().astype(np.int16)
        if not self._n:
            # Of the first and last row, and of the first and last column: a border keeps its colour.
            self._colours = np.array([np.median(grey[[0, -1]]), np.median(grey[:, [0, -1]])])[:, None, None]
            self._ever, self._often = np.zeros((2, *grey.shape), bool), np.zeros((2, *grey.shape), np.int64)
        off = np.abs(grey - self._colours)
        self._n += 1
        self._ever |= off > _LEVELS
        self._often += off > _EDGE_LEVELS

    def widths(self) -> tuple[float, float] | None:
        """Return the widths of the borders at two opposite sides of the stored picture, as fractions of it; None where
        it has none."""
        if not self._n:
            return None
        # Half of the time: what moves over a flat background is not the picture.
        usual = self._often >= 0.5 * self._n
        return _at_ends(usual[0], self._ever[0]) or _at_ends(usual[1].T, self._ever[1].T)


def _at_ends(usual: np.ndarray, ever: np.ndarray) -> tuple[float, float] | None:
    """Widths of the borders of one colour at the first and the last row, None where one is missing.

    Parameters
    ----------
    usual, ever
        (H, W) bool: another grey than the border's by far most of the time, at any time.
    """
    of_columns = usual.mean(axis=0)
    columns = np.flatnonzero(of_columns > 0.5 * of_columns.max())
    across = slice(columns.min(initial=len(of_columns)), columns.max(initial=-1) + 1)
    if across.stop - across.start < _LEAST_EXTENT * len(of_columns):
        return None
    # The longest run of rows that differ: a progress bar or the text of an app is a shorter one.
    differs = ever[:, across].mean(axis=1) > _BESIDE
    runs = np.flatnonzero(np.diff(np.concatenate([[False], differs, [False]]))).reshape(-1, 2)
    if not len(runs):
        return None
    top, end = (int(i) for i in runs[np.argmax(runs[:, 1] - runs[:, 0])])
    widths = top / len(ever), 1.0 - end / len(ever)
    if min(widths) < _LEAST_WIDTH:
        return None
    # The row at an edge may hold a part of both.
    filled = usual[:, across].mean(axis=1)
    sharp = min(filled[top : top + 2].max(), filled[max(0, end - 2) : end].max()) >= _AT_EDGE
    return widths if sharp and max(ever[:top].mean(), ever[end:].mean()) <= _OUTSIDE else None
