"""Sampling interval of time stamps, which their writers round and drop frames of."""

from __future__ import annotations

import numpy as np

#: Largest deviation of an interval from a whole number of sampling intervals, as a fraction of one.
_EVEN = 0.45
#: Intervals below this multiple of the median lack no frame: 3 ticks of 2, if the rate is 240 and the tick 1/600 s.
_LONGEST = 1.75
#: Relative difference below which the median is returned, so that stamps that are not rounded keep it.
_SAME = 1e-6


def interval_of(time_s: np.ndarray) -> float:
    """Return the sampling interval of increasing stamps (N,), N > 1, in their unit.

    Rounded stamps (WebM, MKV: 1 ms; QuickTime: 1/600 s) have intervals of two lengths, and their median is off by up to
    a tick: 33 ms for 30 frames a second. If the stamps lie on a grid within what their intervals differ, which rounding
    ensures and a drifting rate does not, the interval is their span divided by the number of intervals, those of
    dropped frames included: (n - 1) / span without them. Else it is the median.
    """
    time = np.asarray(time_s, float)
    steps = np.diff(time)
    median = float(np.median(steps))
    if not median > 0 or not np.isfinite(steps).all():
        return median
    single = float(np.mean(steps[steps < _LONGEST * median]))
    counts = np.maximum(np.rint(steps / single), 1.0)
    interval = float(time[-1] - time[0]) / float(counts.sum())
    off = steps - counts * single
    drift = np.abs(time - time[0] - interval * np.r_[0.0, np.cumsum(counts)]).max()
    even = np.abs(off).max() <= _EVEN * single and drift <= np.ptp(off)
    return interval if even and abs(interval - median) > _SAME * median else median
