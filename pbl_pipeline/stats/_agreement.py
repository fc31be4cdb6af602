"""Agreement of two methods of measurement."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from scipy import stats

from ._input import changes, fraction
from .types import Estimate

#: Bland and Altman's multiple of the standard deviation: 95 % of normal differences.
LIMIT_SD = 1.96


@dataclasses.dataclass(frozen=True)
class BlandAltman:
    """Limits of agreement, in the unit of the values."""

    bias: Estimate  # mean of a - b with Student's interval
    #: bias - and + 1.96 sd, each with its interval.
    lower: Estimate
    upper: Estimate
    sd: float  # of the differences (n - 1)
    n: int  # pairs


def bland_altman(a: Any, b: Any, confidence: float = 0.95) -> BlandAltman:
    """Limits of agreement of (N,) and (N,) values, one pair per person (Bland & Altman 1986, Lancet 327:307-310).

    The intervals of the limits are exact for normal differences (noncentral t; Carkeet 2015, Optom Vis Sci 92:e71-80).
    Bland and Altman's own, limit and t sqrt(3 / n) sd, are nearly that from 50 pairs on.

    Raises `PblError` STATS_INPUT: fewer than three pairs, NaN, other lengths, all differences the same.
    """
    difference = changes(b, a, 3)
    fraction(confidence, "confidence")
    n, bias, sd = len(difference), float(difference.mean()), float(difference.std(ddof=1))
    error = sd / math.sqrt(n)
    # A limit mean + c sd, c standard errors of it: the noncentrality of (sample mean - limit) / error is -1.96 sqrt(n).
    tail = (1 - confidence) / 2
    near, far = (float(stats.nct.ppf(q, n - 1, LIMIT_SD * math.sqrt(n))) * error for q in (tail, 1 - tail))
    half = float(stats.t.isf(tail, n - 1)) * error
    return BlandAltman(
        bias=Estimate(bias, bias - half, bias + half, confidence),
        lower=Estimate(bias - LIMIT_SD * sd, bias - far, bias - near, confidence),
        upper=Estimate(bias + LIMIT_SD * sd, bias + near, bias + far, confidence),
        sd=sd,
        n=n,
    )
