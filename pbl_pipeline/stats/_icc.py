"""Repeatability: variance components, intraclass correlation, error of measurement, minimal detectable change."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pandas as pd
from scipy import optimize, stats

from pbl_pipeline.results.measures import minimal_change_of

from .types import Estimate, differ, fraction, labels, numbers, one_of, refuse


@dataclasses.dataclass(frozen=True)
class MeanSquares:
    """Mean squares of a subjects x raters table; with missing ratings those of an equivalent complete one."""

    subjects: float
    raters: float  # equals `error` in models 1 and 3
    error: float  # that within subjects in the one-way model
    df_subjects: int  # degrees of freedom of the three
    df_raters: int
    df_error: int
    n: float  # subjects per rater, the harmonic mean if ratings are missing
    k: float  # ratings per subject, likewise


def mean_squares(ratings: np.ndarray, model: int) -> MeanSquares:
    """Mean squares of (n, k) ratings under Shrout & Fleiss' model 1, 2 or 3 (raters: none, random, fixed).

    Complete tables by the analysis of variance. With NaN the components are those of restricted maximum likelihood
    (REML; no component below zero), and the mean squares what these are expected to be in a table with the harmonic
    mean number of ratings (Thomas & Hultquist 1978, Ann. Stat. 6:582-587, for one factor).

    Raises `PblError` STATS_INPUT.
    """
    seen = np.isfinite(ratings)
    if model == 1 and len(ratings) > 1:  # a column is not a rater: it may be empty for few cycles
        ratings, seen = ratings[:, seen.any(axis=0)], seen[:, seen.any(axis=0)]
    of_subject, of_rater = seen.sum(axis=1), seen.sum(axis=0)
    n, k = ratings.shape
    for counts, what in ((of_subject, "subject"), (of_rater, "rater")):
        if len(counts) < 2:
            raise refuse(f"{len(counts)} {what}", f"at least 2 {what}s", "pass an array of subjects x raters")
        if not counts.all():
            raise refuse(
                f"no rating of {what} {np.flatnonzero(counts == 0)[0]} (counted from 0)",
                f"at least one rating of every {what}",
                f"leave that {what} out and report it",
            )
    known = ratings[seen]
    if not differ(known):
        raise refuse(f"all ratings are {known[0]:g}", "ratings that differ", "check the column")
    df_error = int(seen.sum()) - n - (k - 1 if model > 1 else 0)
    if df_error < 1:
        raise refuse(
            f"{seen.sum()} ratings of {n} subjects by {k} raters",
            "repeated ratings: more than subjects (and raters) together",
            "record more visits or cycles per person",
        )
    df = (n - 1, k - 1, df_error)
    centred = np.where(seen, ratings - known.mean(), 0.0)
    if seen.all():
        by_subject, by_rater = (k * (centred.mean(axis=1) ** 2).sum(), n * (centred.mean(axis=0) ** 2).sum())
        removed = by_subject + (by_rater if model > 1 else 0.0)
        error = max((centred**2).sum() - removed, 0.0) / df_error
        raters = by_rater / (k - 1) if model == 2 else error
        return MeanSquares(by_subject / (n - 1), raters, error, *df, n, k)
    subjects, raters, error = _reml(centred / known.std(), seen, model) * known.var()
    per_subject, per_rater = (len(counts) / (1 / counts).sum() for counts in (of_subject, of_rater))
    return MeanSquares(
        error + per_subject * subjects, error + per_rater * raters, error, *df, float(per_rater), float(per_subject)
    )


def _reml(y: np.ndarray, seen: np.ndarray, model: int) -> np.ndarray:
    """Variances of subjects, raters and error of y (n, k; zero where not `seen`).

    y = mean + subject + rater + error; raters are random (model 2), fixed (3) or none (1). The standard deviations of
    subjects and raters are optimised relative to that of the error, which follows in closed form. With D = I + a S S'
    (S: subjects) and Z the raters' columns, the likelihood only needs the (k, k) matrix Z' D^-1 Z and the (k,) vector
    Z' D^-1 y (Woodbury's identity): its cost grows with n k^2, not with (n k)^3.
    """
    mask = seen.astype(float)
    counts, sums = mask.sum(axis=1), y.sum(axis=1)
    df = seen.sum() - (y.shape[1] if model == 3 else 1)

    def parts(ratios: np.ndarray) -> tuple[float, float]:
        """-2 log restricted likelihood up to a constant, and the error variance."""
        a, b = ratios[0] ** 2, ratios[1] ** 2 if model == 2 else 0.0
        weight = a / (1 + a * counts)
        cross = np.diag(mask.sum(axis=0)) - mask.T @ (weight[:, None] * mask)
        projected = y.sum(axis=0) - mask.T @ (weight * sums)
        squares = (y**2).sum() - (weight * sums**2).sum()
        log_determinant = np.log1p(a * counts).sum()
        if model == 3:
            squares -= projected @ np.linalg.solve(cross, projected)
            log_determinant += np.linalg.slogdet(cross)[1]
        else:
            inner = np.eye(len(cross)) + b * cross
            taken = b * np.linalg.solve(inner, np.column_stack([projected, cross.sum(axis=1)]))
            squares -= projected @ taken[:, 0]
            of_mean = cross.sum() - cross.sum(axis=1) @ taken[:, 1]
            squares -= (projected.sum() - cross.sum(axis=1) @ taken[:, 0]) ** 2 / of_mean
            log_determinant += np.linalg.slogdet(inner)[1] + np.log(of_mean)
        variance = max(squares, 1e-300) / df
        return df * np.log(variance) + log_determinant, variance

    found = optimize.minimize(
        lambda ratios: parts(ratios)[0],
        np.array([1.0, 0.3]) if model == 2 else np.array([1.0]),
        method="Nelder-Mead",
        options={"xatol": 1e-8, "fatol": 1e-10, "maxiter": 2000},
    )
    variance = parts(found.x)[1]
    return variance * np.array([found.x[0] ** 2, found.x[1] ** 2 if model == 2 else 0.0, 1.0])


#: Shrout & Fleiss' kinds: model (1 one-way, 2 two-way random, 3 two-way mixed), and one rating or the mean of k.
ICC_KINDS = ("1,1", "2,1", "3,1", "1,k", "2,k", "3,k")
ICC_INTERVALS = ("f", "generalized")
#: Draws of the mean squares for "generalized": another seed changes its limits by some 0.003.
_DRAWS = 50_000
#: A variance below this fraction of the mean squares is zero.
_ROUNDING = 1e-12


@dataclasses.dataclass(frozen=True)
class Icc(Estimate):
    """An intraclass correlation."""

    kind: str  # one of `ICC_KINDS`
    n: int  # subjects
    k: float  # ratings per subject, of which "1,k" to "3,k" are the mean: the harmonic mean if some are missing
    missing: int  # number of NaN ratings: with any, the variances are by REML
    #: Standard error of measurement of one rating ("x,1") or of the mean of k ("x,k"), in the unit of the ratings: the
    #: square root of the variance that is not the subjects', so sd sqrt(1 - ICC) (Weir 2005, J Strength Cond Res
    #: 19:231-240). Kinds 2 include the variance of the raters, kinds 3 do not.
    sem: float

    @property
    def mdc90(self) -> float:
        """Minimal detectable change, 90 %, in the unit of the ratings."""
        return minimal_detectable_change(self.sem, 0.90)

    @property
    def mdc95(self) -> float:
        """Minimal detectable change, 95 %, in the unit of the ratings."""
        return minimal_detectable_change(self.sem, 0.95)


def minimal_detectable_change(sem: float, confidence: float = 0.95) -> float:
    """`minimal_change_of` the standard error of measurement: z sqrt(2) SEM.

    Weir 2005. Raises `PblError` STATS_INPUT.
    """
    if not 0 <= sem < np.inf:
        raise refuse(f"SEM {sem}", "a number of at least 0", "compute it with icc")
    return minimal_change_of(sem, fraction(confidence, "confidence"))


def ratings_table(values: Any, subjects: Any, raters: Any = None) -> np.ndarray:
    """(subjects, raters) array for `icc` from (N,) values in long form, NaN for a missing rating.

    Without `raters` a subject's ratings count 1, 2, ... in their order (cycles of a recording). Subjects and raters are
    in the order in which they first appear. Raises `PblError` STATS_INPUT, also for two ratings by one rater.
    """
    frame = pd.DataFrame({"value": numbers(values, "values")})
    for name, given in (("subject", subjects), ("rater", raters)):
        if given is not None:
            frame[name] = labels(given, f"{name}s", len(frame))[0]
    if raters is None:
        frame["rater"] = frame.groupby("subject").cumcount()
    if frame.duplicated(["subject", "rater"]).any():
        raise refuse("two ratings of one subject by one rater", "one", "average them, or number them as raters")
    return frame.pivot(index="subject", columns="rater", values="value").to_numpy()


def icc(ratings: Any, kind: str, confidence: float = 0.95, interval: str = "f", seed: int = 0) -> Icc:
    """Intraclass correlation of ratings.

    Shrout & Fleiss 1979 (Psychol Bull 86:420-428), with their intervals from the F distribution, which are those of
    McGraw & Wong 1996 (Psychol Methods 1:30-46): exact for kinds 1 and 3, Satterthwaite's approximation for kinds 2.
    The paper's ICC2 and ICC2k (Clinical Construct Validity; Table 2) are "2,1" and "2,k" over steps of one day.

    Raises `PblError` STATS_INPUT: unknown kind, another shape, infinite values, fewer than two subjects or raters, all
    ratings equal, a subject or rater without any rating, no subject with two ratings; no variance between subjects; for
    the mean of k ratings also means of the subjects that differ so little that it is not defined.

    Returns `Icc`, with low <= value <= high <= 1. A value is negative if subjects differ less than by error alone;
    `low` of a mean of k is -inf if the ratings put no lower bound on it.

    Parameters
    ----------
    ratings : (n, k)
        Subjects x raters (visits, cycles), in any unit. NaN: missing (`mean_squares`); no subject is dropped.
    kind
        One of `ICC_KINDS`. "1,1": each subject has its own raters (cycles of a recording). "2,1": the raters are a
        sample and their means count as disagreement. "3,1": these raters alone, their means do not count (visits
        between which all subjects may have changed). "k" for the mean of k ratings.
    interval
        "f" as above. "generalized": from draws of the mean squares, with `seed` (Weerahandi 1993, J Am Stat Assoc
        88:899-905; compared by Ionan et al. 2014, BMC Med Res Methodol 14:121). For kinds 2 with few raters whose means
        differ: then "f" contains the truth in as few as 80 % of studies (docs/statistics.md).
    """
    one_of(kind, ICC_KINDS, "kind")
    one_of(interval, ICC_INTERVALS, "interval")
    fraction(confidence, "confidence")
    table = numbers(ratings, "ratings", ndim=2, missing=True)
    model = int(kind[0])
    ms = mean_squares(table, model)
    subjects = (ms.subjects - ms.error) / ms.k
    noise = ms.error + (ms.raters - ms.error) / ms.n
    total = subjects + noise
    if total <= _ROUNDING * (ms.subjects + ms.raters + ms.error):
        raise refuse(
            "ratings without any variance between subjects",
            "subjects that differ",
            "check the column; another kind has a value where raters differ",
        )
    value = subjects / total
    tail = (1 - confidence) / 2
    low, high = _limits(ms, value, model, tail) if interval == "f" else _drawn_limits(ms, model, tail, seed)
    # Limits of the F distribution exclude the value for a confidence below about 0.5, drawn ones where it is negative.
    low, high = min(low, value), min(max(high, value), 1.0)
    if kind.endswith("k"):
        value, low, high = (_of_mean(r, ms.k) for r in (value, low, high))
        noise /= ms.k
        if not np.isfinite(value):
            raise refuse(
                "means of the subjects that differ less than the error of their ratings alone would make them",
                "subjects that differ",
                f"report kind {kind[0]},1: the reliability of a mean of k ratings is not defined here",
            )
    return Icc(
        value=float(value),
        low=float(low),
        high=float(high),
        confidence=confidence,
        kind=kind,
        n=len(table),
        k=ms.k,
        missing=int(np.isnan(table).sum()),
        sem=float(np.sqrt(max(noise, 0.0))),
    )


def _of_mean(r: float, k: float) -> float:
    """Reliability of a mean of k ratings from that of one (Spearman & Brown); -inf if it has no lower bound."""
    scale = 1 + (k - 1) * r
    return k * r / scale if scale > _ROUNDING else -np.inf


def _limits(ms: MeanSquares, value: float, model: int, tail: float) -> tuple[float, float]:
    """Limits of the reliability of one rating, from the F distribution."""
    if model == 2:
        weight_raters = ms.k * value
        weight_error = ms.n * (1 + (ms.k - 1) * value) - ms.k * value
        parts = np.array([weight_raters * ms.raters, weight_error * ms.error])
        spread = (parts**2 / (ms.df_raters, ms.df_error)).sum()
        df = parts.sum() ** 2 / spread if spread > 0 else ms.df_error
        # A negative reliability weights the raters negatively; a sum of variances never has fewer degrees.
        df = max(df, min(ms.df_raters, ms.df_error))
        noise = ms.k * ms.raters + (ms.k * ms.n - ms.k - ms.n) * ms.error
        lower, upper = stats.f.isf(tail, ms.df_subjects, df), stats.f.isf(tail, df, ms.df_subjects)
        return (
            float(ms.n * (ms.subjects - lower * ms.error) / (lower * noise + ms.n * ms.subjects)),
            float(ms.n * (upper * ms.subjects - ms.error) / (noise + ms.n * upper * ms.subjects)),
        )
    lower = ms.error * stats.f.isf(tail, ms.df_subjects, ms.df_error)
    upper = ms.error / stats.f.isf(tail, ms.df_error, ms.df_subjects)
    low, high = ((ms.subjects - x) / (ms.subjects + (ms.k - 1) * x) for x in (lower, upper))
    return float(low), float(high)


def _drawn_limits(ms: MeanSquares, model: int, tail: float, seed: int) -> tuple[float, float]:
    """Limits of the reliability of one rating: quantiles over variances that could have these mean squares."""
    g = np.random.default_rng(seed)
    error = ms.error * ms.df_error / g.chisquare(ms.df_error, _DRAWS)
    subjects = np.maximum(ms.subjects * ms.df_subjects / g.chisquare(ms.df_subjects, _DRAWS) - error, 0) / ms.k
    noise = error
    if model == 2:
        noise = error + np.maximum(ms.raters * ms.df_raters / g.chisquare(ms.df_raters, _DRAWS) - error, 0) / ms.n
    total = subjects + noise
    low, high = np.quantile(subjects / np.where(total > 0, total, 1.0), [tail, 1 - tail])
    return float(low), float(high)
