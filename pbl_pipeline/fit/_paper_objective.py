"""The paper's total over a session, by which solvers are compared whatever they minimise themselves.

The paper, section Model Fitting, on every frame that counts.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable, table_positions

from ._inputs import Session
from ._marker_cost import Kinds, MarkerWeights, frames_at, kinds_of, marker_cost
from ._observations import Observations
from ._params import CostParams
from .solvers._normal import scale_multipliers

#: Frames whose markers are compared at once: bounds the memory of long sessions.
CHUNK = 1024


#: The paper's own (section Total loss and optimization), whatever the defaults of `CostParams` become.
PAPER_COST = CostParams(
    weight_3d=1.0, weight_2d=0.1, weight_phone=1.0, weight_offset_per_m2=100.0, huber_3d_cm=10.0, huber_2d_px=5.0
)


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
