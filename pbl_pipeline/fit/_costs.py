"""The cost terms, one function each, unweighted. Every solver uses these.

Equations: the paper, section Model Fitting. `c` is the keypoint confidence, 0 where nothing was seen; values at such
places must be finite but do not count. Costs are means over frames and markers, so padding frames are given a weight
of zero in `frame_weight` and do not count either.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

#: Depth below which a point is treated as if it were this far away: keeps projections and gradients finite.
NEAR_M = 0.1


def huber_of_square(e2: Float[Array, ...], width: float) -> Float[Array, ...]:
    """Huber cost of a distance given its square: `e2 / 2` up to `width`, then linear.

    Takes the square so that the gradient at distance zero is zero and not 0/0: the root is only taken of values that
    are at least `width` squared.
    """
    far = e2 > width**2
    distance = jnp.sqrt(jnp.where(far, e2, width**2))
    return jnp.where(far, width * (distance - 0.5 * width), 0.5 * e2)


def weighted_mean(cost: Float[Array, "*n J"], c: Float[Array, "*n J"], frame_weight: Float[Array, "*n"]) -> Array:
    """Mean of `c * cost` over the frames that count and all markers."""
    total = jnp.sum(cost * c * frame_weight[..., None])
    return total / (jnp.maximum(jnp.sum(frame_weight), 1.0) * cost.shape[-1])


def center(x: Float[Array, "*n J 3"], seen: Float[Array, "*n J"]) -> Float[Array, "*n J 3"]:
    """Subtract the mean over the markers that are seen (0 or 1) in each frame."""
    n = jnp.maximum(jnp.sum(seen, axis=-1), 1.0)[..., None, None]
    return x - jnp.sum(x * seen[..., None], axis=-2, keepdims=True) / n


def distance_3d_cm2(
    x_world: Float[Array, "*n J 3"],
    x_cam: Float[Array, "*n J 3"],
    R_nc: Float[Array, "*#n 3 3"],
    c: Float[Array, "*n J"],
) -> Float[Array, "*n J"]:
    """Squared distance (cm^2) of model and detected 3D points, both with their mean over the seen markers removed."""
    seen = (c > 0).astype(x_world.dtype)
    detected = jnp.einsum("...ij,...kj->...ki", R_nc, x_cam)
    delta = center(x_world, seen) - center(detected, seen)
    return 1e4 * jnp.sum(delta**2, axis=-1)


def project_px(x_cam: Float[Array, "*n J 3"], matrix: Float[Array, "*#n 3 3"]) -> Float[Array, "*n J 2"]:
    """Pinhole projection. Depth is bent smoothly to stay above `NEAR_M`, so nothing is huge behind the camera."""
    soft = 0.5 * NEAR_M
    z = NEAR_M + soft * jax.nn.softplus((x_cam[..., 2:] - NEAR_M) / soft)
    focal = jnp.stack([matrix[..., 0, 0], matrix[..., 1, 1]], axis=-1)[..., None, :]
    principal = matrix[..., :2, 2][..., None, :]
    return focal * x_cam[..., :2] / z + principal


def distance_2d_px2(
    x_world: Float[Array, "*n J 3"],
    xy_px: Float[Array, "*n J 2"],
    R_nc: Float[Array, "*#n 3 3"],
    matrix: Float[Array, "*#n 3 3"],
) -> Float[Array, "*n J"]:
    """Squared distance (px^2) of projected model points and detected, undistorted 2D points."""
    x_cam = jnp.einsum("...ji,...kj->...ki", R_nc, x_world)
    return jnp.sum((project_px(x_cam, matrix) - xy_px) ** 2, axis=-1)


def offset_m2(site_offset_m: Float[Array, "J 3"]) -> Array:
    """Sum of squared marker offsets (m^2)."""
    return jnp.sum(site_offset_m**2)
