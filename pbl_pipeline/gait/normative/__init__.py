"""Normative gait: what a cycle is compared with."""

from ._norm import DEFAULT_NORM, MIN_VECTORS, NormativeSet, fit_norm, load_norm, norm_names

__all__ = ["DEFAULT_NORM", "MIN_VECTORS", "NormativeSet", "fit_norm", "load_norm", "norm_names"]
