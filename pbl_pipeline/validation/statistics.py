"""Numbers over trials: median and nIQR, correlation, and whether one view has smaller errors than another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

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


def pearson(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> tuple[float, float, int]:
    """Pearson's r, its two-sided p and the number of pairs; NaN with fewer than 3 pairs or without variation.

    Residual and error are both continuous, so Pearson and not Spearman (the paper, Statistics).
    """
    x, y = np.asarray(a, float), np.asarray(b, float)
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if x.size < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan"), float("nan"), int(x.size)
    result: Any = stats.pearsonr(x, y)
    return float(result.statistic), float(result.pvalue), int(x.size)


def smaller(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """How much smaller `a` is than `b`: median(b) - median(a), and p of the one-sided Mann-Whitney U test for a < b.

    NaN where one side has no value; p is NaN where one side has fewer than two.
    """
    x, y = _finite(a), _finite(b)
    if x.size == 0 or y.size == 0:
        return float("nan"), float("nan")
    difference = float(np.median(y) - np.median(x))
    if min(x.size, y.size) < 2:
        return difference, float("nan")
    result: Any = stats.mannwhitneyu(x, y, alternative="less")
    return difference, float(result.pvalue)


def _finite(values: Sequence[float] | np.ndarray) -> np.ndarray:
    v = np.asarray(values, float)
    return v[np.isfinite(v)]
