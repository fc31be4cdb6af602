"""Regions of the person in each frame: smoothed over time, and corrected by a first pass."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.sampling import interval_of

from .protocol import KeypointParams
from .types import PersonKeypoints

#: Standard deviations at which the Gaussian kernel is cut off.
REACH_SD = 4.0
#: A tenth of a degree, a quarter of a pixel at the edge of a crop of 256 pixels.
ROTATION_STEP_RAD = 1 / 512


def smooth_rois(roi: np.ndarray, time_s: np.ndarray, sigma_s: float) -> np.ndarray:
    """Regions (T, 4) smoothed over time by a Gaussian kernel; size as logarithm, rotation on the circle.

    Frames without a region (NaN) stay NaN and are ignored.
    """
    good = np.flatnonzero(np.isfinite(roi).all(axis=1))
    out = np.full(roi.shape, np.nan)
    known, known_s = roi[good], time_s[good]
    for row, at_s in zip(good, known_s, strict=True):
        out[row] = smooth_at(known, known_s, float(at_s), sigma_s)
    return out


def smooth_at(roi: np.ndarray, time_s: np.ndarray, at_s: float, sigma_s: float) -> np.ndarray:
    """Smooth the regions (K, 4) at `time_s` (K,) as `smooth_rois` and return the one (4,) at `at_s`. Regions within
    `REACH_SD` standard deviations count; without any, or with `sigma_s` 0, the nearest is returned."""
    near = slice(
        np.searchsorted(time_s, at_s - REACH_SD * sigma_s),
        np.searchsorted(time_s, at_s + REACH_SD * sigma_s, side="right"),
    )
    if sigma_s <= 0 or near.stop <= near.start:
        return roi[np.argmin(np.abs(time_s - at_s))]
    x, y, side, turn = roi[near].T
    values = np.stack([x, y, np.log(side), np.sin(turn), np.cos(turn)], axis=1)
    # A straight line is fitted under the kernel: at the ends of a track a mean would lag behind the person.
    tau = time_s[near] - at_s
    weight = np.exp(-0.5 * (tau / sigma_s) ** 2)
    design = np.stack([np.ones(len(tau)), tau / sigma_s], axis=1)
    normal = design.T @ (weight[:, None] * design) + np.diag([0.0, 1e-9])
    value = np.linalg.solve(normal, design.T @ (weight[:, None] * values))[0]
    return np.array([value[0], value[1], np.exp(value[2]), np.arctan2(value[3], value[4])])


def rounded(roi: np.ndarray, step_px: float) -> np.ndarray:
    """Regions (..., 4) on the grid of `KeypointParams.crop_step_px`."""
    if step_px <= 0:
        return roi
    step = np.array([step_px, step_px, step_px, ROTATION_STEP_RAD])
    return np.maximum(np.round(roi / step), [-np.inf, -np.inf, 1, -np.inf]) * step


def corrected(
    roi: np.ndarray, found: PersonKeypoints, min_presence: float, max_drift: float, max_growth: float
) -> np.ndarray:
    """Return the region (4,) that the keypoints show, or `roi` (4,) if they show no one or another person.

    `max_drift` and `max_growth` as in `KeypointParams`.
    """
    if found.presence < min_presence or not np.all(np.isfinite(found.roi_px)):
        return roi
    drift = float(np.hypot(*(found.roi_px[:2] - roi[:2]))) / roi[2]
    growth = abs(float(np.log(found.roi_px[2] / roi[2])))
    return found.roi_px if drift <= max_drift and growth <= np.log(max_growth) else roi


def sampled_rows(rows: np.ndarray, time_s: np.ndarray, interval_s: float) -> np.ndarray:
    """Select of the frames `rows` (K,) one in each `interval_s`, and the first and last of each run of frames without a
    longer gap. 0: all."""
    if interval_s <= 0 or len(rows) < 2:
        return rows
    time = time_s[rows]
    slack = 0.5 * interval_of(time)
    breaks = np.diff(time) > interval_s + slack
    ends = np.concatenate([[True], breaks]) | np.concatenate([breaks, [True]])
    keep, next_s = [], -np.inf
    for row, t, end in zip(rows, time, ends, strict=True):
        if end or t + slack >= next_s:
            keep.append(row)
            next_s = t + interval_s
    return np.array(keep, dtype=rows.dtype)


class Regions:
    """Regions over a track (T, 4): the track's own in the first pass, corrected by its results in the second.

    Attributes
    ----------
    track_px : (T, 4)
        Of the track, NaN where the person is not in view.
    rows
        Frames in which the person is in view.
    first
        Those of the first pass; empty if `params.passes` is 1, and then the second takes the track's regions.
    reach_s
        A region of the second pass depends on results of the first up to so much later.
    """

    def __init__(self, track_px: np.ndarray, time_s: np.ndarray, params: KeypointParams) -> None:
        self.track_px, self._time_s, self._params = rounded(track_px, params.crop_step_px), time_s, params
        self.rows = np.flatnonzero(np.isfinite(track_px).all(axis=1))
        first = sampled_rows(self.rows, time_s, params.first_look_s) if params.passes > 1 else self.rows[:0]
        self.first = frozenset(first.tolist())
        self.reach_s = REACH_SD * params.smooth_s if params.passes > 1 else 0.0
        self._corrected_s = time_s[first]
        self._corrected, self._n = np.empty((len(first), 4)), 0

    def correct(self, row: int, found: PersonKeypoints) -> None:
        """Add the result of the first pass in the next of its frames."""
        p = self._params
        self._corrected[self._n] = corrected(self.track_px[row], found, p.min_presence, p.max_drift, p.max_growth)
        self._n += 1

    def at(self, row: int) -> np.ndarray:
        """Region (4,) of a frame in the second pass, by the results added so far."""
        if not self.first:
            return self.track_px[row]
        regions, at_s = self._corrected[: self._n], self._corrected_s[: self._n]
        region = smooth_at(regions, at_s, float(self._time_s[row]), self._params.smooth_s)
        return rounded(region, self._params.crop_step_px)
