"""Irregular samples to a uniform, low-passed grid, in segments without gaps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator


@dataclasses.dataclass(frozen=True)
class Segment:
    """A stretch without long gaps: `time_s` (N,) uniform, `values` (N, C) low-passed, `frames` (first, last)."""

    time_s: np.ndarray
    values: np.ndarray
    frames: tuple[int, int]


def uniform_segments(
    time_s: np.ndarray,
    values: np.ndarray,
    *,
    grid_hz: float,
    cutoff_hz: float,
    filter_order: int,
    max_gap_s: float,
    min_segment_s: float,
    interpolator: Callable[..., Any] = PchipInterpolator,
) -> list[Segment]:
    """Split (T, C) `values` at gaps, interpolate onto a uniform grid (monotone cubic, or scipy's `interpolator`) and
    low-pass filter without lag.

    A gap is a time of more than `max_gap_s` between frames in which every value is finite. The filter is a
    Butterworth run forward and backward: `filter_order` counts both passes, and its cut-off is corrected so that
    the two passes together are at -3 dB at `cutoff_hz`.
    """
    from scipy.signal import butter, sosfiltfilt  # takes longer to import than most commands run

    seen = np.flatnonzero(np.all(np.isfinite(values), axis=1))
    if len(seen) < 2:
        return []
    breaks = np.flatnonzero(np.diff(time_s[seen]) > max_gap_s)
    runs = np.split(seen, breaks + 1)
    n_pass = max(1, filter_order // 2)
    # Two passes of a Butterworth of order n are at -3 dB where one pass is at -1.5 dB.
    corrected = cutoff_hz / (2**0.5 - 1) ** (1 / (2 * n_pass))
    sos = butter(n_pass, corrected, fs=grid_hz, output="sos")
    segments = []
    for run in runs:
        t = time_s[run]
        if len(run) < 4 or t[-1] - t[0] < min_segment_s:
            continue
        grid = t[0] + np.arange(int(np.floor((t[-1] - t[0]) * grid_hz + 1e-9)) + 1) / grid_hz
        raw = interpolator(t, values[run], axis=0)(grid)
        pad = min(len(grid) - 1, int(grid_hz / 2))
        smooth = sosfiltfilt(sos, raw, axis=0, padlen=pad)
        segments.append(Segment(grid, smooth, (int(run[0]), int(run[-1]))))
    return segments


def refine_extremum(time_s: np.ndarray, values: np.ndarray, index: int) -> float:
    """Time of the vertex of the parabola through the extremum and its two neighbours on a uniform grid."""
    if index == 0 or index == len(values) - 1:
        return float(time_s[index])
    a, b, c = values[index - 1 : index + 2]
    curvature = a - 2 * b + c
    shift = 0.0 if curvature == 0 else float(np.clip(0.5 * (a - c) / curvature, -0.5, 0.5))
    return float(time_s[index] + shift * (time_s[1] - time_s[0]))
