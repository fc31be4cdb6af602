"""Stretches of an array with one value."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike


def runs(values: ArrayLike) -> list[slice]:
    """The stretches of (N,) flags that are True, in order; of numbers, those of one value other than 0."""
    numbers = np.asarray(values, float)
    edges = np.flatnonzero(np.diff(numbers, prepend=0.0, append=0.0))
    return [slice(int(a), int(b)) for a, b in pairwise(edges) if numbers[a]]
