"""Depths: how far away a depth camera measured the surface of the body at a marker, and where the body has it.

The body's shapes tell how far the surface lies before a marker; how much further away it truly is, is constant on each
marker. One metre of the depths is `metre` metres of the fit, whose own metre is the detector's or the unscaled body's.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from .keypoint_terms import in_camera
from .term import At, SharedTerm, Term, Unknowns, frame_count


def _residual(at: At, x: Float[Array, "F J 3"]) -> Float[Array, "F 1 J 1"]:
    p, seen, surface = at.problem, at.problem.depths, at.state.surface
    assert seen is not None
    assert surface is not None
    z = in_camera(x, at.state.R_nc, p.p_nc)[:, :1, :, 2:]
    away = seen.skin_m + surface.offset_m - surface.metre * seen.depth_m
    return (z + away[:, None, :, None]) / at.weights["depth_point_sd_m"]


def by_surface(at: At) -> Float[Array, "F J K"]:
    """Derivatives of the residuals by the fields of `Surface`."""
    seen = at.problem.depths
    assert seen is not None
    frames, markers = seen.depth_m.shape
    own = jnp.broadcast_to(jnp.eye(markers), (frames, markers, markers))
    return jnp.concatenate([own, -seen.depth_m[..., None]], axis=-1) / at.weights["depth_point_sd_m"]


def _prior(at: At) -> Array:
    seen, surface = at.problem.depths, at.state.surface
    assert seen is not None
    assert surface is not None
    return 0.5 * seen.dispersion * jnp.sum((surface.offset_m / seen.offset_sd_m) ** 2) / frame_count(at.problem)


#: Its weight against the keypoints is that of a number whose standard deviation is known.
LDEPTH = Term(
    name="Ldepth",
    weight="weight_depth",
    width="huber_depth",
    unknowns=Unknowns.MARKER_AND_SURFACE,
    variables=lambda at: at.x,
    residual=_residual,
    count=lambda at: jnp.zeros(0) if at.problem.depths is None else at.problem.depths.count[:, None],
    frames=lambda at: at.problem.weight * at.problem.depths.dispersion,
)
SURFACE = SharedTerm("surface prior", "weight_depth", _prior, empty=lambda at: at.state.surface is None)
