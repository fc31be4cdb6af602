"""Numbers over trials: median and nIQR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import niqr as niqr_of_all
from pbl_pipeline.stats import shapiro_wilk

#: Most values of a Shapiro-Wilk test: beyond 5,000 its p is not accurate.
_MOST_TESTED = 5000


def median_niqr(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Median and nIQR = IQR * 0.7413 of the finite values; quartiles interpolate linearly.

    NaN without a value; the nIQR is NaN with one, because one value has no spread.
    """
    v = _finite(values)
    if v.size == 0:
        return float("nan"), float("nan")
    return float(np.median(v)), niqr(v)


def niqr(values: Sequence[float] | np.ndarray) -> float:
    """IQR * 0.7413 of the finite values; NaN with fewer than two."""
    v = _finite(values)
    return niqr_of_all(v) if v.size >= 2 else float("nan")


def normality_p(values: Sequence[float] | np.ndarray) -> float:
    """p of the Shapiro-Wilk test of the finite values against a normal distribution (scipy).

    Of more than 5,000 values every second, third ... counts. NaN with fewer than three or where all are the same.
    """
    v = _finite(values)
    try:
        return shapiro_wilk(v[:: -(-v.size // _MOST_TESTED) or 1]).p
    except PblError:
        return float("nan")


def _finite(values: Sequence[float] | np.ndarray) -> np.ndarray:
    v = np.asarray(values, float)
    return v[np.isfinite(v)]
