"""Normative gait: what a cycle is compared with."""

from ._norm import DEFAULT_NORM, MIN_VECTORS, NormativeSet, fit_norm, load_norm, norm_names
from ._schwartz import GRAVITY, GaitNorm, gait_norm, harmonic_sum

__all__ = [
    "DEFAULT_NORM",
    "GRAVITY",
    "MIN_VECTORS",
    "GaitNorm",
    "NormativeSet",
    "fit_norm",
    "gait_norm",
    "harmonic_sum",
    "load_norm",
    "norm_names",
]
