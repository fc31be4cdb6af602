"""Forward kinematics of the tree, level by level, compiled once.

MuJoCo's kinematics in JAX (`mjx.kinematics`) returns the same numbers (a test compares them) at the same speed, but its
program has some 9,000 operations and takes ten times as long to compile (research/reports), more than a short trial
takes to fit. Here all hinges turn at once, the turns of each body are multiplied at once, and the tree is then
traversed level by level: a dozen batched products of 3x3 matrices. `_kinematics.py` has the derivative of both.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body.model import Body
from pbl_pipeline.jax_setup import import_mjx


class Frames(NamedTuple):
    """B bodies and Q joints in the world at N poses, with MuJoCo's names: origins (m) and rotations (body to world) of
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


def chain_frames(body: Body, qpos: Float[Array, "N Q"], body_pos: Float[Array, "B 3"]) -> Frames:
    """Bodies and joints in the world at N poses.

    Parameters
    ----------
    qpos : (N, Q)
        Joint values (rad, m).
    body_pos : (B, 3)
        Position of each body in its parent's frame (m).

    Raises
    ------
    ValueError
        The body has joints other than hinges and slides, joints away from their bodies' origins, or a slide that acts
        after a hinge of the same body.
    """
    chain = _chain_of(body)
    return jax.vmap(lambda q: _forward(body, chain, q, body_pos))(qpos)


@dataclasses.dataclass(frozen=True)
class _Chain:
    """Joints of each body in the order in which they act, padded to the largest number; Q stands for none."""

    rest: np.ndarray  # (B, 3, 3): the body against its parent at qpos 0
    axis: np.ndarray  # (Q, 3) in the body's frame
    hinges: np.ndarray  # (B, H): joints that turn the body
    levels: tuple[np.ndarray, ...]  # bodies by their distance from the world
    turn: np.ndarray  # (Q,): the number of hinges of its body before a joint
    slides: np.ndarray  # (B, Q): the slides of body b itself


@functools.cache
def _chain_of(body: Body) -> _Chain:
    model, parent, owner = body.mj_model, body.parent_index, body.joint_body
    hinge = body.is_hinge
    if not np.all(hinge | body.is_slide) or np.any(model.jnt_pos):
        raise ValueError("the body's joints must be hinges and slides at the origins of their bodies")
    lists = [np.flatnonzero((owner == b) & hinge) for b in range(len(parent))]
    hinges = np.full((len(parent), max(map(len, lists))), model.njnt)
    turn = np.zeros(model.njnt, int)
    for b, joints in enumerate(lists):
        hinges[b, : len(joints)] = joints
        turn[joints] = np.arange(len(joints))
        slides = np.flatnonzero((owner == b) & ~hinge)
        if len(slides) and len(joints) and slides.max() > joints.min():
            raise ValueError("the body's slides must act before its hinges")
    depth = np.zeros(len(parent), int)
    for b, p in enumerate(parent):
        depth[b] = depth[p] + 1 if p >= 0 else 0
    return _Chain(
        rest=Rotation.from_quat(model.body_quat[1:], scalar_first=True).as_matrix(),
        axis=np.asarray(model.jnt_axis),
        hinges=hinges,
        levels=tuple(np.flatnonzero(depth == d) for d in range(depth.max() + 1)),
        turn=turn,
        slides=(owner[None, :] == np.arange(len(parent))[:, None]) * ~hinge,
    )


def _forward(body: Body, chain: _Chain, qpos: Array, body_pos: Array) -> Frames:
    dtype, parent, owner = qpos.dtype, body.parent_index, body.joint_body
    axis = jnp.asarray(chain.axis, dtype)
    turned = jax.lax.optimization_barrier(jnp.concatenate([_rodrigues(axis, qpos), jnp.eye(3, dtype=dtype)[None]]))
    partial = [jnp.asarray(chain.rest, dtype)]
    for h in range(chain.hinges.shape[1]):
        partial.append(_product(partial[-1], turned[chain.hinges[:, h]]))
    local, before = partial[-1], jnp.stack(partial)[chain.turn, owner]
    xmat: list[Array] = [jnp.zeros((3, 3), dtype)] * len(parent)
    for bodies in chain.levels:
        here = local[bodies]
        if parent[bodies[0]] >= 0:
            here = _product(jnp.stack([xmat[p] for p in parent[bodies]]), here)
        for b, matrix in zip(bodies, here, strict=True):
            xmat[b] = matrix
    matrices = jnp.stack(xmat)
    world = jnp.concatenate([matrices, jnp.eye(3, dtype=dtype)[None]])  # parent -1: the world
    xaxis = _turned(world[parent[owner]], _turned(before, axis))
    slides = jnp.matmul(jnp.asarray(chain.slides, dtype), xaxis * qpos[:, None], precision="highest")
    step = _turned(world[parent], body_pos) + slides
    xpos = jnp.matmul(jnp.asarray(body.path, dtype), step, precision="highest")
    return Frames(xpos, matrices, xaxis, xpos[owner])


# Sums of products instead of matrix products, which are rounded to ten bits on GPUs and called one by one on CPUs.
# The barrier keeps the compiler from computing a product again in each of the products that use it.
def _product(a: Array, b: Array) -> Array:
    return jax.lax.optimization_barrier(sum(a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(3)))


def _turned(matrix: Array, vector: Array) -> Array:
    x, y, z = (matrix[..., :, k] * vector[..., k : k + 1] for k in range(3))
    return x + y + z


def _rodrigues(axis: Array, angle: Array) -> Array:
    """Rotations (Q, 3, 3) about unit axes (Q, 3)."""
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    outer = axis[:, :, None] * axis[:, None, :]
    sin, cos = jnp.sin(angle)[:, None, None], jnp.cos(angle)[:, None, None]
    return cos * jnp.eye(3, dtype=axis.dtype) + sin * cross + (1 - cos) * outer
