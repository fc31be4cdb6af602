"""A number with its interval, and the intervals that several statistics share."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import optimize, stats

from ._input import refuse

#: scipy's noncentral t has six correct digits up to here.
_LARGEST_T = 1e4


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic with its confidence interval."""

    #: The statistic and the limits of its interval, in the unit of the statistic.
    value: float
    low: float
    high: float
    confidence: float  # of the interval, 0.95 unless asked otherwise


def fisher_z(r: float, standard_error: float, confidence: float) -> Estimate:
    """Interval of a correlation `r` from the standard error of its Fisher transform artanh(r)."""
    if abs(r) >= 1:
        return Estimate(float(np.sign(r)), float(np.sign(r)), float(np.sign(r)), confidence)
    half = stats.norm.isf((1 - confidence) / 2) * standard_error
    return Estimate(r, float(np.tanh(np.arctanh(r) - half)), float(np.tanh(np.arctanh(r) + half)), confidence)


def noncentrality(t: float, df: float, confidence: float) -> tuple[float, float]:
    """Interval of the noncentrality of which `t` is one draw (exact; Steiger & Fouladi 1997).

    Raises `PblError` STATS_INPUT for |t| beyond what is computed with certainty.
    """
    if abs(t) > _LARGEST_T:
        raise refuse(f"a mean of {abs(t):.0f} standard errors", "values that differ among persons", "check the column")
    tail = (1 - confidence) / 2
    width = 10 * np.sqrt(1 + t**2 / (2 * df))

    def excess(nc: float, probability: float) -> float:
        # Far from t the distribution function is not computed (NaN); it is 1 below and 0 above.
        return float(np.nan_to_num(stats.nct.cdf(t, df, nc), nan=float(nc < t))) - probability

    low, high = (optimize.brentq(excess, t - width, t + width, (p,), xtol=1e-10) for p in (1 - tail, tail))
    return float(low), float(high)  # pyright: ignore[reportArgumentType]
