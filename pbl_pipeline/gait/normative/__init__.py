"""Normative gait: what a cycle is compared with."""

from ._angles import NINE_ANGLES, THREE_ANGLES
from ._conventions import ANGLE_MODELS, BODY_ANGLES, OFFSET_DEG, PLUG_IN_GAIT, check_degrees, offset_deg
from ._schwartz import GRAVITY, GaitNorm, gait_norm, harmonic_sum
from .norm import DEFAULT_NORM, MIN_VECTORS, NormativeSet, fit_norm, load_norm, norm_names
