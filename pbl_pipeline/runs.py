"""Runs of equal values in an array."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike


def runs(values: ArrayLike) -> list[slice]:
    """The runs of True in (N,) flags, in order; of numbers, the runs of one value other than 0."""
    numbers = np.asarray(values, float)
    edges = np.flatnonzero(np.diff(numbers, prepend=0.0, append=0.0))
    return [slice(int(a), int(b)) for a, b in pairwise(edges) if numbers[a]]


def ranges(flags: ArrayLike) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    return [(run.start, run.stop - 1) for run in runs(flags)]
