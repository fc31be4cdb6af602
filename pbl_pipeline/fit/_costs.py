"""The cost terms, one function each, unweighted. Every solver uses these.

Equations: the paper, section Model Fitting. `c` is the keypoint confidence, 0 where nothing was seen; values at such
places must be finite but do not count. Costs are means over frames and markers, so padding frames are given a weight
of zero in `frame_weight` and do not count either.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from pbl_pipeline.body import SCALE_NAMES

#: Depth below which a point is treated as if it were this far away: keeps projections and gradients finite.
NEAR_M = 0.1
#: How gradually depth is bent there (m).
SOFT_M = 0.5 * NEAR_M

#: Places in `SCALE_NAMES` of the segments that the body has on both sides, in the same order.
LEFT_SCALES = np.array([i for i, n in enumerate(SCALE_NAMES) if n.startswith("left_")])
RIGHT_SCALES = np.array([SCALE_NAMES.index(SCALE_NAMES[i].replace("left_", "right_")) for i in LEFT_SCALES])


def huber_of_square(e2: Float[Array, ...], width: ArrayLike) -> Float[Array, ...]:
    """Huber cost of a distance given its square: `e2 / 2` up to `width`, then linear.

    Takes the square so that the gradient at distance zero is zero and not 0/0: the root is only taken of values that
    are at least `width` squared.
    """
    far = e2 > width**2
    distance = jnp.sqrt(jnp.where(far, e2, width**2))
    return jnp.where(far, width * (distance - 0.5 * width), 0.5 * e2)


def huber_weight(e2: Float[Array, ...], width: ArrayLike) -> Float[Array, ...]:
    """Weight w of the gradient `w e` of the Huber cost of a distance given its square."""
    far = e2 > width**2
    return jnp.where(far, width / jnp.sqrt(jnp.where(far, e2, 1.0)), 1.0)


def center(x: Float[Array, "*n J 3"], weight: Float[Array, "*n J"]) -> Float[Array, "*n J 3"]:
    """Subtract the weighted mean over the markers in each frame; nothing where all weights are 0."""
    n = jnp.sum(weight, axis=-1)[..., None, None]
    return x - jnp.sum(x * weight[..., None], axis=-2, keepdims=True) / jnp.where(n > 0, n, 1.0)


def distance_3d_cm2(
    x_world: Float[Array, "*n J 3"],
    x_cam: Float[Array, "*n J 3"],
    R_nc: Float[Array, "*#n 3 3"],
    c: Float[Array, "*n J"],
    marker_weight: ArrayLike = 1.0,
    depth_ratio: ArrayLike = 1.0,
) -> Float[Array, "*n J"]:
    """Squared distance (cm^2) of model and detected 3D points, both with their mean over the seen markers removed.

    `marker_weight` says how much each marker counts in that mean; the distances themselves are not weighted.
    `depth_ratio`: what a distance along the camera's axis counts against one across it (1: the paper's).
    """
    weight = jnp.where(c > 0, marker_weight, 0.0).astype(x_world.dtype)
    delta = jnp.einsum("...ji,...kj->...ki", R_nc, center(x_world, weight)) - center(x_cam, weight)
    across, along = jnp.sum(delta[..., :2] ** 2, axis=-1), delta[..., 2] * depth_ratio
    return 1e4 * (across + along**2)


def soft_depth_m(z: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Depth bent smoothly to stay above `NEAR_M`."""
    return NEAR_M + SOFT_M * jax.nn.softplus((z - NEAR_M) / SOFT_M)


def project_px(x_cam: Float[Array, "*n J 3"], matrix: Float[Array, "*#n 3 3"]) -> Float[Array, "*n J 2"]:
    """Pinhole projection. Depth is bent smoothly to stay above `NEAR_M`, so nothing is huge behind the camera."""
    z = soft_depth_m(x_cam[..., 2:])
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


def project_jacobian(x_cam: Float[Array, "*n J 3"], matrix: Float[Array, "*#n 3 3"]) -> Float[Array, "*n J 2 3"]:
    """Derivative of `project_px` (px per m)."""
    z = soft_depth_m(x_cam[..., 2])
    focal = jnp.stack([matrix[..., 0, 0], matrix[..., 1, 1]], axis=-1)[..., None, :]
    across = (focal / z[..., None])[..., None] * jnp.eye(2, dtype=x_cam.dtype)
    along = -focal * x_cam[..., :2] * (jax.nn.sigmoid((x_cam[..., 2] - NEAR_M) / SOFT_M) / z**2)[..., None]
    return jnp.concatenate([across, along[..., None]], axis=-1)


def beyond_limit_deg(
    qpos: Float[Array, "*n Q"], low: Float[Array, " Q"], high: Float[Array, " Q"]
) -> Float[Array, "*n Q"]:
    """How far a joint is beyond its limit (deg, negative below the lower one), 0 inside."""
    return jnp.rad2deg(jnp.maximum(qpos - high, 0.0) + jnp.minimum(qpos - low, 0.0))


def second_difference(qpos: Float[Array, "F Q"], bend: Float[Array, "F 3"]) -> Float[Array, "F Q"]:
    """Second difference of each joint over frames, with the weights `bend` of the frames before, at and after."""
    none = jnp.zeros_like(qpos[:1])
    before, after = jnp.concatenate([none, qpos[:-1]]), jnp.concatenate([qpos[1:], none])
    return bend[:, :1] * before + bend[:, 1:2] * qpos + bend[:, 2:] * after


def offset_m2(site_offset_m: Float[Array, "J 3"]) -> Array:
    """Sum of squared marker offsets (m^2)."""
    return jnp.sum(site_offset_m**2)


def pose_prior(
    qpos: Float[Array, "*n Q"],
    neutral: Float[Array, " Q"],
    inverse_sd: Float[Array, " Q"],
    frame_weight: Float[Array, "*n"],
) -> Array:
    """Half the squared distance from the neutral pose in standard deviations, summed over joints, mean over frames.

    The negative logarithm of independent normal distributions. `inverse_sd` is 0 where a joint has no prior.
    """
    z2 = jnp.sum(((qpos - neutral) * inverse_sd) ** 2, axis=-1)
    return 0.5 * jnp.sum(z2 * frame_weight) / jnp.maximum(jnp.sum(frame_weight), 1.0)


def scale_prior(s: Float[Array, " 8"], sd: ArrayLike, sd_sides: ArrayLike) -> Array:
    """Half the squared segment scales relative to the whole body's, and of left against right, in standard deviations.

    `s[0]`, the size of the whole body, is free.
    """
    sides = s[LEFT_SCALES] - s[RIGHT_SCALES]
    return 0.5 * (jnp.sum((s[1:] / sd) ** 2) + jnp.sum((sides / sd_sides) ** 2))
