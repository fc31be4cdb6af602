"""Where to cut the person out of each frame: regions over time, smoothed, and corrected by a first look."""

from __future__ import annotations

import numpy as np

from ._protocol import PersonKeypoints

#: The Gaussian kernel is cut off at so many standard deviations.
REACH_SD = 4.0


def smooth_rois(roi: np.ndarray, time_s: np.ndarray, sigma_s: float) -> np.ndarray:
    """Regions (T, 4) smoothed over time by a Gaussian kernel; size as logarithm, rotation on the circle.

    Frames without a region (NaN) stay so, and take no part.
    """
    good = np.flatnonzero(np.isfinite(roi).all(axis=1))
    out = np.full(roi.shape, np.nan)
    known, known_s = roi[good], time_s[good]
    for row, at_s in zip(good, known_s, strict=True):
        out[row] = smooth_at(known, known_s, float(at_s), sigma_s)
    return out


def smooth_at(roi: np.ndarray, time_s: np.ndarray, at_s: float, sigma_s: float) -> np.ndarray:
    """One region (4,) at `at_s` from the regions (K, 4) at `time_s` (K,), as `smooth_rois`; those within `REACH_SD`
    standard deviations count, and where there is none the nearest. `sigma_s` 0: the nearest."""
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


def corrected(
    roi: np.ndarray, found: PersonKeypoints, min_presence: float, max_drift: float, max_growth: float
) -> np.ndarray:
    """The region (4,) that the keypoints show, or `roi` (4,) where they show nobody or somebody else: `max_drift` and
    `max_growth` as in `KeypointParams`."""
    if found.presence < min_presence or not np.all(np.isfinite(found.roi_px)):
        return roi
    drift = float(np.hypot(*(found.roi_px[:2] - roi[:2]))) / roi[2]
    growth = abs(float(np.log(found.roi_px[2] / roi[2])))
    return found.roi_px if drift <= max_drift and growth <= np.log(max_growth) else roi


def first_looks(rows: np.ndarray, time_s: np.ndarray, interval_s: float) -> np.ndarray:
    """Those of the frames `rows` (K,) in which a first look corrects the crop: one in each `interval_s`, and the first
    and last of each run of frames that has no gap longer than that. 0: all of them."""
    if interval_s <= 0 or len(rows) < 2:
        return rows
    time = time_s[rows]
    slack = 0.5 * float(np.median(np.diff(time)))
    breaks = np.diff(time) > interval_s + slack
    ends = np.concatenate([[True], breaks]) | np.concatenate([breaks, [True]])
    keep, next_s = [], -np.inf
    for row, t, end in zip(rows, time, ends, strict=True):
        if end or t + slack >= next_s:
            keep.append(row)
            next_s = t + interval_s
    return np.array(keep, dtype=rows.dtype)
