"""Markers and their derivatives in closed form: what a Gauss-Newton step needs, without automatic differentiation.

The same geometry as in `_poses.py`: a hinge turns everything that hangs on it about its axis, a slide moves it along.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pbl_pipeline.body._kinematics import scaled_body_pos
from pbl_pipeline.body._markers import MarkerSet
from pbl_pipeline.body._model import Body
from pbl_pipeline.body._poses import poses, tree_of


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MarkerTable:
    """A marker set as arrays, so that one compiled program serves every set of the same (padded) size.

    `weight` is 0 for padding, 1 otherwise; `weight_3d` as in `MarkerSet`.
    """

    body_index: Int[Array, " J"]
    position_m: Float[Array, "J 3"]
    weight_3d: Float[Array, " J"]
    weight: Float[Array, " J"]

    @classmethod
    def of(cls, markers: MarkerSet, size: int | None = None) -> MarkerTable:
        """The table of a marker set, padded to `size` rows, on the host."""
        pad = (size or len(markers)) - len(markers)
        f32 = functools.partial(np.asarray, dtype=np.float32)
        arrays: dict[str, Any] = {
            "body_index": np.pad(markers.body_index, (0, pad)).astype(np.int32),
            "position_m": f32(np.pad(markers.position_m, [(0, pad), (0, 0)])),
            "weight_3d": f32(np.pad(markers.weight_3d, (0, pad))),
            "weight": f32(np.pad(np.ones(len(markers)), (0, pad))),
        }
        return cls(**arrays)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MarkerJacobian:
    """Positions of J markers in the world (m) at T poses and their derivatives.

    x_world_m; per_qpos: m/rad (m/m for slides); per_scale: m per unit of each multiplier; per_offset: turns and scales
    a marker's offset into the world.
    """

    x_world_m: Float[Array, "T J 3"]
    per_qpos: Float[Array, "T J 3 40"]
    per_scale: Float[Array, "T J 3 8"]
    per_offset: Float[Array, "T J 3 3"]


def table_positions(
    body: Body,
    table: MarkerTable,
    qpos: Float[Array, "T 40"],
    scale: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> Float[Array, "T J 3"]:
    """`marker_positions` for a table: markers in the world (m)."""
    xpos, xmat, _ = poses(body)(qpos, scaled_body_pos(body, scale))
    local = _own_scale(body, table, scale)[:, None] * (table.position_m + site_offset_m)
    return xpos[:, table.body_index] + jnp.sum(xmat[:, table.body_index] * local[:, None, :], axis=-1)


def marker_jacobian(
    body: Body,
    table: MarkerTable,
    qpos: Float[Array, "T 40"],
    scale: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> MarkerJacobian:
    """Markers at T poses with the derivatives by joint values, scale multipliers and marker offsets."""
    tree = tree_of(body)
    xpos, xmat, xaxis = poses(body)(qpos, scaled_body_pos(body, scale))
    own = _own_scale(body, table, scale)
    rotation = xmat[:, table.body_index]
    place = table.position_m + site_offset_m
    arm = jnp.sum(rotation * place[:, None, :], axis=-1)
    x = xpos[:, table.body_index] + own[:, None] * arm

    owner = np.asarray(body.mj_model.jnt_bodyid) - 1
    turns = jnp.asarray(tree.turns_body, x.dtype)[table.body_index]
    slides = jnp.asarray(tree.path @ tree.slides_body, x.dtype)[table.body_index]
    # One coordinate after the other, joints last: the loops then run over neighbouring numbers.
    axis = [xaxis[:, None, :, k] for k in range(3)]
    lever = [x[:, :, None, k] - xpos[:, None, owner, k] for k in range(3)]
    per_qpos = jnp.stack(
        [
            turns * (axis[(k + 1) % 3] * lever[(k + 2) % 3] - axis[(k + 2) % 3] * lever[(k + 1) % 3]) + slides * axis[k]
            for k in range(3)
        ],
        axis=-2,
    )

    # A scaled parent moves its children's origins; everything further out follows.
    parent = tree.parent
    hangs = jnp.asarray(body.mj_model.body_pos[1:], x.dtype)
    step = jnp.sum(xmat[:, np.maximum(parent, 0)] * hangs[:, None, :], axis=-1) * (parent >= 0)[:, None]
    group = (body.scale_index[np.maximum(parent, 0)][:, None] == np.arange(len(body.scale_names))) * 1.0
    origin = jnp.einsum("ab,tbi,bg->taig", jnp.asarray(tree.path, x.dtype), step, group.astype(x.dtype))
    mine = jax.nn.one_hot(jnp.asarray(body.scale_index)[table.body_index], len(body.scale_names), dtype=x.dtype)
    per_scale = origin[:, table.body_index] + arm[..., None] * mine[:, None, :]
    return MarkerJacobian(
        x_world_m=x,
        per_qpos=per_qpos,
        per_scale=per_scale,
        per_offset=rotation * own[:, None, None],
    )


def _own_scale(body: Body, table: MarkerTable, scale: Float[Array, " 8"]) -> Float[Array, " J"]:
    return scale[jnp.asarray(body.scale_index)[table.body_index]]
