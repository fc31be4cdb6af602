"""Feet on the floor: a sole that stands is at the floor's height, and where it was in the frame before."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from .problem import Problem
from .term import At, Term, Unknowns


def residual_floor_cm(x: Float[Array, "*n 3"], floor: Float[Array, "*n 3"]) -> Float[Array, "*n 1"]:
    """Height over a floor of some height (m) and slopes."""
    height, slope_x, slope_y = (floor[..., i] for i in range(3))
    return 100.0 * (x[..., 2] - height - slope_x * x[..., 0] - slope_y * x[..., 1])[..., None]


def residual_slide_cm(
    x: Float[Array, "*n 3"], following: Float[Array, "*n 3"], rate: Float[Array, "*n"]
) -> Float[Array, "*n 3"]:
    """Displacement of a point until the next frame, as if that came after 1/30 s (`rate`: 1/30 s over the time)."""
    return 100.0 * rate[..., None] * (following - x)


def later(a: Array) -> Array:
    """Each frame's successor; the last one is its own."""
    return jnp.concatenate([a[1:], a[-1:]])


def slide_contact(p: Problem) -> Float[Array, "F P"]:
    """Certainty that a point of the soles stands in a frame and the next one of its trial."""
    return p.contact * later(p.contact) * ((p.rate > 0) * later(p.weight))[:, None]


def _sole_and_floor(at: At) -> Float[Array, "F P 6"]:
    floor = at.state.floor[at.problem.trial][:, None]
    return jnp.concatenate([at.soles, jnp.broadcast_to(floor, at.soles.shape)], axis=-1)


LFLOOR = Term(
    name="Lfloor",
    weight="weight_floor",
    width="huber_floor_cm",
    unknowns=Unknowns.SOLE_AND_FLOOR,
    variables=_sole_and_floor,
    residual=lambda at, z: residual_floor_cm(z[..., :3], z[..., 3:]),
    count=lambda at: at.problem.contact,
)
LSLIDE = Term(
    name="Lslide",
    weight="weight_slide",
    width="huber_slide_cm",
    unknowns=Unknowns.SOLE_IN_TWO_FRAMES,
    variables=lambda at: jnp.concatenate([at.soles, later(at.soles)], axis=-1),
    residual=lambda at, z: residual_slide_cm(z[..., :3], z[..., 3:], at.problem.rate[:, None]),
    count=lambda at: slide_contact(at.problem),
)
