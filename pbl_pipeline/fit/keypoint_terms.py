"""Keypoints: the paper's L3D and L2D, and markers of a laboratory.

Residuals are functions of a marker's position (m, world axes). Confidences `c` are 0 where nothing was seen; values
there are finite and do not count.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, ArrayLike, Float

from .problem import Problem, State
from .term import At, Term, Unknowns

#: Depth below which a point is treated as if it were this far away: keeps projections and gradients finite.
NEAR_M = 0.1
#: How gradually depth is bent there (m).
SOFT_M = 0.5 * NEAR_M


def in_camera(
    x_world: Float[Array, "F J 3"], R_nc: Float[Array, "F V 3 3"], p_nc: Float[Array, "F V 3"]
) -> Float[Array, "F V J 3"]:
    """Points in the axes of each camera: x right, y down, z forward (m)."""
    away = x_world[:, None] - p_nc[:, :, None]
    return sum(away[..., k, None] * R_nc[:, :, None, k] for k in range(3))  # type: ignore[return-value]


def project_px(x_cam: Float[Array, "*n J 3"], camera_matrix: Float[Array, "*#n 3 3"]) -> Float[Array, "*n J 2"]:
    """Pinhole projection. Depth is bent smoothly to stay above `NEAR_M`, so nothing is huge behind the camera."""
    z = NEAR_M + SOFT_M * jax.nn.softplus((x_cam[..., 2:] - NEAR_M) / SOFT_M)
    focal = jnp.stack([camera_matrix[..., 0, 0], camera_matrix[..., 1, 1]], axis=-1)[..., None, :]
    return focal * x_cam[..., :2] / z + camera_matrix[..., None, :2, 2]


def residual_2d_px(
    x_cam: Float[Array, "*n J 3"], xy_px: Float[Array, "*n J 2"], camera_matrix: Float[Array, "*#n 3 3"]
) -> Float[Array, "*n J 2"]:
    """Projected model points minus detected, undistorted ones."""
    return project_px(x_cam, camera_matrix) - xy_px


def residual_3d_cm(
    x: Float[Array, "*n J 3"], detected: Float[Array, "*n J 3"], depth_ratio: ArrayLike = 1.0
) -> Float[Array, "*n J 3"]:
    """Model points minus detected ones. `depth_ratio` (1 or *n J 1): weight of a distance along the last axis, a
    camera's, relative to one across it (1: the paper's)."""
    ratio = jnp.atleast_1d(jnp.asarray(depth_ratio, x.dtype))
    per_m = 100.0 * jnp.concatenate([jnp.ones((*ratio.shape[:-1], 2)), ratio], axis=-1)
    return (x - detected) * per_m


def corrected(
    x_cam: Float[Array, "*n J 3"], lean: Float[Array, "*n 3"], depth_m: Float[Array, "*n J"]
) -> Float[Array, "*n J 3"]:
    """A detector's points without its errors common to all frames: turned by `lean` about their origin, each moved by
    its `depth_m`."""
    turned = jaxlie.SO3.exp(lean[..., None, :]) @ x_cam
    return turned + depth_m[..., None] * jnp.array([0.0, 0.0, 1.0], x_cam.dtype)


def corrected_points(p: Problem, state: State) -> Float[Array, "F V J 3"]:
    """The detector's points of all views without its errors common to all frames of a trial."""
    if not state.lean.shape[0]:
        return p.x_cam
    return corrected(p.x_cam, state.lean[p.trial][:, None], state.depth_m[p.trial][:, None])


def mean_weights(c: Float[Array, "*n J"], marker_weight: Float[Array, " J"]) -> Float[Array, "*n J"]:
    """Weights, of sum 1, of the markers in the mean that L3D removes: those that were seen."""
    seen = jnp.where(c > 0, marker_weight, 0.0)
    return seen / jnp.maximum(jnp.sum(seen, axis=-1, keepdims=True), 1e-6)


def offset_m(
    x: Float[Array, "*n J 3"], detected: Float[Array, "*n J 3"], weights: Float[Array, "*n J"]
) -> Float[Array, "*n 1 3"]:
    """Weighted mean over the markers of model minus detected points: what centring both removes from each difference.

    As one mean of differences: XLA 0.10.2 for CPUs computes the difference of two means wrongly in some programs.
    """
    return jnp.sum((x - detected) * weights[..., None], axis=-2, keepdims=True)


def _residual_3d(at: At, x: Float[Array, "F J 3"]) -> Float[Array, "F V J 3"]:
    """Each side with its own mean over the markers removed. As a function of one marker's position the mean is
    constant; the normal equations add what its movement contributes."""
    p = at.problem
    detected = corrected_points(p, at.state)
    centre = mean_weights(p.c_3d, p.weight_3d)
    away = offset_m(in_camera(at.x, at.state.R_nc, p.p_nc), detected, centre)
    ratio = at.weights["depth_ratio"]
    if p.depths is not None:  # a measured depth errs less, and not for long
        measured = at.weights["depth_ratio_measured"]
        ratio = ratio * jnp.where(p.depths.count > 0, measured, 1.0)[:, None, :, None]
    return residual_3d_cm(in_camera(x, at.state.R_nc, p.p_nc) - away, detected, ratio)


def _residual_2d(at: At, x: Float[Array, "F J 3"]) -> Float[Array, "F V J 2"]:
    p = at.problem
    return residual_2d_px(in_camera(x, at.state.R_nc, p.p_nc), p.xy_px, p.camera_matrix)


L3D = Term(
    name="L3D",
    weight="weight_3d",
    width="huber_3d_cm",
    unknowns=Unknowns.CENTRED_MARKER,
    variables=lambda at: at.x,
    residual=_residual_3d,
    count=lambda at: at.problem.c_3d * at.problem.weight_3d,
)
L2D = Term(
    name="L2D",
    weight="weight_2d",
    width="huber_2d_px",
    unknowns=Unknowns.MARKER,
    variables=lambda at: at.x,
    residual=_residual_2d,
    count=lambda at: at.problem.c_2d,
)
#: Of markers measured in the world: L3D without a camera and without centring.
L_MARKERS = Term(
    name="Lmarkers",
    weight="weight_3d",
    width="huber_3d_cm",
    unknowns=Unknowns.MARKER,
    variables=lambda at: at.x,
    residual=lambda at, x: residual_3d_cm(x, at.problem.x_world)[:, None],
    count=lambda at: (at.problem.c_world * at.problem.weight_3d[: at.problem.c_world.shape[1]])[:, None],
)
