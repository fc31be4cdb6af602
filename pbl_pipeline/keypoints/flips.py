"""Correction of left and right that a detector exchanged for some frames, by the movement.

A network may take one leg for the other where they cross, or a body seen from the front for one seen from behind. Then
all points of a side jump to the other side within a frame and back some frames later, which no body does. So the
exchanges (none, the legs, the rest, both) are chosen over the whole track together such that the points move most
smoothly in the picture and in depth, few exchanges begin and end, and few frames differ from the detector's result
(dynamic programming over pairs of neighbouring frames). Legs that cross in a view from the side are not exchanged: they
pass each other at a steady speed, and keep their depth.

Lengths are not used, so legs of different length do not matter. Of synthetic walkers whose left thigh, shank or both
were 10, 20 and 30 % shorter (three views, three seeds each, 9,720 frames) no frame was exchanged, and all 2,025
stretches that were exchanged on purpose were restored exactly; with further errors of 6 cm that last 0.2 s, 19 of 1,080
were not, of walkers with equal legs 18 of 270. A missing leg or a prosthesis was not in these data.

Sides that are wrong for the greater part of the track cannot be detected here; `check_keypoints` reports them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

#: Points that are exchanged together.
_LEGS = ("knee", "ankle", "heel", "foot_index")
#: (legs exchanged, rest exchanged)
_STATES = np.array([(False, False), (True, False), (False, True), (True, True)])
_N_STATES = len(_STATES)
#: Standard deviation of a person's points about their mean (m), if they have no 3D.
_BODY_SPREAD_M = 0.5


@dataclasses.dataclass(frozen=True)
class FlipParams:
    """Parameters of `exchange_sides`."""

    # A body whose shoulders are less than this fraction of their usual distance apart is a mean of two that face
    # opposite ways. Such frames do not link others, and the confidence of their points is multiplied by `lower_narrow`.
    least_width: float = 0.7
    lower_narrow: float = 0.2
    # Frames about this far apart are judged first, those in between after that; over a shorter step noise looks like
    # speed.
    step_s: float = 0.033
    max_gap_s: float = 0.4  # frames farther apart do not constrain each other
    min_confidence: float = 0.1  # frames of a lower mean confidence (of the legs, of the rest) do not link others
    depth_weight: float = 0.5  # weight of metres along the line of sight against metres across it
    most_m: float = 0.3  # largest distance of a point from its prediction that counts
    switch_cost_m: float = 0.02  # for each beginning and each end of an exchange; a mean over points, as the distances
    change_cost_m: float = 0.001  # for each frame that differs from the detector's result
    lower: float = 0.5  # factor of the confidence of exchanged points


@dataclasses.dataclass(frozen=True)
class Exchange:
    """Frames (T,) in which the names of the legs, and of the rest of the body, are to be exchanged, and those in which
    the body is so narrow that its sides cannot be distinguished."""

    legs: np.ndarray
    rest: np.ndarray
    narrow: np.ndarray

    @property
    def table(self) -> np.ndarray:
        """(T, 3) bool: legs, rest, narrow."""
        return np.stack([self.legs, self.rest, self.narrow], axis=1)


def mirror_of(names: Sequence[str]) -> np.ndarray | None:
    """Index of the same point of the other side, for each point (its own in the middle); None for names without sides
    ("left_x" with "right_x")."""
    index = {name: i for i, name in enumerate(names)}
    other = [n.replace("left", "~").replace("right", "left").replace("~", "right") for n in names]
    if any(o not in index for o in other) or list(names) == other:
        return None
    return np.array([index[o] for o in other])


def leg_points(names: Sequence[str]) -> np.ndarray:
    """(J,) bool: knees and points below them."""
    return np.array([n.endswith(_LEGS) for n in names])


def exchange_sides(
    time_s: np.ndarray,
    names: Sequence[str],
    xy_px: np.ndarray,
    xyz_cam_m: np.ndarray,
    confidence: np.ndarray,
    params: FlipParams | None = None,
) -> Exchange:
    """Find the frames in which left and right have to be exchanged for `xy_px` (T, J, 2) and `xyz_cam_m` (T, J, 3) to
    move like a body.

    Points that were not seen are NaN with confidence 0. With names without sides nothing is exchanged.
    """
    params = params or FlipParams()
    none = np.zeros(len(time_s), bool)
    mirror = mirror_of(names)
    if mirror is None or len(time_s) < 3:
        return Exchange(none, none, none)
    sided = mirror != np.arange(len(names))
    paired = [sided & leg_points(names), sided & ~leg_points(names)]
    if not all(group.any() for group in paired):
        return Exchange(none, none, none)
    narrow = _narrow(names, xyz_cam_m, params.least_width)
    points = _in_metres(xy_px, xyz_cam_m, params.depth_weight)
    # A pair of points has one weight under either name, and counts only where both are seen.
    weight = np.sqrt(0.5 * (confidence + confidence[:, mirror]))
    lost = np.isnan(points.sum(axis=2))
    weight[lost | lost[:, mirror]] = 0.0
    good = np.flatnonzero(
        np.all([confidence[:, g].mean(axis=1) >= params.min_confidence for g in paired], axis=0)
        & np.isfinite(points).any(axis=(1, 2))
        & ~narrow
    )
    if len(good) < 3:
        return Exchange(none, none, narrow)
    points = np.where(np.isfinite(points), points, 0.0)
    shown = _Shown(points, weight, mirror, paired, params)
    key = _every(good, time_s, params.step_s)
    states = np.zeros(len(time_s), int)
    states[key] = _smoothest(shown, time_s, key, params)
    for row in np.setdiff1d(np.arange(len(time_s))[weight.any(axis=1)], key):
        after = int(np.searchsorted(key, row))
        near = [k for k in key[max(after - 1, 0) : after + 1] if abs(time_s[k] - time_s[row]) <= params.max_gap_s]
        if near:
            states[row] = shown.between(row, near, states[near], time_s)
    chosen = _STATES[states]
    return Exchange(chosen[:, 0], chosen[:, 1], narrow)


def lowered(confidence: np.ndarray, exchange: Exchange, names: Sequence[str], params: FlipParams) -> np.ndarray:
    """`confidence` (T, J) after the exchange, lowered where sides were exchanged or cannot be distinguished."""
    out = exchanged(confidence, exchange, names)
    legs = leg_points(names)
    factor = np.where(legs[None], exchange.legs[:, None], exchange.rest[:, None])
    out = np.where(factor, out * params.lower, out)
    return np.where(exchange.narrow[:, None], out * params.lower_narrow, out)


def exchanged(values: np.ndarray, exchange: Exchange, names: Sequence[str]) -> np.ndarray:
    """`values` (T, J, ...) with left and right exchanged in the frames of `exchange`."""
    mirror = mirror_of(names)
    if mirror is None:
        return values
    legs = leg_points(names)
    out = values.copy()
    for rows, group in ((exchange.legs, legs), (exchange.rest, ~legs)):
        here = np.flatnonzero(rows)
        out[np.ix_(here, np.flatnonzero(group))] = values[np.ix_(here, mirror[group])]
    return out


def _in_metres(xy_px: np.ndarray, xyz_cam_m: np.ndarray, depth_weight: float) -> np.ndarray:
    """Points (T, J, 3): position in the picture, in metres at the person's distance, and weighted depth."""
    spread_px, spread_m = _spread(xy_px), _spread(xyz_cam_m[..., :2])
    if spread_m is None:  # no 3D
        spread_m, depth = _BODY_SPREAD_M, np.zeros_like(xy_px[..., :1])
    else:
        depth = xyz_cam_m[..., 2:] * depth_weight
    return np.concatenate([xy_px * (spread_m / spread_px if spread_px else np.nan), depth], axis=2)


def _spread(points: np.ndarray) -> float | None:
    """Standard deviation of the points of a frame about their mean, the median over the frames; None if no frame has
    two points."""
    seen = np.isfinite(points).all(axis=2, keepdims=True)
    n = np.maximum(seen.sum(axis=1), 1)
    values = np.where(seen, points, 0.0)
    mean = values.sum(axis=1) / n
    square = (np.where(seen, points - mean[:, None], 0.0) ** 2).sum(axis=(1, 2)) / n[:, 0]
    known = seen.sum(axis=1)[:, 0] > 1
    return float(np.median(np.sqrt(square[known]))) if known.any() else None


def _every(rows: np.ndarray, time_s: np.ndarray, step_s: float) -> np.ndarray:
    """Of `rows`, those that are at least nearly `step_s` after the one before."""
    keep = [rows[0]]
    for row in rows[1:]:
        if time_s[row] - time_s[keep[-1]] >= 0.9 * step_s:
            keep.append(row)
    return np.array(keep)


class _Shown:
    """Points of a frame under each of the four states, and their distances from a prediction."""

    def __init__(
        self,
        points: np.ndarray,
        weight: np.ndarray,
        mirror: np.ndarray,
        paired: Sequence[np.ndarray],
        params: FlipParams,
    ) -> None:
        self._points, self._weight, self._params = points, weight, params
        own = np.arange(len(mirror))
        self._order = np.array(
            [np.where(paired[0], np.where(a, mirror, own), np.where(b, mirror, own)) for a, b in _STATES]
        )
        self._paired = paired[0] | paired[1]

    def at(self, row: int) -> np.ndarray:
        """(4, J, 3) points of a frame under each state."""
        return self._points[row][self._order]

    def weight(self, *rows: int) -> np.ndarray:
        """(J,) weights of the points that have a side, the least of these frames; 0 if one is not seen."""
        return np.where(self._paired, np.min(self._weight[list(rows)], axis=0), 0.0)

    def distance(self, at: np.ndarray, expected: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Weighted mean distance (m) over the points; `at`, `expected` (..., J, 3), `weight` (J,)."""
        apart = np.minimum(np.linalg.norm(at - expected, axis=-1), self._params.most_m)
        return apart @ weight / max(float(weight.sum()), 1e-9)

    def between(self, row: int, near: Sequence[int], states: np.ndarray, time_s: np.ndarray) -> int:
        """Find the state of a frame whose neighbours `near` (one or two) are known."""
        ends = [self.at(k)[s] for k, s in zip(near, states, strict=True)]
        if len(ends) == 2:
            fraction = (time_s[row] - time_s[near[0]]) / (time_s[near[1]] - time_s[near[0]])
            expected = ends[0] + fraction * (ends[1] - ends[0])
        else:
            expected = ends[0]
        cost = self.distance(self.at(row), expected, self.weight(row, *near))
        return int(np.argmin(cost + self._params.change_cost_m * _STATES.any(axis=1)))


def _narrow(names: Sequence[str], xyz_cam_m: np.ndarray, least_width: float) -> np.ndarray:
    """(T,) frames in which the shoulders are less than `least_width` of their usual (median) distance apart."""
    if not {"left_shoulder", "right_shoulder"} <= set(names):
        return np.zeros(len(xyz_cam_m), bool)
    a, b = (xyz_cam_m[:, names.index(f"{side}_shoulder")] for side in ("left", "right"))
    width = np.linalg.norm(a - b, axis=1)
    known = np.isfinite(width)
    return known & (width < least_width * np.median(width[known])) if known.any() else known


def _smoothest(shown: _Shown, time_s: np.ndarray, key: np.ndarray, params: FlipParams) -> np.ndarray:
    """(K,) states of the frames `key` with the least cost: second-order dynamic programming over pairs of states."""
    changed = np.where(_STATES.any(axis=1), params.change_cost_m, 0.0)
    switched = params.switch_cost_m * (_STATES[:, None] != _STATES[None]).any(axis=2)
    n = len(key)
    cost = np.full((_N_STATES, _N_STATES), 0.0)  # (state before, state now)
    cost += changed[:, None] + changed[None] + switched
    if time_s[key[1]] - time_s[key[0]] <= params.max_gap_s:
        a, b = shown.at(key[0]), shown.at(key[1])
        cost += shown.distance(b[None], a[:, None], shown.weight(key[0], key[1]))
    came_from = np.zeros((n, _N_STATES, _N_STATES), np.int8)
    for i in range(2, n):
        first, before, now = key[i - 2], key[i - 1], key[i]
        gap, step = time_s[now] - time_s[before], time_s[before] - time_s[first]
        at = shown.at(now)
        if gap > params.max_gap_s:
            link = np.zeros((_N_STATES,) * 3)
        elif step > params.max_gap_s or gap > 4 * step:
            link = np.broadcast_to(
                shown.distance(at[None], shown.at(before)[:, None], shown.weight(before, now))[None], (_N_STATES,) * 3
            )
        else:
            a, b = shown.at(first), shown.at(before)
            expected = b[None] + (b[None] - a[:, None]) * (gap / step)  # (first, before, J, 3)
            link = shown.distance(at[None, None], expected[:, :, None], shown.weight(first, before, now))
        total = cost[:, :, None] + link
        came_from[i] = np.argmin(total, axis=0)
        cost = np.min(total, axis=0) + changed[None] + switched
    states = np.zeros(n, int)
    states[n - 2], states[n - 1] = np.unravel_index(np.argmin(cost), cost.shape)
    for i in range(n - 1, 1, -1):
        states[i - 2] = came_from[i, states[i - 1], states[i]]
    return states
