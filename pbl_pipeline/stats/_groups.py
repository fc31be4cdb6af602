"""Two groups of different persons, and whether values are normally distributed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import optimize, special, stats

from ._input import differ, fraction, numbers, refuse, sample
from .types import Estimate, noncentrality


@dataclasses.dataclass(frozen=True)
class Test:
    """A test: its name, statistic, two-sided p, and the number of values (of both groups)."""

    name: str
    statistic: float
    p: float
    n: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class MannWhitney(Test):
    """A Mann-Whitney U test. `statistic` is U of the first group."""

    rank_biserial: Estimate  # 2 U / (n_a n_b) - 1: P(a > b) - P(a < b)


def shapiro_wilk(values: Any) -> Test:
    """Shapiro-Wilk test of (N,) values against a normal distribution (Royston 1995, by scipy).

    Raises `PblError` STATS_INPUT: fewer than 3 values, more than 5000 (p is not accurate there), NaN, all equal.
    """
    x = sample(values, "values", 3)
    if len(x) > 5000:
        raise refuse(f"{len(x)} values", "at most 5000", "look at a quantile plot: so many always differ from a normal")
    result: Any = stats.shapiro(x)
    return Test("Shapiro-Wilk", float(result.statistic), float(result.pvalue), (len(x),))


def mann_whitney(a: Any, b: Any, confidence: float = 0.95) -> MannWhitney:
    """Mann-Whitney U test of (N,) and (M,) values of different persons, with the rank-biserial correlation.

    p by `scipy.stats.mannwhitneyu` (exact where both groups have at most 8 and no values are equal). Interval of the
    correlation: Newcombe 2006 (Stat Med 25:559-573), method 5. Raises `PblError` STATS_INPUT: fewer than 2 values in a
    group, NaN, all values equal.
    """
    x, y = _two(a, b)
    result: Any = stats.mannwhitneyu(x, y)
    value = 2 * float(result.statistic) / (len(x) * len(y)) - 1
    low, high = _newcombe((value + 1) / 2, len(x), len(y), fraction(confidence, "confidence"))
    return MannWhitney(
        "Mann-Whitney U",
        float(result.statistic),
        float(result.pvalue),
        (len(x), len(y)),
        Estimate(value, 2 * low - 1, 2 * high - 1, confidence),
    )


def hedges_g(a: Any, b: Any, confidence: float = 0.95) -> Estimate:
    """Hedges' g of (N,) and (M,) values: (mean a - mean b) / pooled sd, times the exact correction of its bias.

    Hedges 1981 (J Educ Stat 6:107-128); interval from the noncentral t distribution, for normal values of one variance.
    Raises `PblError` STATS_INPUT: fewer than 2 values in a group, NaN, no spread within the groups.
    """
    x, y = _two(a, b)
    df = len(x) + len(y) - 2
    pooled = np.sqrt((((x - x.mean()) ** 2).sum() + ((y - y.mean()) ** 2).sum()) / df)
    if not differ(x) and not differ(y):
        raise refuse("no spread within the groups", "values that differ", "check the columns")
    correction = np.exp(special.gammaln(df / 2) - special.gammaln((df - 1) / 2)) / np.sqrt(df / 2)
    scale = np.sqrt(len(x) * len(y) / (len(x) + len(y)))
    d = (x.mean() - y.mean()) / pooled
    low, high = noncentrality(float(d * scale), df, fraction(confidence, "confidence"))
    value, low, high = (float(correction * v) for v in (d, low / scale, high / scale))
    return Estimate(value, low, high, confidence)


def compare_groups(a: Any, b: Any, alpha: float = 0.05) -> Test:
    """The paper's test of two groups (Statistics): Student's t where Shapiro-Wilk rejects neither, else Mann-Whitney U.

    Raises `PblError` STATS_INPUT as `shapiro_wilk`.
    """
    fraction(alpha, "alpha")
    if min(shapiro_wilk(a).p, shapiro_wilk(b).p) < alpha:
        return mann_whitney(a, b)
    x, y = _two(a, b)
    result: Any = stats.ttest_ind(x, y)
    return Test("Student's t", float(result.statistic), float(result.pvalue), (len(x), len(y)))


def _two(a: Any, b: Any) -> tuple[np.ndarray, np.ndarray]:
    """Two groups of at least two values, not all the same over both."""
    groups = [numbers(g, name) for g, name in ((a, "a"), (b, "b"))]
    for group, name in zip(groups, "ab", strict=True):
        if len(group) < 2:
            raise refuse(f"{len(group)} value(s) in group {name}", "at least 2", "record more persons")
    both = sample(np.concatenate(groups), "values of both groups", 4)
    return both[: len(groups[0])], both[len(groups[0]) :]


def _newcombe(probability: float, n_a: int, n_b: int, confidence: float) -> tuple[float, float]:
    """Interval of P(a > b) + P(a = b) / 2: the values whose own standard error reaches `probability`."""
    z = stats.norm.isf((1 - confidence) / 2)
    others = (n_a + n_b) / 2 - 1

    def excess(p: float) -> float:
        shape = 1 + others * (1 - p) / (2 - p) + others * p / (1 + p)
        return float((p - probability) ** 2 - z**2 * p * (1 - p) * shape / (n_a * n_b))

    # At 0 and 1 the standard error is 0: there, too, the root sought is the other one.
    low = 0.0 if probability <= 0 else optimize.brentq(excess, 0.0, min(probability, 1 - 1e-9))
    high = 1.0 if probability >= 1 else optimize.brentq(excess, max(probability, 1e-9), 1.0)
    return float(low), float(high)  # pyright: ignore[reportArgumentType]
