"""The direction a person faces, from the line through the hips, and its check against where the person goes."""

from __future__ import annotations

import numpy as np

#: The pelvis turns with every stride, so its direction is averaged twice over this time (about one stride).
HEADING_WINDOW_S = 1.0
#: Below this speed the direction of travel says nothing about the heading.
MIN_TRAVEL_M_PER_S = 0.3


def heading_from_hips(time_s: np.ndarray, hip_m: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Unit horizontal heading (T, 3) from the hips (T, 2, 3) [left, right]; NaN where no hip is seen nearby.

    Forward is left x up. The horizontal hip line is averaged over `HEADING_WINDOW_S` twice (a triangular window),
    which removes most of the pelvic rotation within a stride and still follows a turn.
    """
    left = hip_m[:, 0] - hip_m[:, 1]
    left = left - (left @ up)[:, None] * up
    smooth = _moving_mean(time_s, _moving_mean(time_s, left, HEADING_WINDOW_S), HEADING_WINDOW_S)
    forward = np.cross(smooth, up)
    length = np.linalg.norm(forward, axis=1)
    forward[~(length > 1e-9)] = np.nan
    return forward / np.where(length > 1e-9, length, 1.0)[:, None]


def heading_agreement(time_s: np.ndarray, pelvis_m: np.ndarray, forward: np.ndarray, up: np.ndarray) -> float:
    """Cosine between heading and displacement over half-second steps, weighted by the way; NaN without travel."""
    seen = np.all(np.isfinite(pelvis_m), axis=1) & np.all(np.isfinite(forward), axis=1)
    if np.count_nonzero(seen) < 2:
        return float("nan")
    time, pelvis, ahead = time_s[seen], pelvis_m[seen], forward[seen]
    later = np.searchsorted(time, time + 0.5)
    start = np.flatnonzero(later < len(time))
    if len(start) == 0:
        return float("nan")
    end = later[start]
    step = pelvis[end] - pelvis[start]
    step = step - (step @ up)[:, None] * up
    way, duration = np.linalg.norm(step, axis=1), time[end] - time[start]
    # A step across a gap in view may hide a turn.
    use = (way / duration > MIN_TRAVEL_M_PER_S) & (duration < 0.75)
    if not np.any(use):
        return float("nan")
    along = np.einsum("ti,ti->t", step[use], ahead[start[use]])
    return float(along.sum() / way[use].sum())


def _moving_mean(time_s: np.ndarray, values: np.ndarray, window_s: float) -> np.ndarray:
    """Mean of the finite rows within half a window; NaN where there is none."""
    ok = np.all(np.isfinite(values), axis=1)
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(np.where(ok[:, None], values, 0.0), axis=0)])
    count = np.concatenate([[0], np.cumsum(ok)])
    low = np.searchsorted(time_s, time_s - window_s / 2)
    high = np.searchsorted(time_s, time_s + window_s / 2, side="right")
    n = (count[high] - count[low]).astype(float)
    n[n == 0] = np.nan
    return (total[high] - total[low]) / n[:, None]
