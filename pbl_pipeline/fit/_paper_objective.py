"""The paper's cost of keypoints and camera at given poses, and its total over a session.

`marker_cost` is what `implicit-adam` minimises on samples; `paper_objective` is the paper's total on every frame that
counts, by which solvers are compared whatever they minimise themselves (the paper, section Model Fitting).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable, table_positions

from . import _costs as costs
from ._inputs import Session
from ._observations import Observations
from ._params import CostParams
from .solvers._normal import Kinds, scale_multipliers

#: Frames whose markers are compared at once: bounds the memory of long sessions.
CHUNK = 1024


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


#: The paper's own (section Total loss and optimization), whatever the defaults of `CostParams` become.
PAPER_COST = CostParams(
    weight_3d=1.0, weight_2d=0.1, weight_phone=1.0, weight_offset_per_m2=100.0, huber_3d_cm=10.0, huber_2d_px=5.0
)


def kinds_of(session: Session) -> Kinds:
    """Which terms a session has."""
    obs = session.obs
    has = lambda c: bool(np.any(np.asarray(c) > 0))  # noqa: E731
    return Kinds(camera_3d=has(obs.c_3d), camera_2d=has(obs.c_2d), world=has(obs.c_world), moving=session.moving)


def marker_cost(
    x_world: Float[Array, "M J 3"],
    obs: Observations,
    R_nc: Float[Array, "M V 3 3"],
    table: MarkerTable,
    w: MarkerWeights,
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


def angle_between_deg(a: Float[Array, "*n 4"], b: Float[Array, "*n 4"]) -> Float[Array, "*n"]:
    """Angle (deg) between two orientations as quaternions w, x, y, z, with gradient zero where they agree.

    The paper's Lphone: 2 atan(|vector part| / |scalar part|) of the turn from one to the other.
    """
    scalar = jnp.sum(a * b, axis=-1)
    vector = a[..., :1] * b[..., 1:] - b[..., :1] * a[..., 1:] - jnp.cross(a[..., 1:], b[..., 1:])
    # The root is only taken away from 0, where its derivative is infinite: below 1e-5 deg the angle counts as 0.
    length2 = jnp.sum(vector**2, axis=-1)
    apart = length2 > 1e-14
    length = jnp.sqrt(jnp.where(apart, length2, 1.0))
    return jnp.where(apart, jnp.rad2deg(2 * jnp.arctan2(length, jnp.abs(scalar))), 0.0)


def paper_objective(
    session: Session,
    qpos: Float[ArrayLike, "F 40"],
    R_nc: Float[ArrayLike, "F V 3 3"],
    s: Float[ArrayLike, " 8"],
    site_offset_m: Float[ArrayLike, "J 3"],
) -> float:
    """The paper's total of a solution: 1.0 L3D + 0.1 L2D + 1.0 Lphone + 100 sum offset^2.

    Each term is the mean over trials of its mean over the frames that count and the markers; a phone is compared at
    the frames' times, with the video's clock. `qpos` and `R_nc` are on the packed frames, where those that do not
    count may be NaN; `s`: the paper's scale parameters; `site_offset_m` with or without padding.
    """
    obs, n = session.obs, len(session.trials)
    weight = np.asarray(obs.weight, np.float64)
    counts = weight > 0
    per_trial = np.bincount(np.asarray(obs.trial), weights=weight, minlength=n)
    share = weight / np.maximum(per_trial, 1.0)[np.asarray(obs.trial)] / n
    offset = np.asarray(site_offset_m, np.float32)
    padded = np.pad(offset, [(0, session.table.weight.shape[0] - len(offset)), (0, 0)])
    q = np.where(counts[:, None], qpos, 0.0).astype(np.float32)
    R = np.where(counts[:, None, None, None], R_nc, np.eye(3)).astype(np.float32)
    per_frame = _marker_costs(
        session.body,
        kinds_of(session),
        session.table,
        obs,
        MarkerWeights.of(PAPER_COST),
        q,
        R,
        np.asarray(s, np.float32),
        padded,
    )
    total = float(np.sum(np.asarray(per_frame, np.float64) * share))
    if session.moving:
        measured = Rotation.from_matrix(np.asarray(obs.R_nc, np.float64)[counts, 0])
        off = np.zeros(len(share))
        off[counts] = np.rad2deg((Rotation.from_matrix(np.asarray(R_nc)[counts, 0]) * measured.inv()).magnitude())
        total += PAPER_COST.weight_phone * float(np.sum(off * share * np.asarray(obs.has_phone)[np.asarray(obs.trial)]))
    return total + PAPER_COST.weight_offset_per_m2 * float(np.sum(np.asarray(site_offset_m, np.float64) ** 2))


@functools.partial(jax.jit, static_argnames=("body", "kinds"))
def _marker_costs(
    body: Body,
    kinds: Kinds,
    table: MarkerTable,
    obs: Observations,
    w: MarkerWeights,
    qpos: Float[Array, "F 40"],
    R_nc: Float[Array, "F V 3 3"],
    s: Float[Array, " 8"],
    site_offset_m: Float[Array, "J 3"],
) -> Float[Array, " F"]:
    def one(index: Array) -> Array:
        x = table_positions(body, table, qpos[index], scale_multipliers(s), site_offset_m)
        return marker_cost(x, frames_at(obs, index), R_nc[index], table, w, kinds)

    frames = qpos.shape[0]
    size = next(c for c in (frames, CHUNK, CHUNK * 3 // 4, CHUNK // 2, 1) if frames % c == 0 and c <= CHUNK)
    return jax.lax.map(one, jnp.arange(frames).reshape(-1, size)).reshape(-1)


#: Fields of `Observations` with one row per frame.
PER_FRAME = ("x_cam", "c_3d", "xy_px", "c_2d", "x_world", "c_world", "R_nc", "p_nc", "camera_matrix")


def frames_at(obs: Observations, index: Array) -> Observations:
    """The keypoints and cameras of some frames, by their numbers (M,); other fields are left as they are."""
    take = lambda a: a.at[index].get(mode="promise_in_bounds")  # noqa: E731
    return dataclasses.replace(obs, **{k: take(getattr(obs, k)) for k in PER_FRAME})
