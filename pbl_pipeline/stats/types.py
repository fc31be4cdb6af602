"""Estimates with their intervals, and checks of the values of statistics."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pandas as pd
from scipy import optimize, stats

from pbl_pipeline.errors import PblError

#: Largest value, and inverse of the least spread: squares beyond overflow.
_LARGEST = 1e100
refuse = functools.partial(PblError, "STATS_INPUT")


def numbers(values: Any, name: str, ndim: int = 1, missing: bool = False) -> np.ndarray:
    """Return `values` as a float array of `ndim` dimensions without infinite values and, unless `missing`, without NaN.

    Raises `PblError` STATS_INPUT.
    """
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise refuse(f"{name}: {error}", "numbers", "convert the column to numbers") from None
    if array.ndim != ndim:
        raise refuse(f"{name} of shape {array.shape}", f"{ndim} dimension(s)", "pass an array of that shape")
    if np.nanmax(np.abs(array), initial=0.0) > _LARGEST:
        raise refuse(f"{name}: infinite values, or beyond {_LARGEST:g}", "measured numbers", "see where they are from")
    if not missing and np.isnan(array).any():
        raise refuse(
            f"{name}: {np.isnan(array).sum()} of {array.size} values missing (NaN)",
            "a number everywhere",
            "leave out the persons, visits or cycles concerned and report how many",
        )
    return array


def sample(values: Any, name: str, at_least: int) -> np.ndarray:
    """Return (N,) finite values, `at_least` so many and not all the same. Raises `PblError` STATS_INPUT."""
    array = numbers(values, name)
    if len(array) < at_least:
        raise refuse(f"{name}: {len(array)} values", f"at least {at_least}", "record more persons")
    if not differ(array):
        raise refuse(f"{name}: all {len(array)} values are {array[0]:g}", "values that differ", "check the column")
    return array


def differ(values: np.ndarray) -> bool:
    """True if values differ by more than their last digits."""
    return bool(np.ptp(values) > 1e-12 * np.abs(values).max() + 1 / _LARGEST)


def same_length(a: np.ndarray, b: np.ndarray) -> None:
    """Raise `PblError` STATS_INPUT if `a` and `b` cannot be pairs."""
    if len(a) != len(b):
        raise refuse(f"{len(a)} and {len(b)} values", "pairs", "pass both values of each person, in the same order")


def changes(pre: Any, post: Any, at_least: int) -> np.ndarray:
    """(N,) differences post - pre, or `pre` itself as the differences if `post` is None.

    Raises `PblError` STATS_INPUT, also if all changes are the same.
    """
    if post is None:
        return sample(pre, "changes", at_least)
    before, after = numbers(pre, "pre"), numbers(post, "post")
    same_length(before, after)
    return sample(after - before, "changes (post - pre)", at_least)


def labels(values: Any, name: str, length: int) -> tuple[np.ndarray, list[Any]]:
    """(length,) number of each label, and the labels in the order in which they first appear.

    Raises `PblError` STATS_INPUT for another length and missing labels.
    """
    given = pd.Series(list(values), dtype=object)
    if len(given) != length:
        raise refuse(f"{len(given)} {name} of {length} values", "one of each value", f"pass {name} in the same order")
    index, found = pd.factorize(given)
    if (index < 0).any():
        raise refuse(f"{name}: {(index < 0).sum()} missing", "one of each value", "say whose the values are")
    return index, list(found)


def count(value: int, name: str) -> int:
    """Return a number of at least 1. Raises `PblError` STATS_INPUT."""
    if value < 1:
        raise refuse(f"{name} {value}", "a whole number of at least 1", f"correct {name}")
    return int(value)


def fraction(value: float, name: str) -> float:
    """Return a number between 0 and 1, both excluded. Raises `PblError` STATS_INPUT."""
    if not 0 < value < 1:
        raise refuse(f"{name} {value}", "a number between 0 and 1", f"correct {name}")
    return float(value)


def one_of(value: str, names: tuple[str, ...], what: str) -> str:
    """Return one of `names`. Raises `PblError` STATS_INPUT."""
    if value not in names:
        raise refuse(f"{what} {value!r}", f"one of {', '.join(names)}", "choose one of these")
    return value


#: Largest t at which scipy's noncentral t has six correct digits.
_LARGEST_T = 1e4


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic with its confidence interval."""

    value: float
    low: float  # limits of the interval, in the unit of the statistic
    high: float
    confidence: float  # of the interval, 0.95 by default


def fisher_z(r: float, standard_error: float, confidence: float) -> Estimate:
    """Interval of a correlation `r` from the standard error of its Fisher transform artanh(r)."""
    if abs(r) >= 1:
        return Estimate(float(np.sign(r)), float(np.sign(r)), float(np.sign(r)), confidence)
    half = stats.norm.isf((1 - confidence) / 2) * standard_error
    return Estimate(r, float(np.tanh(np.arctanh(r) - half)), float(np.tanh(np.arctanh(r) + half)), confidence)


def noncentrality(t: float, df: float, confidence: float) -> tuple[float, float]:
    """Interval of the noncentrality of which `t` is one draw (exact; Steiger & Fouladi 1997).

    Raises `PblError` STATS_INPUT for |t| above `_LARGEST_T`.
    """
    if abs(t) > _LARGEST_T:
        raise refuse(f"a mean of {abs(t):.0f} standard errors", "values that differ among persons", "check the column")
    tail = (1 - confidence) / 2
    width = 10 * np.sqrt(1 + t**2 / (2 * df))

    def excess(nc: float, probability: float) -> float:
        # Far from t scipy returns NaN for the distribution function, which is 1 below and 0 above.
        return float(np.nan_to_num(stats.nct.cdf(t, df, nc), nan=float(nc < t))) - probability

    low, high = (optimize.brentq(excess, t - width, t + width, (p,), xtol=1e-10) for p in (1 - tail, tail))
    return float(low), float(high)  # pyright: ignore[reportArgumentType]
