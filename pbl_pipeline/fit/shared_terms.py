"""Quadratic terms of the unknowns that all frames share: marker offsets, body size, clocks, floors, detector errors."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from .term import At, SharedTerm, frame_count

#: Cost of a floor's slope one standard deviation from level: that of a marker 3 px off in one frame.
SLOPE_COST = 0.03
#: A floor's height is free, and held near 0 without standing feet (per m^2).
FLOOR_HEIGHT_PRECISION = 1e-6


def _detector(at: At) -> Array:
    """Each trial counts as much as its frames do."""
    p, lean = at.problem, at.state.lean
    if not lean.shape[0]:
        return jnp.zeros(())
    z2 = jnp.sum((lean / jnp.deg2rad(at.weights["lean_sd_deg"])) ** 2, axis=-1)
    z2 += jnp.sum((at.state.depth_m / at.weights["depth_sd_m"]) ** 2, axis=-1)
    return 0.5 * jnp.sum(p.weight * z2[p.trial]) / frame_count(p)


def _clock(at: At) -> Array:
    stated = at.problem.clock_sd_s
    sd_s = jnp.where(stated > 0, stated, at.weights["clock_sd_s"])
    return 0.5 * jnp.sum((at.state.clock_s / sd_s) ** 2) / frame_count(at.problem)


def _floor(at: At) -> Array:
    slope = SLOPE_COST / jnp.deg2rad(at.weights["slope_sd_deg"]) ** 2
    precision = jnp.stack([jnp.asarray(FLOOR_HEIGHT_PRECISION), slope, slope])
    return 0.5 * jnp.sum(precision * at.state.floor**2) / frame_count(at.problem)


#: A sum of squares (m^2) without a half, as in the published code.
LOFFSET = SharedTerm("Loffset", "weight_offset_per_m2", lambda at: jnp.sum(at.state.site_offset_m**2))
SCALE = SharedTerm("scale prior", "weight_scale", lambda at: 0.5 * at.state.s @ at.weights.scale_precision @ at.state.s)
#: Of one camera without 3D points, which cannot tell a small person from a far one.
SIZE = SharedTerm("size prior", "", lambda at: 0.5 * at.weights.size_precision * at.state.s[0] ** 2)
CLOCK = SharedTerm("clock prior", "", _clock)
FLOOR = SharedTerm("floor prior", "", _floor)
DETECTOR = SharedTerm("detector prior", "weight_detector", _detector)
