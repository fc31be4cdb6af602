"""Normative gait, with which cycles are compared."""

from pbl_pipeline.results.cycles import BODY_ANGLES

from ._schwartz import GRAVITY, gait_norm, harmonic_sum
from .norm import (
    ANGLE_MODELS,
    DEFAULT_NORM,
    MIN_VECTORS,
    NINE_ANGLES,
    PLUG_IN_GAIT,
    THREE_ANGLES,
    NormativeSet,
    check_degrees,
    fit_norm,
    load_norm,
    norm_names,
    offset_deg,
)
