"""Two groups of different persons, normality of values, correlation, and the correction for many tests."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import optimize, special, stats

from .types import (
    Estimate,
    differ,
    fisher_z,
    fraction,
    labels,
    noncentrality,
    numbers,
    one_of,
    refuse,
    same_length,
    sample,
)

CORRELATIONS = ("pearson", "spearman", "repeated")


@dataclasses.dataclass(frozen=True)
class Correlation(Estimate):
    """A correlation coefficient."""

    kind: str  # one of `CORRELATIONS`
    p: float  # Two-sided, against 0, by Student's t with `df` degrees of freedom
    df: int
    n: int  # pairs of values
    persons: int  # as many, unless "repeated"


def correlation(x: Any, y: Any, kind: str = "pearson", persons: Any = None, confidence: float = 0.95) -> Correlation:
    """Correlation of (N,) and (N,) values, of any units.

    "pearson" for two continuous measures, "spearman" if one is ordinal (the paper, Statistics): one pair per person.
    "repeated": the common correlation within persons of several pairs each (Bakdash & Marusich 2017, Front Psychol
    8:456). Several pairs of a person in the first two kinds would make the interval too narrow.
    Intervals: Fisher's z with standard error 1 / sqrt(df - 1), where df = n - 2, or pairs - persons - 1 ("repeated");
    for Spearman sqrt((1 + r^2 / 2) / (df - 1)) (Bonett & Wright 2000, Psychometrika 65:23-28).

    Raises `PblError` STATS_INPUT: unknown kind, fewer than four pairs, NaN, other lengths, a measure with the same
    value throughout (for "repeated": within every person), fewer than two persons or too few repeats.

    Parameters
    ----------
    persons : (N,)
        Labels, for "repeated" only.
    """
    one_of(kind, CORRELATIONS, "kind")
    fraction(confidence, "confidence")
    a, b = sample(x, "x", 4), sample(y, "y", 4)
    same_length(a, b)
    n_persons = len(a)
    if kind == "spearman":
        a, b = stats.rankdata(a), stats.rankdata(b)
    if kind == "repeated":
        a, b, n_persons = _within(a, b, persons)
        df = len(a) - n_persons - 1
    else:
        if persons is not None:
            raise refuse(f"persons with kind {kind!r}", "one pair per person", 'kind "repeated", or average per person')
        a, b = a - a.mean(), b - b.mean()
        df = len(a) - 2
    r = float(np.clip((a @ b) / np.sqrt((a @ a) * (b @ b)), -1, 1))
    variance = (1 + r**2 / 2 if kind == "spearman" else 1.0) / (df - 1)
    estimate = fisher_z(r, np.sqrt(variance), confidence)
    p = float(2 * stats.t.sf(abs(r) * np.sqrt(df / max(1 - r**2, 1e-300)), df))
    return Correlation(estimate.value, estimate.low, estimate.high, confidence, kind, p, df, len(a), n_persons)


def _within(a: np.ndarray, b: np.ndarray, persons: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Values minus the person's mean, and the number of persons."""
    if persons is None:
        raise refuse('kind "repeated" without persons', "the person of each pair", "pass persons")
    index, names = labels(persons, "persons", len(a))
    if len(names) < 2 or len(a) - len(names) - 1 < 2:
        raise refuse(
            f"{len(a)} pairs of {len(names)} person(s)", "several pairs of several persons", "record more visits"
        )
    counts = np.bincount(index)
    within = [v - (np.bincount(index, v) / counts)[index] for v in (a, b)]
    for values, whole, name in zip(within, (a, b), "xy", strict=True):
        if not np.abs(values).max() > 1e-12 * np.abs(whole).max():
            raise refuse(f"{name} never differs within a person", "values that differ", "correlate over persons")
    return within[0], within[1], len(names)


CORRECTIONS = ("holm", "benjamini-hochberg")


def adjust(p: Any, method: str = "holm") -> np.ndarray:
    """Adjust the (N,) p of one family of tests: adjusted p of at most alpha are significant.

    "holm" controls the probability of any false positive (Holm 1979, Scand J Stat 6:65-70), "benjamini-hochberg" the
    expected fraction of false positives among the positives (Benjamini & Hochberg 1995, J R Stat Soc B 57:289-300).

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
    """Interval of P(a > b) + P(a = b) / 2: the values whose standard error reaches `probability`."""
    z = stats.norm.isf((1 - confidence) / 2)
    others = (n_a + n_b) / 2 - 1

    def excess(p: float) -> float:
        shape = 1 + others * (1 - p) / (2 - p) + others * p / (1 + p)
        return float((p - probability) ** 2 - z**2 * p * (1 - p) * shape / (n_a * n_b))

    # The standard error is 0 at 0 and 1, where the other root is wanted.
    low = 0.0 if probability <= 0 else optimize.brentq(excess, 0.0, min(probability, 1 - 1e-9))
    high = 1.0 if probability >= 1 else optimize.brentq(excess, max(probability, 1e-9), 1.0)
    return float(low), float(high)  # pyright: ignore[reportArgumentType]
