"""Forward kinematics `M(theta, beta) -> x`: joint angles, scales and marker offsets to points in the world.

Positions only: `mjx.kinematics`, never `mjx.forward`, which would also compute the dynamics.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from pbl_pipeline.body._markers import MarkerSet
from pbl_pipeline.body._model import Body
from pbl_pipeline.body._poses import poses


def body_poses(
    body: Body, qpos: Float[ArrayLike, "*batch 40"], scale: Float[ArrayLike, " 8"]
) -> tuple[Float[Array, "*batch 21 3"], Float[Array, "*batch 21 3 3"]]:
    """Where the bodies are.

    Parameters
    ----------
    body
        From `load_body`.
    qpos : (..., 40)
        Joint values in the order of `body.joint_names`, radians and metres.
    scale : (8,)
        Multipliers in the order of `SCALE_NAMES` (1 = unscaled). A body's scale multiplies the positions of its child
        bodies; the pelvis hangs on the world and moves with qpos alone.

    Returns
    -------
    xpos : (..., 21, 3)
        Origins in the world (z up), metres.
    xmat : (..., 21, 3, 3)
        Rotations, body frame to world.
    """
    qpos = jnp.asarray(qpos, jnp.result_type(float))
    scale = jnp.asarray(scale, jnp.result_type(float))
    batch = qpos.shape[:-1]
    xpos, xmat, _ = poses(body)(qpos.reshape(-1, qpos.shape[-1]), scaled_body_pos(body, scale))
    return xpos.reshape(*batch, *xpos.shape[1:]), xmat.reshape(*batch, *xmat.shape[1:])


def scaled_body_pos(body: Body, scale: Float[Array, " 8"]) -> Float[Array, "21 3"]:
    """Where each body hangs on its parent (m, parent's frame) when the parent is scaled."""
    parent_scale = jnp.where(body.parent_index >= 0, scale[body.scale_index[body.parent_index]], 1.0)
    return jnp.asarray(body.mj_model.body_pos[1:], scale.dtype) * parent_scale[:, None]


def marker_positions(
    body: Body,
    markers: MarkerSet,
    qpos: Float[ArrayLike, "*batch 40"],
    scale: Float[ArrayLike, " 8"],
    site_offset_m: Float[ArrayLike, "J 3"],
) -> Float[Array, "*batch J 3"]:
    """Where the markers are in the world: `x = xpos + xmat @ (scale * (position + offset))` of each marker's body.

    Differentiable in `qpos`, `scale` and `site_offset_m`; works under `jit`, `vmap` and `grad`.

    Parameters
    ----------
    body, qpos, scale
        As in `body_poses`.
    markers
        J points on the body.
    site_offset_m : (J, 3)
        Added to each marker's position in its body's frame before scaling, metres.

    Returns
    -------
    (..., J, 3) in the world (z up), metres.
    """
    xpos, xmat = body_poses(body, qpos, scale)
    dtype = xpos.dtype
    own = jnp.asarray(scale, dtype)[body.scale_index[markers.body_index]]
    local = own[:, None] * (jnp.asarray(markers.position_m, dtype) + jnp.asarray(site_offset_m, dtype))
    rotation = xmat[..., markers.body_index, :, :]
    # A sum of products: a matrix product would be rounded on GPUs, see _poses.py.
    return xpos[..., markers.body_index, :] + jnp.sum(rotation * local[:, None, :], axis=-1)
