"""How many persons a study needs."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import stats

from .types import fraction, numbers, one_of, refuse

DESIGNS = ("paired", "parallel", "parallel-change")
#: Beyond this a study is not one of a laboratory.
_MOST = 1_000_000


@dataclasses.dataclass(frozen=True)
class SampleSize:
    """The persons that a study needs."""

    n: int  # persons who complete it: in all ("paired") or in each of two groups
    recruited: int  # persons to recruit (in each group) so that `n` are left after the drop-outs
    power: float  # reached with `n`
    effect: float  # the change in units of `sd`
    sd: float  # standard deviation of what is compared: of the change, or of the values ("parallel")


def sample_size(
    change: float,
    sd: float,
    icc: float | None = None,
    design: str = "paired",
    power: float = 0.8,
    alpha: float = 0.05,
    dropout: float = 0.0,
    change_sd: float = 0.0,
) -> SampleSize:
    """Persons whom a two-sided t test needs to find a true mean `change` (Cohen 1988; power from the noncentral t).

    Raises `PblError` STATS_INPUT: a number outside its range, no `icc` where one is needed, more than a million
    persons.

    Parameters
    ----------
    change, sd
        The true mean change to be found, and the standard deviation between persons at one visit, in one unit.
    icc
        Correlation of two visits of unchanged persons (`icc` of one visit, "2,1" or "3,1"); not used by "parallel". The
        change then has the standard deviation sd sqrt(2 (1 - icc)).
    design
        "paired": one group before and after. "parallel": two groups compared at one visit. "parallel-change": the
        changes of two groups.
    power, alpha, dropout
        Fractions.
    change_sd
        By how much persons differ in their true change (same unit); adds to the above in squares. 0 presumes that
        everybody changes alike, which gives the smallest study.
    """
    one_of(design, DESIGNS, "design")
    for value, name in ((power, "power"), (alpha, "alpha")):
        fraction(value, name)
    if power <= alpha:
        raise refuse(f"power {power}, alpha {alpha}", "a power above alpha", "correct power, 0.8 is usual")
    change, sd, change_sd, dropout = map(float, numbers([change, sd, change_sd, dropout], "change, sd, ..."))
    positive = (abs(change), sd)
    if not all(0 < v < math.inf for v in positive) or not 0 <= change_sd < math.inf or not 0 <= dropout < 1:
        raise refuse(
            f"change {change}, sd {sd}, change_sd {change_sd}, dropout {dropout}",
            "a change other than 0, sd above 0, change_sd from 0, dropout from 0 to below 1",
            "correct these",
        )
    if design == "parallel":
        spread = sd
    elif icc is None or not -1 <= icc < 1:
        raise refuse(f"icc {icc}", "a number from -1 to below 1", "take it from icc over visits of unchanged persons")
    else:
        spread = math.hypot(sd * math.sqrt(2 * (1 - icc)), change_sd)
    groups = 1 if design == "paired" else 2
    effect = change / spread
    low, high = 1, 2
    while _power(high, effect, groups, alpha) < power:
        low, high = high, 2 * high
        if high > _MOST:
            raise refuse(f"an effect of {effect:.2g} sd", f"one that {_MOST} persons show", "look for a larger change")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _power(middle, effect, groups, alpha) >= power else (middle, high)
    return SampleSize(high, math.ceil(high / (1 - dropout) - 1e-9), _power(high, effect, groups, alpha), effect, spread)


def _power(n: int, effect: float, groups: int, alpha: float) -> float:
    """Of the two-sided t test with n persons per group."""
    df = groups * (n - 1)
    noncentrality = abs(effect) * math.sqrt(n / groups)
    critical = stats.t.isf(alpha / 2, df)
    if noncentrality - critical > 8:  # far beyond the critical value, where the noncentral t has no accurate digits
        return 1.0
    return float(np.nansum([stats.nct.sf(critical, df, noncentrality), stats.nct.cdf(-critical, df, noncentrality)]))
