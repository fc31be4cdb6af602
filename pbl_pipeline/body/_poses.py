"""Where the bodies are, compiled: the chain of the tree, level by level, with the derivative written out.

MuJoCo's own kinematics in JAX (`mjx.kinematics`) gives the same numbers, which a test holds, but a program of some
9,000 operations, 18,000 with its derivative, that takes longer to compile than a short trial takes to fit. Here all
hinges turn at once, the turns of each body are multiplied at once, and the tree is then walked level by level: a
dozen batched products of 3x3 matrices.

The derivative of a tree of rigid bodies is known in closed form (the geometric Jacobian, e.g. Featherstone, Rigid Body
Dynamics Algorithms, 2008, ch. 4) and needs only positions, rotations and joint axes:

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
from scipy.spatial.transform import Rotation

from pbl_pipeline.body._model import Body


@functools.cache
def poses(body: Body) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
    """The compiled function (N, 40) joint values, (21, 3) body positions -> xpos (N, 21, 3), xmat (N, 21, 3, 3),
    xaxis (N, 40, 3).

    Body positions are in the parent's frame, metres; `xaxis` are the joints' axes in the world. Differentiable in both
    arguments, forward and reverse.
    """
    tree = tree_of(body)

    chain = _Chain.of(body)

    @jax.custom_jvp
    def one(qpos: Array, body_pos: Array) -> tuple[Array, Array, Array]:
        return _forward(chain, tree, qpos, body_pos)

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


@dataclasses.dataclass(frozen=True)
class _Chain:
    """The joints of each body in the order in which they act, padded to the most a body has; Q stands for none."""

    stands: np.ndarray  # (B, 3, 3): the body against its parent at qpos 0
    axis: np.ndarray  # (Q, 3) in the body's frame
    hinges: np.ndarray  # (B, H): joints that turn the body
    levels: tuple[np.ndarray, ...]  # bodies by their distance from the world
    owner: np.ndarray  # (Q,)
    turn: np.ndarray  # (Q,): which hinge of its body, the number of hinges before it (slides: 0)

    @classmethod
    def of(cls, body: Body) -> _Chain:
        model, parent = body.mj_model, body.parent_index
        owner = np.asarray(model.jnt_bodyid) - 1
        hinge = model.jnt_type == 3
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
        return cls(
            stands=Rotation.from_quat(model.body_quat[1:], scalar_first=True).as_matrix(),
            axis=np.asarray(model.jnt_axis),
            hinges=hinges,
            levels=tuple(np.flatnonzero(depth == d) for d in range(depth.max() + 1)),
            owner=owner,
            turn=turn,
        )


def _forward(chain: _Chain, tree: Tree, qpos: Array, body_pos: Array) -> tuple[Array, Array, Array]:
    """xpos (B, 3), xmat (B, 3, 3), xaxis (Q, 3) of one pose."""
    dtype = qpos.dtype
    axis = jnp.asarray(chain.axis, dtype)
    turned = jax.lax.optimization_barrier(jnp.concatenate([_rodrigues(axis, qpos), jnp.eye(3, dtype=dtype)[None]]))
    partial = [jnp.asarray(chain.stands, dtype)]
    for h in range(chain.hinges.shape[1]):
        partial.append(_product(partial[-1], turned[chain.hinges[:, h]]))
    local, before = partial[-1], jnp.stack(partial)[chain.turn, chain.owner]
    xmat: list[Array] = [jnp.zeros((3, 3), dtype)] * len(tree.parent)
    for bodies in chain.levels:
        here = local[bodies]
        if tree.parent[bodies[0]] >= 0:
            here = _product(jnp.stack([xmat[p] for p in tree.parent[bodies]]), here)
        for b, matrix in zip(bodies, here, strict=True):
            xmat[b] = matrix
    matrices = jnp.stack(xmat)
    world = jnp.concatenate([matrices, jnp.eye(3, dtype=dtype)[None]])  # parent -1: the world
    xaxis = _turned(world[tree.parent[chain.owner]], _turned(before, axis))
    slides = jnp.matmul(jnp.asarray(tree.slides_body, dtype), xaxis * qpos[:, None], precision="highest")
    step = _turned(world[tree.parent], body_pos) + slides
    return jnp.matmul(jnp.asarray(tree.path, dtype), step, precision="highest"), matrices, xaxis


# Sums of products and not matrix products: those are rounded to ten bits on GPUs, and called one by one on CPUs.
# The barrier keeps the compiler from computing a product anew in each of the products that use it.
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
