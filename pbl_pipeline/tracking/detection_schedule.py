"""Windows of detection in each frame: around known people as often as their movement requires, elsewhere in turn.

One call of a detector takes as long as decoding three frames, so not every picture is searched everywhere. A person who
moves evenly is detected ten times a second and interpolated in between, one who keeps still less often; one who moves
unexpectedly, was missed or comes close to another is detected more often. The whole frame and its tiles are searched in
turn: a new person is found within one turn, and `backtrack` then adds the frames before.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.paramset import later

from .associate import Trail
from .tiling import Window, tiles


@dataclasses.dataclass(frozen=True)
class WatchParams:
    """Parameters of `Watch`."""

    tile_fraction: float = 0.7  # side of the square tiles over the shorter side of the picture
    tile_overlap: float = 0.3  # least overlap of neighbouring tiles, in sides
    search_interval_s: float = 0.2  # interval at which new people are searched for
    search_windows: int = 1  # windows (the whole frame and the tiles, in turn) in each search
    follow_interval_s: float = 0.1  # interval at which each known person is detected
    rest_interval_s: float = 0.2  # the same for one who moves less than `still` body heights per second
    # The same for one who was seen fewer than `known_hits` times, was missed, was farther from the prediction than
    # `surprise` body heights, or is nearer to another person than `near` body heights.
    close_interval_s: float = 0.06
    still: float = 0.1
    surprise: float = 0.15
    known_hits: int = 4
    near: float = 0.6
    window_sizes: float = 1.6  # side of the window around a person, in sides of the region of interest
    # Distance of the places at which such a window can lie, in its sides, which are powers of 2 ** (1 / 8): rounding of
    # a network moves no such window. It does move one of whole pixels (0) now and then, and so what is detected in it
    # and in those that follow.
    window_grid: float = later(0.0)
    covered: float = 0.8  # tiles covered by such windows to this fraction are not searched


class Watch:
    """Windows of the frames in order. `slack_s` is half a frame: it avoids beating between frames and intervals."""

    def __init__(self, size_px: tuple[int, int], params: WatchParams, slack_s: float) -> None:
        self._params, self._slack = params, slack_s
        self._ring = tiles(*size_px, params.tile_fraction, params.tile_overlap)
        self._at = 0
        self._next_search = 0.0
        self._first = True

    @property
    def n_turn(self) -> int:
        """Number of searches until the whole picture was searched."""
        return -(-len(self._ring) // self._params.search_windows)

    def due(self, time_s: float, live: Sequence[Trail], last: bool) -> list[Trail]:
        """Trails that are to be detected in this frame, and those that lie in the window of one of them."""
        now = time_s + self._slack
        due = [t for t in live if last or now >= t.due_s]
        windows = self.around(time_s, due)
        return [t for t in live if t in due or any(_inside(t.predict(time_s), w) for w in windows)]

    def around(self, time_s: float, due: Sequence[Trail]) -> list[Window]:
        """Windows around these people."""
        return [window_around(t.predict(time_s), self._params) for t in due]

    def elsewhere(self, time_s: float, live: Sequence[Trail]) -> list[Window]:
        """Windows in which new people are searched for in this frame; the first time all of them."""
        if time_s + self._slack < self._next_search:
            return []
        self._next_search = time_s + self._params.search_interval_s
        if self._first:
            self._first = False
            return list(self._ring)
        around, out = self.around(time_s, live), []
        for _ in range(len(self._ring)):
            window = self._ring[self._at]
            self._at = (self._at + 1) % len(self._ring)
            if not any(_share(window, a) >= self._params.covered for a in around):
                out.append(window)
            if len(out) == self._params.search_windows:
                break
        return out

    def detected(self, time_s: float, due: Sequence[Trail], live: Sequence[Trail]) -> None:
        """Set the time of the next detection of those who were due, or were found."""
        p = self._params
        for trail in live:
            if trail not in due and trail.due_s > time_s:
                continue
            interval = p.follow_interval_s
            if _close(trail, time_s, live, p):
                interval = p.close_interval_s
            elif np.hypot(*trail.velocity[:2]) < p.still:
                interval = p.rest_interval_s
            trail.due_s = time_s + interval


def window_around(state: np.ndarray, params: WatchParams) -> Window:
    """Square of `window_sizes` regions of interest around a body with this state (`measure`)."""
    x, y, side = float(state[0]), float(state[1]), params.window_sizes * float(np.exp(state[2]))
    if params.window_grid:
        side = 2 ** (round(8 * math.log2(side)) / 8)
        step = params.window_grid * side
        x, y = step * round(x / step), step * round(y / step)
    half = 0.5 * side
    return round(x - half), round(y - half), round(x + half), round(y + half)


def _close(trail: Trail, time_s: float, live: Sequence[Trail], params: WatchParams) -> bool:
    if len(trail.frames) < params.known_hits or trail.last_time < time_s or trail.surprise > params.surprise:
        return True
    here = trail.predict(time_s + params.follow_interval_s)
    for other in live:
        if other is trail:
            continue
        there = other.predict(time_s + params.follow_interval_s)
        if np.hypot(*(here[:2] - there[:2])) < params.near * np.exp((here[2] + there[2]) / 2):
            return True
    return False


def _inside(state: np.ndarray, window: Window) -> bool:
    return bool(window[0] <= state[0] <= window[2] and window[1] <= state[1] <= window[3])


def _share(window: Window, cover: Window) -> float:
    """Fraction of `window` that lies in `cover`."""
    width = min(window[2], cover[2]) - max(window[0], cover[0])
    height = min(window[3], cover[3]) - max(window[1], cover[1])
    return max(width, 0) * max(height, 0) / ((window[2] - window[0]) * (window[3] - window[1]))
