"""Two recordings of one movement, brought together in time (a lag) and in space (a turn about the vertical)."""

from __future__ import annotations

import numpy as np

#: Times of the reference further apart than this are a hole: nothing is interpolated across it.
MAX_GAP_S = 0.1
#: Fewest common frames for a lag or an error.
MIN_COMMON = 10
#: Steps of the first search for the lag; the second goes by 1 ms.
_COARSE_MS = 10


def at_times(at_s: np.ndarray, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N, K) linear interpolation of `values` (T, K) at `at_s` (N,).

    NaN outside the time stamps, beside a NaN and across holes longer than `MAX_GAP_S`.
    """
    if len(time_s) < 2:
        return np.full((len(at_s), values.shape[1]), np.nan)
    left = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    step = time_s[left + 1] - time_s[left]
    fraction = ((at_s - time_s[left]) / step)[:, None]
    # Where a time stamp is met exactly the neighbour does not count, not even its NaN.
    low, high = values[left], values[left + 1]
    out = np.where(fraction == 0, low, np.where(fraction == 1, high, (1 - fraction) * low + fraction * high))
    hole = (step > MAX_GAP_S)[:, None] & (fraction > 0) & (fraction < 1)
    outside = ((at_s < time_s[0]) | (at_s > time_s[-1]))[:, None]
    return np.where(hole | outside, np.nan, out)


def best_lag(
    time_s: np.ndarray, ours: np.ndarray, reference_s: np.ndarray, theirs: np.ndarray, max_lag_s: float
) -> float:
    """The lag (s) of `ours` (N, K) behind `theirs` (T, K) that minimises the offset-free rms over all K joints.

    The mean difference of each joint is taken out first: a constant error must not pull the lag away from the
    movement's. Searched within +- `max_lag_s` in steps of 10 ms, then of 1 ms around the best, on the same frames for
    every lag (those that the reference covers at all of them) where there are enough, so that the lag cannot choose its
    frames. Of equally good lags the smallest counts. NaN where nothing overlaps at any lag.
    """
    seen = np.any(np.isfinite(ours), axis=1)
    time_s, ours = time_s[seen], ours[seen]
    common = (time_s - max_lag_s >= reference_s[0]) & (time_s + max_lag_s <= reference_s[-1])
    if np.count_nonzero(common) < max(MIN_COMMON, 0.5 * len(time_s)):
        common[:] = True
    time_s, ours = time_s[common], ours[common]

    def cost(lag_ms: int) -> float:
        return _free_of_offset(ours - at_times(time_s - lag_ms / 1000, reference_s, theirs))

    limit = round(1000 * max_lag_s)
    coarse = _cheapest({m: cost(m) for m in (*range(0, limit, _COARSE_MS), limit, *range(-limit, 0, _COARSE_MS))})
    if coarse is None:
        return float("nan")
    around = range(max(-limit, coarse - _COARSE_MS), min(limit, coarse + _COARSE_MS) + 1)
    fine = _cheapest({m: cost(m) for m in around})
    return float("nan") if fine is None else fine / 1000


def _free_of_offset(difference_deg: np.ndarray) -> float:
    """Mean square of (N, K) differences of angles, each joint less its mean; infinite with too few frames."""
    difference = wrapped(difference_deg)
    known = np.isfinite(difference)
    count = known.sum(axis=0)
    enough = count >= MIN_COMMON
    if not enough.any():
        return float("inf")
    used, count = np.where(known, difference, 0.0)[:, enough], count[enough]
    return float(((used**2).sum(axis=0) - used.sum(axis=0) ** 2 / count).sum() / count.sum())


def _cheapest(costs: dict[int, float]) -> int | None:
    """The lag of least cost, of equals (but for rounding) the smallest; None if all are infinite."""
    least = min(costs.values())
    if not np.isfinite(least):
        return None
    return min((lag for lag, c in costs.items() if c <= least + 1e-12), key=abs)


def wrapped(difference_deg: np.ndarray) -> np.ndarray:
    """Differences of angles in (-180, 180] degrees."""
    return -((-difference_deg + 180.0) % 360.0 - 180.0)


def unwrapped(angles_deg: np.ndarray) -> np.ndarray:
    """(T, K) without jumps of 360 degrees between known samples, so that they can be interpolated."""
    out = np.array(angles_deg, float)
    for column in out.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known], period=360.0)
    return out


def align_path(path_m: np.ndarray, reference_m: np.ndarray) -> np.ndarray:
    """`path_m` (N, 3) turned about the vertical (z) and shifted so that it lies closest to `reference_m` (N, 3).

    Least squares in closed form: both without their means, the turn is the angle of the sum of their complex products
    in the plane. Scale is not touched. Rows must be finite.
    """
    centre, aim = path_m.mean(axis=0), reference_m.mean(axis=0)
    a, b = path_m - centre, reference_m - aim
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    return a @ about_vertical(turn).T + aim


def vertical_turn(R_world_a: np.ndarray, R_world_b: np.ndarray) -> float:
    """The angle (rad) about z that brings rotations `R_world_a` (N, 3, 3) closest to `R_world_b` over all frames."""
    m = np.einsum("tij,tkj->ik", R_world_b, R_world_a)
    return float(np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1]))


def about_vertical(angle: float) -> np.ndarray:
    """(3, 3) rotation by `angle` (rad) about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
