"""Paired values: standardised response mean, Cohen's d_z, Wilcoxon's signed ranks, agreement, the paper's errors.

Change is post - pre, one value per person; without `post`, `pre` holds the changes themselves.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from scipy import stats

from .types import Estimate, changes, count, fraction, noncentrality, numbers, refuse

#: IQR to the standard deviation of a normal distribution.
NIQR_FACTOR = 0.7413


def niqr(values: Any) -> float:
    """nIQR = IQR * 0.7413 of (N,) values, in their unit; quartiles interpolate linearly.

    Raises `PblError` STATS_INPUT: fewer than two values, NaN.
    """
    array = numbers(values, "values")
    if len(array) < 2:
        raise refuse(f"{len(array)} value(s)", "at least 2", "a spread needs several trials")
    low, high = np.percentile(array, [25, 75])
    return float(NIQR_FACTOR * (high - low))


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
    Bland and Altman's, limit and t sqrt(3 / n) sd, are nearly equal from 50 pairs on.

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


#: Least number of persons for a jackknife or bootstrap of their change.
MIN_PERSONS = 3
#: Number of resamples that are ranked at a time, for the memory.
_CHUNK = 2000


@dataclasses.dataclass(frozen=True)
class Srm(Estimate):
    """A standardised response mean."""

    #: Mean of the pseudo-values (the centre of the interval) and its standard error.
    jackknife: float
    standard_error: float
    #: Of the mean pseudo-value against 0, with n - 1 degrees of freedom, two-sided.
    t: float
    p: float
    n: int  # persons


@dataclasses.dataclass(frozen=True)
class Wilcoxon:
    """Wilcoxon's signed-rank test."""

    statistic: float  # sum of the ranks of the positive changes
    p: float  # Two-sided; exact for up to 50 persons without equal changes, by `scipy.stats.wilcoxon`
    n: int  # all persons
    zeros: int  # persons who did not change, whom the test ignores
    effect: Estimate  # `effect_size` with its interval
    rank_biserial: float  # Matched-pairs rank-biserial correlation: (positive - negative) / all ranks (Kerby 2014)


def srm(pre: Any, post: Any = None, confidence: float = 0.95) -> Srm:
    """Standardised response mean: mean change / sd of change (n - 1), no unit.

    The paper, Statistics (Liang et al. 1990), with its jackknife: pseudo-values n SRM - (n - 1) SRM without one person,
    the interval by Student's t about their mean (Miller 1974).

    Raises `PblError` STATS_INPUT: fewer than three persons, NaN, all changes the same (or all but one).

    Parameters
    ----------
    pre, post : (N,)
        In any unit, the persons in the same order.
    """
    change = changes(pre, post, MIN_PERSONS)
    n = len(change)
    value = change.mean() / change.std(ddof=1)
    # Mean and sum of squares without each person in turn, of values about their mean.
    centred = change - change.mean()
    mean = -centred / (n - 1)
    squares = (centred**2).sum() - centred**2 - (n - 1) * mean**2
    if not squares.min() > 1e-12 * (centred**2).sum():
        raise refuse("all changes but one are the same", "changes that differ", "report the counts instead")
    pseudo = n * value - (n - 1) * (change.mean() + mean) / np.sqrt(squares / (n - 2))
    centre, error = pseudo.mean(), pseudo.std(ddof=1) / np.sqrt(n)
    half = stats.t.isf((1 - fraction(confidence, "confidence")) / 2, n - 1) * error
    t = centre / error
    p = float(2 * stats.t.sf(abs(t), n - 1))
    low, high = float(centre - half), float(centre + half)
    return Srm(float(value), low, high, confidence, float(centre), float(error), float(t), p, n)


def cohens_dz(pre: Any, post: Any = None, confidence: float = 0.95) -> Estimate:
    """Cohen's d_z of paired values: the same number as `srm`, with the exact interval of normally distributed changes.

    From the noncentral t distribution (Cumming & Finch 2001, Educ Psychol Meas 61:532-574). Arguments and errors as
    `srm`.
    """
    change = changes(pre, post, MIN_PERSONS)
    root_n = math.sqrt(len(change))
    value = float(change.mean() / change.std(ddof=1))
    low, high = noncentrality(value * root_n, len(change) - 1, fraction(confidence, "confidence"))
    return Estimate(value, low / root_n, high / root_n, confidence)


def effect_size(
    pre: Any, post: Any = None, confidence: float = 0.95, n_resamples: int = 10_000, seed: int = 0
) -> Estimate:
    """The paper's Wilcoxon effect size r = Z / sqrt(n), from -1 to 1 (Fritz et al. 2012), and its bootstrap interval.

    Clinical Construct Validity, Responsiveness. Z is the signed-rank statistic's normal deviate, equal changes sharing
    their mean rank, without continuity correction; n are the persons who changed. Then r = sum(s R) / sqrt(n sum(R^2))
    with signs s and ranks R: the cosine between the signed ranks and ones, hence the scale. The paper does not name its
    n; its upper limit of 0.91 for mJOA-LE with 17 persons is out of reach without equal or absent changes.
    Interval: percentiles over `n_resamples` resamples of persons, drawn from `seed`, taken further out for few persons
    (expanded percentiles, Hesterberg 2015, Am Stat 69:371-386). NaN if all who changed did so in one direction: then
    every resample does, and does not show how other persons would change.

    Raises `PblError` STATS_INPUT: fewer than three persons, NaN, all changes the same.

    Parameters
    ----------
    pre, post : (N,)
        In any unit, the persons in the same order.
    """
    change = changes(pre, post, MIN_PERSONS)
    value = float(_effect(change[None])[0])
    n = len(change)
    tail = stats.norm.sf(np.sqrt(n / (n - 1)) * stats.t.isf((1 - fraction(confidence, "confidence")) / 2, n - 1))
    if change.min() >= 0 or change.max() <= 0:
        return Estimate(value, np.nan, np.nan, confidence)
    generator = np.random.default_rng(seed)
    resampled = np.empty(count(n_resamples, "n_resamples"))
    for start in range(0, n_resamples, _CHUNK):
        rows = resampled[start : start + _CHUNK]
        rows[:] = _effect(change[generator.integers(n, size=(len(rows), n))])
    low, high = np.quantile(resampled, [tail, 1 - tail])
    return Estimate(value, float(low), float(high), confidence)


def wilcoxon(
    pre: Any, post: Any = None, confidence: float = 0.95, n_resamples: int = 10_000, seed: int = 0
) -> Wilcoxon:
    """Wilcoxon's signed-rank test of a change, with the paper's effect size. Arguments and errors as `effect_size`."""
    change = changes(pre, post, MIN_PERSONS)
    moved = change[change != 0]
    ranks = stats.rankdata(np.abs(moved))
    result: Any = stats.wilcoxon(moved)
    return Wilcoxon(
        statistic=float(ranks[moved > 0].sum()),
        p=float(result.pvalue),
        n=len(change),
        zeros=len(change) - len(moved),
        effect=effect_size(change, None, confidence, n_resamples, seed),
        rank_biserial=float((np.sign(moved) * ranks).sum() / ranks.sum()),
    )


def _effect(change: np.ndarray) -> np.ndarray:
    """(B,) effect sizes of (B, N) changes; 0 for a resample without change."""
    moved = change != 0
    # Persons without change have the lowest ranks; without them the others' begin at 1.
    ranks = (stats.rankdata(np.abs(change), axis=1) - (~moved).sum(axis=1, keepdims=True)) * moved
    norm = np.sqrt(moved.sum(axis=1) * (ranks**2).sum(axis=1))
    return (np.sign(change) * ranks).sum(axis=1) / np.where(norm > 0, norm, 1.0)
