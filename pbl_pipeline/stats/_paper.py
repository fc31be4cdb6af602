"""How the paper summarises errors over trials (Validation Metrics; Accuracy Evaluation)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._input import numbers, refuse

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


def median_of_medians(errors: Sequence[Any]) -> tuple[float, float]:
    """Median absolute error: the median within each trial, then over the trials; and the nIQR over the trials.

    Raises `PblError` STATS_INPUT: a trial without errors, NaN, fewer than two trials.

    Parameters
    ----------
    errors
        Of each trial its errors, signed or not, (N_i,) in any unit. Two trials at least.
    """
    medians = []
    for i, trial in enumerate(errors):
        absolute = np.abs(numbers(trial, f"trial {i}"))
        if not len(absolute):
            raise refuse(f"trial {i} without errors", "one at least", "leave that trial out and report it")
        medians.append(np.median(absolute))
    return float(np.median(medians)) if medians else np.nan, niqr(medians)
