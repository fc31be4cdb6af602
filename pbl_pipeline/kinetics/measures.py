"""Curves and measures of the gait cycles of a trial, from its forces, moments and powers over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline.gait import REPORT_PERCENT, GaitCycle
from pbl_pipeline.gait.events import LEFT
from pbl_pipeline.results import Series
from pbl_pipeline.sampling import interval_of

from .joints import MOMENTS
from .types import CURVES, MEASURES

_HIP, _KNEE, _ANKLE = (MOMENTS.index(name) for name in ("hip_flexion", "knee_flexion", "ankle_angle"))
#: Frames of one stance, fewest.
_MIN_FRAMES = 10


def cycle_table(series: Series, cycles: Sequence[GaitCycle]) -> np.ndarray:
    """Return curves and measures of the cycles as one table (cycles, 51 `CURVES` + `MEASURES`), NaN where unknown."""
    rows = [np.concatenate([_curves(series, c).ravel(), _measures(series, c)]) for c in cycles]
    return np.array(rows).reshape(len(cycles), len(CURVES) * len(REPORT_PERCENT) + len(MEASURES))


def split_table(row: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return curves and measures of one row of `cycle_table`, without those that are not known."""
    n = len(CURVES) * len(REPORT_PERCENT)
    curves = row[:n].reshape(len(CURVES), -1)
    known = {name: c for name, c in zip(CURVES, curves, strict=True) if np.isfinite(c).all()}
    return known, {k: float(v) for k, v in zip(MEASURES, row[n:], strict=True) if np.isfinite(v)}


def _sided(series: Series, k: int) -> np.ndarray:
    """Return the force (N, 3) on foot `k` in body weights: up, forward, towards the other foot."""
    force, ahead = series.force_bw[:, k], series.ahead
    left = force[:, 1] * ahead[:, 0] - force[:, 0] * ahead[:, 1]
    return np.stack([force[:, 2], np.sum(force[:, :2] * ahead, axis=1), -left if k == 0 else left], axis=1)


def _curves(series: Series, cycle: GaitCycle) -> np.ndarray:
    k = 0 if cycle.side == LEFT else 1
    legs = np.hstack([series.moment_nm_per_kg[:, k], series.power_w_per_kg[:, k][:, [_HIP, _KNEE, _ANKLE]]])
    table = np.hstack([_sided(series, k), legs])
    at = cycle.start_s + REPORT_PERCENT / 100.0 * (cycle.end_s - cycle.start_s)
    seen = _seen(series, cycle)
    time = series.time_s[seen]
    if not len(time):
        return np.full((len(CURVES), len(at)), np.nan)
    return np.stack([np.interp(at, time, column) for column in table[seen].T])


def _seen(series: Series, cycle: GaitCycle) -> slice:
    """Return the samples of a cycle and those next to it; none where a part of the cycle is not known."""
    step = 1.5 * interval_of(series.time_s)
    inside = slice(*np.searchsorted(series.time_s, [cycle.start_s - step, cycle.end_s + step]))
    time = series.time_s[inside]
    if len(time) < _MIN_FRAMES or time[0] > cycle.start_s + step or time[-1] < cycle.end_s - step:
        return slice(0)
    return inside if np.diff(time).max() <= step else slice(0)


def _measures(series: Series, cycle: GaitCycle) -> np.ndarray:
    """Return the `MEASURES` of a cycle; all NaN where a part of its stance is not known."""
    k = 0 if cycle.side == LEFT else 1
    stance = (series.time_s >= cycle.start_s) & (series.time_s < cycle.foot_up_s)
    force = _sided(series, k)
    time = series.time_s[stance]
    if len(time) < _MIN_FRAMES or time[-1] - time[0] < 0.9 * (cycle.foot_up_s - cycle.start_s):
        return np.full(len(MEASURES), np.nan)
    first = time < 0.5 * (cycle.start_s + cycle.foot_up_s)
    up, forward = force[stance, 0], force[stance, 1]
    moment, power = series.moment_nm_per_kg[stance, k], series.power_w_per_kg[stance, k]
    adduction = series.knee_adduction_nm_per_kg[stance, k]
    work = [np.trapezoid(power[:, j], time) for j in (_HIP, _KNEE, _ANKLE)]
    return np.array(
        [
            up[first].max(),
            up[~first].max(),
            np.trapezoid(up, time),
            np.trapezoid(np.minimum(forward, 0.0), time),
            np.trapezoid(np.maximum(forward, 0.0), time),
            -moment[first, _KNEE].min(),
            adduction.max(),
            power[~first, _ANKLE].max(),
            *work,
            _excursion(series, cycle),
        ]
    )


def _excursion(series: Series, cycle: GaitCycle) -> float:
    """Return the range (m) of the height of the centre of mass about the line from the start of the cycle to its end,
    NaN where a part of the cycle is not known. Along the way a vertical that is off by 1 deg raises that line by 2 cm
    in each stride."""
    seen = _seen(series, cycle)
    time, height = series.time_s[seen], series.centre_of_mass_m[seen, 2]
    if not len(time):
        return float("nan")
    rise = np.diff(np.interp([cycle.start_s, cycle.end_s], time, height)) / (cycle.end_s - cycle.start_s)
    return float(np.ptp(height - rise * time))
