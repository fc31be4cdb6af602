"""Correlation of two measures, over persons or within them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import stats

from ._input import fraction, labels, one_of, refuse, same_length, sample
from .types import Estimate, fisher_z

CORRELATIONS = ("pearson", "spearman", "repeated")


@dataclasses.dataclass(frozen=True)
class Correlation(Estimate):
    """A correlation coefficient."""

    kind: str  # one of `CORRELATIONS`
    p: float  # Two-sided, against 0, by Student's t with `df` degrees of freedom
    df: int
    #: Pairs of values; persons that they are of (as many, unless "repeated").
    n: int
    persons: int


def correlation(x: Any, y: Any, kind: str = "pearson", persons: Any = None, confidence: float = 0.95) -> Correlation:
    """Correlation of (N,) and (N,) values, of any units.

    "pearson" for two continuous measures, "spearman" where one is ordinal (the paper, Statistics): one pair per person.
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
    """The values less the person's mean, and how many persons."""
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
