"""The cost of the keypoints at given marker positions: what both solvers minimise and what compares them.

The paper, section Model Fitting: means over markers of the Huber costs of 3D and 2D distances, weighted by confidence.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body._jacobian import MarkerTable

from . import _costs as costs
from ._inputs import Session
from ._observations import Observations
from ._params import CostParams


@dataclasses.dataclass(frozen=True)
class Kinds:
    """Which terms a session has (static: part of the compiled program)."""

    camera_3d: bool
    camera_2d: bool
    world: bool
    moving: bool
    contact: bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MarkerWeights:
    """Weights and Huber widths of the keypoint terms as arrays, so that others run the same compiled program."""

    weight_3d: Float[Array, ""]
    weight_2d: Float[Array, ""]
    huber_3d_cm: Float[Array, ""]
    huber_2d_px: Float[Array, ""]
    depth_ratio: Float[Array, ""]

    @classmethod
    def of(cls, cost: CostParams) -> MarkerWeights:
        """Those of a paramset."""
        return cls(*(jnp.asarray(getattr(cost, f.name), jnp.float32) for f in dataclasses.fields(cls)))


class KeypointWeights(Protocol):
    """What the cost reads of a solver's weights."""

    @property
    def weight_3d(self) -> Array: ...
    @property
    def weight_2d(self) -> Array: ...
    @property
    def huber_3d_cm(self) -> Array: ...
    @property
    def huber_2d_px(self) -> Array: ...
    @property
    def depth_ratio(self) -> Array: ...


def kinds_of(session: Session) -> Kinds:
    """Which terms a session has."""
    obs = session.obs
    has = lambda c: bool(np.any(np.asarray(c) > 0))  # noqa: E731
    return Kinds(
        camera_3d=has(obs.c_3d),
        camera_2d=has(obs.c_2d),
        world=has(obs.c_world),
        moving=session.moving,
        contact=has(obs.contact),
    )


def marker_cost(
    x_world: Float[Array, "M J 3"],
    obs: Observations,
    R_nc: Float[Array, "M V 3 3"],
    table: MarkerTable,
    w: KeypointWeights,
    kinds: Kinds,
) -> Float[Array, " M"]:
    """Weighted cost of the keypoints in each of M frames of `obs`: means over markers and views.

    3D points of a camera are compared with their mean over the seen markers removed, points in the world as they are.
    """
    total = jnp.zeros(x_world.shape[0], x_world.dtype)
    each = 1 / (obs.n_markers * obs.n_views)
    if kinds.camera_3d or kinds.camera_2d:
        # Coordinate by coordinate: sums over a last axis of three are slow. A turn and a shift of everything changes no
        # distance, so the camera's own axes serve both terms.
        away = [x_world[:, None, :, k] - obs.p_nc[:, :, None, k] for k in range(3)]
        x, y, z = (_sum(R_nc[:, :, k, i, None] * away[k] for k in range(3)) for i in range(3))
        if kinds.camera_3d:
            seen = jnp.where(obs.c_3d > 0, table.weight_3d, 0.0)
            share = seen / jnp.maximum(jnp.sum(seen, axis=-1, keepdims=True), 1e-6)
            off = [a - obs.x_cam[..., i] for i, a in enumerate((x, y, z))]
            dx, dy, dz = (a - jnp.sum(a * share, axis=-1, keepdims=True) for a in off)
            e2 = 1e4 * (dx**2 + dy**2 + (dz * w.depth_ratio) ** 2)
            e = costs.huber_of_square(e2, w.huber_3d_cm) * obs.c_3d * table.weight_3d
            total += w.weight_3d * each * jnp.sum(e, axis=(-2, -1))
        if kinds.camera_2d:
            per_depth, camera = 1 / costs.soft_depth_m(z), obs.camera_matrix[..., None]
            u = camera[..., 0, 0, :] * x * per_depth + camera[..., 0, 2, :] - obs.xy_px[..., 0]
            v = camera[..., 1, 1, :] * y * per_depth + camera[..., 1, 2, :] - obs.xy_px[..., 1]
            e = costs.huber_of_square(u**2 + v**2, w.huber_2d_px) * obs.c_2d
            total += w.weight_2d * each * jnp.sum(e, axis=(-2, -1))
    if kinds.world:
        e2 = 1e4 * _sum((x_world[..., k] - obs.x_world[..., k]) ** 2 for k in range(3))
        e = costs.huber_of_square(e2, w.huber_3d_cm) * obs.c_world * table.weight_3d
        total += w.weight_3d * jnp.sum(e, axis=-1) / obs.n_markers
    return total


def _sum(parts: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, parts)


#: Fields of `Observations` with one row per frame that `marker_cost` reads.
PER_FRAME = ("x_cam", "c_3d", "xy_px", "c_2d", "x_world", "c_world", "R_nc", "p_nc", "camera_matrix")


def frames_at(obs: Observations, index: Array) -> Observations:
    """The keypoints and cameras of some frames, by their numbers (M,); other fields are left as they are."""
    take = lambda a: a.at[index].get(mode="promise_in_bounds")  # noqa: E731
    return dataclasses.replace(obs, **{k: take(getattr(obs, k)) for k in PER_FRAME})
