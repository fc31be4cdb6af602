"""Forward kinematics `M(theta, beta) -> x`: joint angles, scales and marker offsets to points in the world.

Positions only: `mjx.kinematics`, never `mjx.forward`, which would also compute the dynamics.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float
from mujoco import mjx

from pbl_pipeline.body._markers import MarkerSet
from pbl_pipeline.body._model import Body


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
    parent_scale = jnp.where(body.parent_index >= 0, scale[body.scale_index[body.parent_index]], 1.0)
    # Index 0 of MuJoCo is the world, which has no scale.
    factor = jnp.concatenate([jnp.ones(1, scale.dtype), parent_scale])
    batch = qpos.shape[:-1]
    xpos, xmat = _kinematics(body)(qpos.reshape(-1, qpos.shape[-1]), factor)
    return xpos.reshape(*batch, *xpos.shape[1:]), xmat.reshape(*batch, *xmat.shape[1:])


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
    # A sum of products instead of a matrix product, for the same reason as above.
    return xpos[..., markers.body_index, :] + jnp.sum(rotation * local[:, None, :], axis=-1)


@functools.cache
def _kinematics(body: Body) -> Callable[[Array, Array], tuple[Array, Array]]:
    """(N, 40) joint values and (22,) multipliers of the body positions -> xpos (N, 21, 3), xmat (N, 21, 3, 3)."""

    def one(model: mjx.Model, qpos: Array) -> tuple[Array, Array]:
        # GPUs round the factors of float32 products to ten bits unless told otherwise: millimetres at the foot.
        with jax.default_matmul_precision("highest"):
            data = mjx.kinematics(model, body.mjx_data.replace(qpos=qpos))
        return data.xpos[1:], data.xmat[1:]

    # Compiled here so that a call outside any jit is not hundreds of small ones; inside a jit this changes nothing.
    @jax.jit
    def all_poses(qpos: Array, factor: Array) -> tuple[Array, Array]:
        model = body.mjx_model.replace(body_pos=body.mjx_model.body_pos * factor[:, None])
        return jax.vmap(one, in_axes=(None, 0))(model, qpos)

    return all_poses
