"""Numbers over trials: median and nIQR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline.stats import niqr as niqr_of_all


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


def _finite(values: Sequence[float] | np.ndarray) -> np.ndarray:
    v = np.asarray(values, float)
    return v[np.isfinite(v)]
