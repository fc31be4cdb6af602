"""Markers of a table at many poses with the reverse derivative written out: what a gradient method calls at each step.

A marker is a linear function of where its body is, so all markers come from the bodies' poses by one matrix product.
Backwards, the pull on the markers becomes a force and a torque on each body, these add up along the tree, and a joint
feels what its axis feels (the transposed geometric Jacobian, Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 4).
Few large operations instead of many small ones, and no scatter: the numbers are those of `table_positions`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body._jacobian import MarkerTable
from pbl_pipeline.body._kinematics import scaled_body_pos
from pbl_pipeline.body._model import Body
from pbl_pipeline.body._poses import poses, tree_of


def chained_markers(
    body: Body,
    table: MarkerTable,
    qpos: Float[Array, "M 40"],
    scale: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> Float[Array, "M J 3"]:
    """Markers in the world (m), as `table_positions`; reverse derivative only."""
    bodies = len(body.parent_index)
    owner = jax.nn.one_hot(table.body_index, bodies, dtype=qpos.dtype)
    own = jnp.matmul(owner, scale[body.scale_index], precision="highest")
    local = own[:, None] * (table.position_m + site_offset_m)
    place = jnp.concatenate([jnp.ones_like(local[:, :1]), local], axis=1)
    weights = (owner[:, :, None] * place[:, None, :]).reshape(len(local), bodies * 4)
    frames = _frames(body)(qpos, scaled_body_pos(body, scale))
    return jnp.einsum("mcp,jp->mjc", frames, weights, precision="highest")


@functools.cache
def _frames(body: Body) -> Callable[[Array, Array], Array]:
    """(M, 40) joint values, (21, 3) body positions -> (M, 3, 21 * 4): each body's origin and the columns of its
    rotation."""
    tree = tree_of(body)
    owner = np.asarray(body.mj_model.jnt_bodyid) - 1
    hinge = np.asarray(body.mj_model.jnt_type == 3)  # mjJNT_HINGE
    rooted = tree.parent < 0

    def values(qpos: Array, body_pos: Array) -> tuple[Array, Array]:
        xpos, xmat, xaxis = poses(body)(qpos, body_pos)
        return jnp.swapaxes(jnp.concatenate([xpos[..., None], xmat], axis=-1), 1, 2), xaxis

    @jax.custom_vjp
    def frames(qpos: Array, body_pos: Array) -> Array:
        placed, _ = values(qpos, body_pos)
        return placed.reshape(len(qpos), 3, -1)

    def forward(qpos: Array, body_pos: Array):
        placed, xaxis = values(qpos, body_pos)
        return placed.reshape(len(qpos), 3, -1), (placed, xaxis)

    def backward(kept, pull: Array):
        placed, xaxis = kept
        pull = pull.reshape(placed.shape)
        # Force and torque about the world's origin, (M, 3, B) each: sum over the four columns of c x dc.
        torque = jnp.sum(jnp.cross(placed, pull, axis=1), axis=-1)
        both = jnp.concatenate([pull[..., 0], torque], axis=1)
        carried = jnp.matmul(both, jnp.asarray(tree.path, both.dtype), precision="highest")
        on_joint = jnp.swapaxes(carried, 1, 2)[:, owner]
        force, torque = on_joint[..., :3], on_joint[..., 3:]
        origin = jnp.swapaxes(placed[..., 0], 1, 2)[:, owner]
        felt = jnp.where(hinge[:, None], torque - jnp.cross(origin, force), force)
        dqpos = jnp.sum(felt * xaxis, axis=-1)
        eye = jnp.eye(3, dtype=placed.dtype)[:, None]
        turned = jnp.where(rooted[:, None], eye, placed[:, :, np.maximum(tree.parent, 0), 1:])
        return dqpos, jnp.sum(turned * carried[:, :3, :, None], axis=(0, 1))

    frames.defvjp(forward, backward)
    return frames
