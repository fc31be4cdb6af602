"""The body model `M(theta, beta) -> x` of the paper: joint angles, scales and marker offsets to points in the world.

Its derivative is in closed form: every joint moves the points of the bodies beyond it like a rigid body,
``dx = omega x (x - o) + v``, where a hinge contributes its axis to omega and a slide its axis to v (the geometric
Jacobian, e.g. Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 4). Gauss-Newton uses the columns of that
Jacobian (`marker_jacobian`); automatic differentiation uses the rule, forward and, transposed, in reverse.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from pbl_pipeline.body._chain import Frames, chain_frames
from pbl_pipeline.body.model import Body

#: Forward kinematics: body, joint values (N, Q) and body positions (B, 3) to `Frames`.
Forward = Callable[[Body, Array, Array], Frames]


class Points(Protocol):
    """J points fixed to bodies, such as a `MarkerSet`: index of the body, and position in its frame."""

    @property
    def body_index(self) -> Any: ...
    @property
    def position_m(self) -> Any: ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MarkerJacobian:
    """J points in the world (m) at N poses and their derivatives."""

    x_world_m: Float[Array, "N J 3"]
    per_qpos: Float[Array, "N J 3 Q"]  # m/rad (m/m for slides)
    per_scale: Float[Array, "N J 3 S"]  # m per unit of each multiplier
    per_offset: Float[Array, "N J 3 3"]  # rotates and scales a point's offset into the world


def body_poses(
    body: Body, qpos: Float[ArrayLike, "*batch Q"], scale: Float[ArrayLike, " S"]
) -> tuple[Float[Array, "*batch B 3"], Float[Array, "*batch B 3 3"]]:
    """Positions and rotations of the bodies.

    Parameters
    ----------
    qpos : (..., Q)
        Joint values in the order of `body.joint_names`, radians and metres.
    scale : (S,)
        Multipliers in the order of `body.scale_names` (1 = unscaled). A body's scale multiplies the positions of its
        child bodies; the root hangs on the world and moves with qpos alone.

    Returns
    -------
    xpos : (..., B, 3)
        Origins in the world (z up), metres.
    xmat : (..., B, 3, 3)
        Rotations, body frame to world.
    """
    qpos = jnp.asarray(qpos, jnp.result_type(float))
    batch = qpos.shape[:-1]
    frames = _compiled_frames(body, qpos.reshape(-1, qpos.shape[-1]), jnp.asarray(scale, qpos.dtype))
    return frames.xpos.reshape(*batch, -1, 3), frames.xmat.reshape(*batch, -1, 3, 3)


def marker_positions(
    body: Body,
    markers: Points,
    qpos: Float[ArrayLike, "*batch Q"],
    scale: Float[ArrayLike, " S"],
    site_offset_m: Float[ArrayLike, "J 3"],
    forward: Forward = chain_frames,
) -> Float[Array, "*batch J 3"]:
    """Positions of the markers in the world: `x = xpos + xmat @ (scale * (position + offset))` of each marker's body.

    Differentiable in `qpos`, `scale` and `site_offset_m`, forward and reverse; works under `jit`, `vmap` and `grad`.

    Parameters
    ----------
    site_offset_m : (J, 3)
        Added to each marker's position in its body's frame before scaling, metres.
    forward
        `chain_frames` or `mjx_frames`: the same numbers from another program.

    Returns
    -------
    (..., J, 3) in the world (z up), metres.
    """
    qpos = jnp.asarray(qpos, jnp.result_type(float))
    local = jnp.asarray(markers.position_m, qpos.dtype) + jnp.asarray(site_offset_m, qpos.dtype)
    x = _compiled_positions(
        body, forward, qpos.reshape(-1, qpos.shape[-1]), jnp.asarray(scale, qpos.dtype), local, markers.body_index
    )
    return x.reshape(*qpos.shape[:-1], *x.shape[1:])


def marker_jacobian(
    body: Body,
    markers: Points,
    qpos: Float[Array, "N Q"],
    scale: Float[Array, " S"],
    site_offset_m: Float[Array, "J 3"],
) -> MarkerJacobian:
    """Positions of the markers at N poses with the derivatives by joint values, scale multipliers and offsets."""
    at = _placed(body, chain_frames, qpos, scale, markers.position_m + site_offset_m, markers.body_index)
    moves = jnp.asarray(body.moves, qpos.dtype)[markers.body_index]
    # One coordinate after the other, joints last: the loops then run over neighbouring numbers.
    w, v = ([a[:, None, :, k] for k in range(3)] for a in (at.angular, at.linear))
    r = [at.lever[:, :, None, k] for k in range(3)]
    per_qpos = [moves * (w[i] * r[j] - w[j] * r[i] + v[k]) for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    return MarkerJacobian(at.x, jnp.stack(per_qpos, axis=-2), at.per_scale, at.per_offset)


def body_turns(
    body: Body, body_index: Any, qpos: Float[Array, "N Q"]
) -> tuple[Float[Array, "N J 3 3"], Float[Array, "N J 3 Q"]]:
    """Rotations of J bodies, to the world, at N poses, and the rotation vectors (world axes, from the left) by which
    they turn with the joint values."""
    frames = chain_frames(body, qpos, scaled_body_pos(body, jnp.ones(len(body.scale_names), qpos.dtype)))
    axes = jnp.where(jnp.asarray(body.is_hinge)[:, None], frames.xaxis, 0.0).swapaxes(1, 2)
    moves = jnp.asarray(body.moves, qpos.dtype)[body_index]
    return frames.xmat[:, body_index], moves[:, None, :] * axes[:, None]


def scale_multipliers(s: Float[Array, "*n S"]) -> Float[Array, "*n S"]:
    """Multipliers of the scale groups from the paper's parameters, which add to 1: 1 + overall for the first group
    ("overall"), 1 + overall + own for the others."""
    return 1.0 + s[..., :1] + s * (np.arange(s.shape[-1]) > 0)  # of numpy's arrays on the host


def scaled_body_pos(body: Body, scale: Float[Array, " S"]) -> Float[Array, "B 3"]:
    """Position of each body in its parent's frame (m) when the parent is scaled."""
    parent_scale = jnp.where(body.parent_index >= 0, scale[body.scale_index[body.parent_index]], 1.0)
    return jnp.asarray(body.mj_model.body_pos[1:], scale.dtype) * parent_scale[:, None]


# Compiled so that a call outside any jit is not hundreds of small ones; no effect inside a jit.
@functools.partial(jax.jit, static_argnums=0)
def _compiled_frames(body: Body, qpos: Array, scale: Array) -> Frames:
    return chain_frames(body, qpos, scaled_body_pos(body, scale))


@dataclasses.dataclass(frozen=True)
class _Placed:
    """Points at N poses and the parts of their derivative: `lever` from the root's origin o to the point, the joints'
    contributions to omega and, about o, to v.
    """

    x: Array  # (N, J, 3)
    lever: Array  # (N, J, 3)
    angular: Array  # (N, Q, 3)
    linear: Array  # (N, Q, 3)
    per_scale: Array  # (N, J, 3, S)
    per_offset: Array  # (N, J, 3, 3)


def _placed(body: Body, forward: Forward, qpos: Array, scale: Array, local: Array, body_index: Array) -> _Placed:
    """Points at `local` (J, 3) of their unscaled bodies."""
    dtype = qpos.dtype
    frames = forward(body, qpos, scaled_body_pos(body, scale))
    own = scale[jnp.asarray(body.scale_index)[body_index]]
    rotation = frames.xmat[:, body_index]
    # A sum of products: a matrix product would be rounded on GPUs, see _chain.py.
    arm = jnp.sum(rotation * local[:, None, :], axis=-1)
    x = frames.xpos[:, body_index] + own[:, None] * arm

    origin = frames.xpos[:, :1]
    hinge = jnp.asarray(body.is_hinge)[:, None]
    angular = jnp.where(hinge, frames.xaxis, 0.0)
    linear = jnp.where(hinge, jnp.cross(frames.xanchor - origin, frames.xaxis), frames.xaxis)

    # A scaled parent moves its children's origins, and everything beyond them.
    parent = np.maximum(body.parent_index, 0)
    hangs = jnp.asarray(body.mj_model.body_pos[1:] * (body.parent_index >= 0)[:, None], dtype)
    step = jnp.sum(frames.xmat[:, parent] * hangs[:, None, :], axis=-1)
    groups = np.eye(len(body.scale_names))
    by_parent = jnp.asarray(body.path[:, :, None] * groups[body.scale_index[parent]], dtype)
    moved = jnp.einsum("abg,nbi->naig", by_parent, step, precision="highest")
    mine = jnp.asarray(groups[body.scale_index], dtype)[body_index]
    return _Placed(
        x=x,
        lever=x - origin,
        angular=angular,
        linear=linear,
        per_scale=moved[:, body_index] + arm[..., None] * mine[:, None, :],
        per_offset=rotation * own[:, None, None],
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _positions(body: Body, forward: Forward, qpos: Array, scale: Array, local: Array, body_index: Array) -> Array:
    return _placed(body, forward, qpos, scale, local, body_index).x


@_positions.defjvp
def _positions_jvp(body: Body, forward: Forward, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    at = _placed(body, forward, *primals)
    dqpos, dscale, dlocal, _ = tangents
    moves = jnp.asarray(body.moves, at.x.dtype)[primals[3]]
    twist = jnp.concatenate([at.angular, at.linear], axis=-1) * dqpos[..., None]
    twist = jnp.einsum("jq,nqk->njk", moves, twist, precision="highest")
    dx = jnp.cross(twist[..., :3], at.lever) + twist[..., 3:]
    dx += jnp.sum(at.per_scale * dscale, axis=-1)
    return at.x, dx + jnp.sum(at.per_offset * dlocal[:, None, :], axis=-1)


_compiled_positions = jax.jit(_positions, static_argnums=(0, 1))
