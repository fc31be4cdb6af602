"""Correction for many tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from ._input import numbers, one_of, refuse

CORRECTIONS = ("holm", "benjamini-hochberg")


def adjust(p: Any, method: str = "holm") -> np.ndarray:
    """(N,) adjusted p of the (N,) p of one family of tests: those of at most alpha are significant.

    "holm" keeps the chance of any false alarm (Holm 1979, Scand J Stat 6:65-70), "benjamini-hochberg" the expected
    fraction of false alarms among what is found (Benjamini & Hochberg 1995, J R Stat Soc B 57:289-300).

    Raises `PblError` STATS_INPUT: unknown method, no p, NaN, p outside 0 to 1.
    """
    one_of(method, CORRECTIONS, "method")
    values = numbers(p, "p")
    if not len(values) or values.min() < 0 or values.max() > 1:
        raise refuse(f"{len(values)} values of p, not all of them between 0 and 1", "p values", "pass p")
    if method == "benjamini-hochberg":
        return stats.false_discovery_control(values)
    order, n = np.argsort(values, kind="stable"), len(values)
    adjusted = np.empty(n)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(n, 0, -1)), 1.0)
    return adjusted
