"""What a solution looks like beside the keypoints: markers in the world, residuals, and where the body points."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, body_poses
from pbl_pipeline.body._jacobian import MarkerTable, table_positions

from . import _costs as costs
from ._observations import Observations


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """On the F packed frames and J padded markers; residuals are NaN where nothing was seen.

    x_world_m; residual_2d_px and residual_3d_m: means over the views that saw the marker (3D of a camera: with the mean
    over the markers removed; in the world: as it is); body_axis_m: from between the heels to the head.
    """

    x_world_m: Float[Array, "F J 3"]
    residual_2d_px: Float[Array, "F J"]
    residual_3d_m: Float[Array, "F J"]
    body_axis_m: Float[Array, "F 3"]


def outcome(
    body: Body,
    table: MarkerTable,
    obs: Observations,
    qpos: Float[Array, "F 40"],
    R_nc: Float[Array, "F V 3 3"],
    scale: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> Outcome:
    """The outcome of poses, camera orientations and a body."""
    # GPUs round the factors of float32 products to ten bits unless told otherwise: pixels at the edge.
    with jax.default_matmul_precision("highest"):
        return _outcome(body, table, obs, qpos, R_nc, scale, site_offset_m)


def _outcome(body, table, obs, qpos, R_nc, scale, site_offset_m) -> Outcome:
    x = table_positions(body, table, qpos, scale, site_offset_m)
    xpos, _ = body_poses(body, qpos, scale)
    head, right, left = (xpos[:, body.body_names.index(n)] for n in ("head", "calcn_r", "calcn_l"))
    unknown = jnp.full(x.shape[:2], jnp.nan)
    px = m = unknown
    if obs.c_2d.shape[1] > 0:
        from_camera = x[:, None] - obs.p_nc[:, :, None]
        px = _mean_seen(costs.distance_2d_px2(from_camera, obs.xy_px, R_nc, obs.camera_matrix), obs.c_2d)
        m = 0.01 * _mean_seen(costs.distance_3d_cm2(x[:, None], obs.x_cam, R_nc, obs.c_3d, table.weight_3d), obs.c_3d)
    world = jnp.linalg.norm(x - obs.x_world, axis=-1)
    m = jnp.where(obs.c_world > 0, world, m)
    return Outcome(x, px, m, head - 0.5 * (right + left))


outcome_one = functools.partial(jax.jit, static_argnames="body")(outcome)


def _mean_seen(e2: Float[Array, "F V J"], c: Float[Array, "F V J"]) -> Float[Array, "F J"]:
    """Mean root over the views that saw a marker, NaN where none did."""
    seen = c > 0
    count = jnp.sum(seen, axis=1)
    total = jnp.sum(jnp.where(seen, jnp.sqrt(e2), 0.0), axis=1)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)
