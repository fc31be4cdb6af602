"""Markers of a table at many poses with the reverse derivative written out: what a gradient method calls at each step.

The numbers are those of `table_positions`. Made for few and large operations, because a step has thousandths of a
second: the poses lie along the last axis; a body's place in the world is the product of all transforms on its way from
the root, found by doubling (each body takes over its parent's product, then that of the one twice as far); all markers
come from the bodies' places by one matrix product. Backwards, the pull on the markers becomes a force and a torque on
each body, these add up along the tree, and a joint feels what its axis feels (the transposed geometric Jacobian,
Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 4).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body._jacobian import MarkerTable
from pbl_pipeline.body._model import Body
from pbl_pipeline.body._poses import tree_of


def chained_markers(
    body: Body,
    table: MarkerTable,
    qpos: Float[Array, "M 40"],
    scale: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> Float[Array, "J 3 M"]:
    """Markers in the world (m), as `table_positions` but with the poses last; reverse derivative only."""
    bodies, dtype = len(body.parent_index), qpos.dtype
    owner = jax.nn.one_hot(table.body_index, bodies, dtype=dtype)
    group = np.asarray(body.scale_index)[:, None] == np.arange(len(body.scale_names))
    own = jnp.sum(jnp.matmul(owner, group.astype(dtype), precision="highest") * scale, axis=-1)
    local = own[:, None] * (table.position_m + site_offset_m)
    place = jnp.concatenate([jnp.ones_like(local[:, :1]), local], axis=1)
    weights = (owner[:, :, None] * place[:, None, :]).reshape(len(local), bodies * 4)
    parent = np.where((body.parent_index >= 0)[:, None], group[body.parent_index], False).astype(dtype)
    fixed = jnp.asarray(body.parent_index < 0, dtype)
    hangs = jnp.asarray(body.mj_model.body_pos[1:], dtype) * (fixed + jnp.sum(parent * scale, axis=-1))[:, None]
    frames = _frames(body)(qpos.T, hangs)
    x = jnp.matmul(weights, frames.reshape(bodies * 4, -1), precision="highest")
    return x.reshape(len(local), 3, -1)


@dataclasses.dataclass(frozen=True)
class _Slots:
    """The joints of each of B bodies in H slots for hinges, and the body's slides, in matrices over Q joints.

    A hinge turns by `still + cos * swing + sin * cross`; an empty slot's is the identity. `place`: the row of each
    joint's pull among (H hinges, then slides) x B.
    """

    hinge: np.ndarray  # (H, B) joint, Q: none
    still: np.ndarray  # (H, B, 3, 3)
    swing: np.ndarray
    cross: np.ndarray
    axis: np.ndarray  # (H, B, 3)
    slide: np.ndarray  # (B, 3, Q): way in the parent's frame per unit of a slide
    jumps: tuple[np.ndarray, ...]  # (B + 1,) each: ancestors 1, 2, 4 ... up, B: none

    @classmethod
    def of(cls, body: Body) -> _Slots:
        model, parent = body.mj_model, body.parent_index
        owner, hinge = np.asarray(model.jnt_bodyid) - 1, model.jnt_type == 3  # mjJNT_HINGE
        bodies, joints = len(parent), model.njnt
        lists = [np.flatnonzero((owner == b) & hinge) for b in range(bodies)]
        slot = np.full((max(map(len, lists)), bodies), joints)
        for b, mine in enumerate(lists):
            slot[: len(mine), b] = mine
        stands = Rotation.from_quat(model.body_quat[1:], scalar_first=True).as_matrix()
        axis = np.concatenate([model.jnt_axis, np.zeros((1, 3))])[slot]
        outer = axis[..., :, None] * axis[..., None, :]
        empty = (slot == joints)[..., None, None]
        still, swing = np.where(empty, np.eye(3), outer), np.where(empty, 0.0, np.eye(3) - outer)
        cross = np.cross(np.eye(3), axis[..., None, :])
        still[0], swing[0], cross[0] = stands @ still[0], stands @ swing[0], stands @ cross[0]
        slide = np.zeros((bodies, 3, joints))
        for j in np.flatnonzero(~hinge):
            slide[owner[j], :, j] = stands[owner[j]] @ model.jnt_axis[j]
        up = np.append(np.where(parent < 0, bodies, parent), bodies)
        jumps = [up]
        while np.any(jumps[-1] < bodies):
            jumps.append(jumps[-1][jumps[-1]])
        return cls(slot, still, swing, cross, axis, slide, tuple(jumps[:-1]))


@functools.cache
def _frames(body: Body) -> Callable[[Array, Array], Array]:
    """(40, M) joint values, (21, 3) body positions -> (21, 4, 3, M): each body's origin in the world (m), then the
    columns of its rotation."""
    tree, slots = tree_of(body), _Slots.of(body)
    bodies, joints = len(tree.parent), body.mj_model.njnt
    up = slots.jumps[0][:-1]
    by_hinge = np.argsort(slots.hinge.ravel())[: np.count_nonzero(slots.hinge < joints)]
    hinges = np.sort(slots.hinge[slots.hinge < joints])
    slides = np.setdiff1d(np.arange(joints), hinges)
    back = np.argsort(np.concatenate([hinges, slides]))

    def const(a: np.ndarray) -> Array:
        return jnp.asarray(a, jnp.result_type(float))[..., None]

    def values(q: Array, body_pos: Array) -> tuple[Array, Array, Array]:
        """Places in the world, the hinges' axes in the frame of the parent (H, B, 3, M), the parents' rotations."""
        cos, sin = (jnp.concatenate([f(q), jnp.full_like(q[:1], f(0.0))]) for f in (jnp.cos, jnp.sin))
        local, axes = None, []
        for h, joint in enumerate(slots.hinge):
            c, s = cos[joint][:, None, None], sin[joint][:, None, None]
            turn = const(slots.still[h]) + const(slots.swing[h]) * c + const(slots.cross[h]) * s
            local = turn if local is None else _product(local, turn)
            axes.append(_along(local, jnp.broadcast_to(const(slots.axis[h])[:, None], local.shape), 2))
        assert local is not None
        move = functools.reduce(jnp.add, [const(slots.slide[..., j]) * q[j] for j in slides])
        hangs = body_pos[..., None] + move
        # Rows: origin, then columns of the rotation. The last body is the world.
        placed = jnp.concatenate([hangs[:, None], jnp.swapaxes(local, 1, 2)], axis=1)
        world = jnp.broadcast_to(const(np.eye(4, 3, -1)), (1, 4, 3, q.shape[1]))
        placed = jnp.concatenate([placed, world])
        for ancestor in slots.jumps:
            before = placed[ancestor]
            turned = functools.reduce(jnp.add, [before[:, None, 1 + k] * placed[:, :, k, None] for k in range(3)])
            placed = jnp.concatenate([turned[:, :1] + before[:, :1], turned[:, 1:]], axis=1)
        return placed[:-1], jnp.stack(axes), placed[up][:, 1:]

    @jax.custom_vjp
    def frames(q: Array, body_pos: Array) -> Array:
        return values(q, body_pos)[0]

    def forward(q: Array, body_pos: Array):
        placed, axes, parents = values(q, body_pos)
        return placed, (placed, axes, parents)

    def backward(kept, pull: Array):
        placed, axes, parents = kept
        # Force and torque about the world's origin: a pull dc on a vector c is a torque c x dc.
        arms = _cross(placed, pull)
        torque = arms[:, 0] + arms[:, 1] + arms[:, 2] + arms[:, 3]
        both = jnp.concatenate([pull[:, 0], torque], axis=1)
        path = jnp.asarray(tree.path.T, both.dtype)
        carried = jnp.matmul(path, both.reshape(bodies, -1), precision="highest").reshape(both.shape)
        force = carried[:, :3]
        about_joint = carried[:, 3:] - _cross(placed[:, 0], force)
        # In the frame of the parent: (B, 3, M).
        force, about_joint = (
            _along(parents, jnp.broadcast_to(a[:, None], parents.shape), 2) for a in (force, about_joint)
        )
        by_turn = _along(axes, jnp.broadcast_to(about_joint, axes.shape), 2).reshape(-1, placed.shape[-1])[by_hinge]
        slid = [jnp.sum(const(slots.slide[..., j]) * force, axis=(0, 1)) for j in slides]
        return jnp.concatenate([by_turn, jnp.stack(slid)])[back], jnp.sum(force, axis=-1)

    frames.defvjp(forward, backward)
    return frames


# Sums of products and not matrix products: those are rounded to ten bits on GPUs, see _poses.py. Written out, because a
# sum along an axis is not vectorised on CPUs.
def _product(a: Float[Array, "B 3 3 M"], b: Float[Array, "B 3 3 M"]) -> Float[Array, "B 3 3 M"]:
    return sum(a[:, :, k, None] * b[:, None, k] for k in range(3))  # type: ignore[return-value]


def _along(matrix: Array, vector: Array, axis: int) -> Array:
    """Sum over `axis` (3 long) of the product."""
    part = lambda a, k: jax.lax.index_in_dim(a, k, axis, keepdims=False)  # noqa: E731
    return sum(part(matrix, k) * part(vector, k) for k in range(3))  # type: ignore[return-value]


def _cross(a: Float[Array, "*n 3 M"], b: Float[Array, "*n 3 M"]) -> Float[Array, "*n 3 M"]:
    (ax, ay, az), (bx, by, bz) = (tuple(v[..., i, :] for i in range(3)) for v in (a, b))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)
