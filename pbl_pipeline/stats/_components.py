"""Variance components of ratings: subjects, raters, error."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import optimize

from ._input import differ, refuse


@dataclasses.dataclass(frozen=True)
class MeanSquares:
    """Mean squares of a subjects x raters table; with missing ratings those of an equivalent complete one."""

    #: Mean squares. `error` is that within subjects in the one-way model; `raters` equals it in models 1 and 3.
    subjects: float
    raters: float
    error: float
    #: Their degrees of freedom.
    df_subjects: int
    df_raters: int
    df_error: int
    #: Subjects per rater, ratings per subject: harmonic means where ratings are missing.
    n: float
    k: float


def mean_squares(ratings: np.ndarray, model: int) -> MeanSquares:
    """Mean squares of (n, k) ratings under Shrout & Fleiss' model 1, 2 or 3 (raters: none, random, fixed).

    Complete tables by the analysis of variance. With NaN the components are those of restricted maximum likelihood
    (REML; no component below zero), and the mean squares what these are expected to be in a table with the harmonic
    mean number of ratings (Thomas & Hultquist 1978, Ann. Stat. 6:582-587, for one factor).

    Raises `PblError` STATS_INPUT.
    """
    seen = np.isfinite(ratings)
    if model == 1 and len(ratings) > 1:  # a column is no rater: it may be empty where cycles are few
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

    y = mean + subject + rater + error; raters are random (model 2), fixed (3) or none (1). Searched are the standard
    deviations of subjects and raters relative to that of the error, which follows in closed form. With
    D = I + a S S' (S: subjects) and Z the raters' columns, the likelihood needs no more than the (k, k) matrix
    Z' D^-1 Z and the (k,) vector Z' D^-1 y (Woodbury's identity): its cost grows with n k^2, not with (n k)^3.
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
