"""Where the bodies are, compiled: MJX's kinematics, with the derivative written out.

Differentiating through `mjx.kinematics` gives the right numbers, but a program of some 18,000 operations that takes
longer to compile than a short trial takes to fit. The derivative of a tree of rigid bodies is known in closed form
(the geometric Jacobian, e.g. Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 4), needs only the positions,
rotations and joint axes that MJX returns, and is one small matrix product per step:

- a body turns with all hinges between the world and itself: omega_b = sum of axis_j * dq_j;
- its origin moves as its parent's does, plus omega_parent x (x_b - x_parent), plus its own slides, plus the turned
  change of its place on the parent (scaling). Hinges sit at the body's origin and do not move it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from mujoco import mjx

from pbl_pipeline.body._model import Body


@functools.cache
def poses(body: Body) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
    """The compiled function (N, 40) joint values, (21, 3) body positions -> xpos (N, 21, 3), xmat (N, 21, 3, 3),
    xaxis (N, 40, 3).

    Body positions are in the parent's frame, metres; `xaxis` are the joints' axes in the world. Differentiable in both
    arguments, forward and reverse.
    """
    tree = tree_of(body)

    @jax.custom_jvp
    def one(qpos: Array, body_pos: Array) -> tuple[Array, Array, Array]:
        model = body.mjx_model.replace(body_pos=jnp.concatenate([jnp.zeros((1, 3), body_pos.dtype), body_pos]))
        # GPUs round the factors of float32 products to ten bits unless told otherwise: millimetres at the foot.
        with jax.default_matmul_precision("highest"):
            data = mjx.kinematics(model, body.mjx_data.replace(qpos=qpos))
        return data.xpos[1:], data.xmat[1:], data.xaxis

    @one.defjvp
    def one_jvp(primals, tangents):
        values = one(*primals)
        return values, _tangents(tree, *values, *tangents)

    # Compiled here so that a call outside any jit is not hundreds of small ones; inside a jit this changes nothing.
    @jax.jit
    def all_poses(qpos: Array, body_pos: Array) -> tuple[Array, Array, Array]:
        return jax.vmap(one, in_axes=(0, None))(qpos, body_pos)

    return all_poses


@functools.cache
def tree_of(body: Body) -> Tree:
    """Who moves whom in a body (cached)."""
    return Tree.of(body)


@dataclasses.dataclass(frozen=True)
class Tree:
    """Who moves whom, as 0/1 matrices over B bodies and Q joints."""

    parent: np.ndarray  # (B,), -1: the world
    path: np.ndarray  # (B, B): row b has ones at b and its ancestors
    turns_body: np.ndarray  # (B, Q): hinges that turn body b
    turns_axis: np.ndarray  # (Q, Q): hinges that turn the axis of joint j (those before it)
    slides_body: np.ndarray  # (B, Q): the slides of body b itself

    @classmethod
    def of(cls, body: Body) -> Tree:
        model, parent = body.mj_model, body.parent_index
        hinge, slide = model.jnt_type == 3, model.jnt_type == 2  # mjJNT_HINGE, mjJNT_SLIDE
        if not np.all(hinge | slide) or np.any(model.jnt_pos):
            raise ValueError("the body's joints must be hinges and slides at the origins of their bodies")
        path = np.eye(len(parent))
        for b, p in enumerate(parent):
            if p >= 0:
                path[b] += path[p]
        owner = np.asarray(model.jnt_bodyid) - 1
        # In a path, joints act in the order in which the model lists them: parents before children.
        on_path = path[:, owner]
        earlier = np.tril(np.ones((model.njnt, model.njnt)), -1)
        return cls(
            parent=parent,
            path=path,
            turns_body=on_path * hinge,
            turns_axis=on_path[owner] * earlier * hinge,
            slides_body=(owner[None, :] == np.arange(len(parent))[:, None]) * slide,
        )


def _tangents(
    tree: Tree, xpos: Array, xmat: Array, xaxis: Array, dqpos: Array, dbody_pos: Array
) -> tuple[Array, Array, Array]:
    """Derivatives of xpos (B, 3), xmat (B, 3, 3), xaxis (Q, 3) along dqpos (Q,) and dbody_pos (B, 3)."""

    def times(matrix: np.ndarray, vectors: Array) -> Array:
        return jnp.matmul(jnp.asarray(matrix, vectors.dtype), vectors, precision="highest")

    moved = xaxis * dqpos[:, None]
    omega = times(tree.turns_body, moved)
    rooted = tree.parent < 0
    parent_omega = jnp.where(rooted[:, None], 0.0, omega[tree.parent])
    parent_mat = jnp.where(rooted[:, None, None], jnp.eye(3, dtype=xmat.dtype), xmat[tree.parent])
    lever = xpos - jnp.where(rooted[:, None], 0.0, xpos[tree.parent])
    step = (
        jnp.cross(parent_omega, lever)
        + jnp.sum(parent_mat * dbody_pos[:, None, :], axis=-1)
        + times(tree.slides_body, moved)
    )
    dxpos = times(tree.path, step)
    dxmat = jnp.cross(omega[:, :, None], xmat, axisa=1, axisb=1, axisc=1)
    dxaxis = jnp.cross(times(tree.turns_axis, moved), xaxis)
    return dxpos, dxmat, dxaxis
