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
    """The first picture of a video, and the darkest and brightest grey of each place, at a reduced size."""

    def __init__(self) -> None:
        self._seen: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def add(self, frame: av.VideoFrame) -> None:
        """Look at a frame; all have one size."""
        scale = _SIDE_PX / max(frame.width, frame.height)
        width, height = max(2, round(frame.width * scale)), max(2, round(frame.height * scale))
        grey = frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray().astype(np.int16)
        first, low, high = self._seen or (grey, grey, grey)
        self._seen = first, np.minimum(low, grey), np.maximum(high, grey)

    def widths(self) -> tuple[float, float] | None:
        """Return the widths of the borders at two opposite sides of the stored picture, as fractions of it; None where
        it has none."""
        if self._seen is None:
            return None
        return _at_ends(*self._seen) or _at_ends(*(seen.T for seen in self._seen))


def _at_ends(first: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, float] | None:
    """Widths of the borders of one colour at the first and the last row, None where one is missing."""
    colour = float(np.median(low[[0, -1]]))
    picture, other = np.abs(first - colour) > _EDGE_LEVELS, np.maximum(high - colour, colour - low) > _LEVELS
    of_columns = picture.mean(axis=0)
    columns = np.flatnonzero(of_columns > 0.5 * of_columns.max())
    across = slice(columns.min(initial=0), columns.max(initial=-1) + 1)
    if across.stop - across.start < _LEAST_EXTENT * len(of_columns):
        return None
    # The longest run of rows that differ: a progress bar or the text of an app is a shorter one.
    differs = other[:, across].mean(axis=1) > _BESIDE
    runs = np.flatnonzero(np.diff(np.concatenate([[False], differs, [False]]))).reshape(-1, 2)
    if not len(runs):
        return None
    top, end = (int(i) for i in runs[np.argmax(runs[:, 1] - runs[:, 0])])
    widths = top / len(other), 1.0 - end / len(other)
    if min(widths) < _LEAST_WIDTH:
        return None
    # The row at an edge may hold a part of both.
    filled = picture[:, across].mean(axis=1)
    sharp = min(filled[top : top + 2].max(), filled[max(0, end - 2) : end].max()) >= _AT_EDGE
    return widths if sharp and max(other[:top].mean(), other[end:].mean()) <= _OUTSIDE else None
