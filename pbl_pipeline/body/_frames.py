"""What forward kinematics returns, and MuJoCo's own in JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pbl_pipeline.body.model import Body
from pbl_pipeline.jax_setup import import_mjx


class Frames(NamedTuple):
    """B bodies and Q joints in the world at N poses, under MuJoCo's names: origins (m) and rotations (body to world) of
    the bodies, axes and anchors (m) of the joints."""

    xpos: Float[Array, "N B 3"]
    xmat: Float[Array, "N B 3 3"]
    xaxis: Float[Array, "N Q 3"]
    xanchor: Float[Array, "N Q 3"]


def mjx_frames(body: Body, qpos: Float[Array, "N Q"], body_pos: Float[Array, "B 3"]) -> Frames:
    """Bodies and joints in the world at N poses (rad, m), each body at `body_pos` (m) of its parent.

    `mjx.kinematics`, never `mjx.forward`, which would also compute the dynamics.
    """
    world = jnp.zeros((1, 3), body_pos.dtype)
    (model, state), mjx = body.mjx_model_and_data, import_mjx()
    model = model.replace(body_pos=jnp.concatenate([world, body_pos]))

    def one(q: Array) -> Frames:
        data = mjx.kinematics(model, state.replace(qpos=q))
        return Frames(data.xpos[1:], data.xmat[1:].reshape(-1, 3, 3), data.xaxis, data.xanchor)

    return jax.vmap(one)(qpos)
