"""Feet on the floor: in stance a sole stays where it is, and all stances of a trial lie in one plane.

To one camera a foot's distance is the least certain of its coordinates, and both rules tell it: a foot that stands may
not drift along the line of sight, and on a floor of one height its row in the picture is its distance. The plane may
be tilted against the world, because a camera without a log is only assumed to be level.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable, marker_jacobian, table_positions

from .. import _costs as costs
from .._observations import FRAME_S, SOLE_POINTS, Observations

#: Points of the soles: heel and ball of the right foot, then of the left (body; m in its frame), under the lowest
#: places of the body's capsules there.
SOLE = tuple((f"calcn_{side}", place) for side in ("r", "l") for place in ((0.015, -0.015, 0.0), (0.175, -0.016, 0.0)))
#: Cost of a floor's slope one standard deviation from level: that of a marker 3 px off in one frame.
SLOPE_COST = 0.03
#: A point that stands is slower than this share of its own fastest, or than this (m/s); speeds are means over some time
#: (s, standard deviation).
STANDING_SHARE, STANDING_M_PER_S, STANDING_S = 0.25, 0.2, 0.03


def sole_table(body: Body) -> MarkerTable:
    """The points of the soles as a marker table."""
    ones = np.ones(SOLE_POINTS, np.float32)
    index = np.array([body.body_names.index(n) for n, _ in SOLE], np.int32)
    return MarkerTable(index, np.array([p for _, p in SOLE], np.float32), ones, ones)  # pyright: ignore[reportArgumentType]


@functools.partial(jax.jit, static_argnames="body")
def sole_positions(body: Body, qpos: Float[Array, "F 40"], scale: Float[Array, " 8"]) -> Float[Array, "F 4 3"]:
    """Points of the soles in the world (m)."""
    return table_positions(body, sole_table(body), qpos, scale, jnp.zeros((SOLE_POINTS, 3)))


def standing(time_s: Float[np.ndarray, " T"], x: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T S"]:
    """How surely (0 to 1) each point of the soles stands: one half where it is just slow enough."""
    smooth = gaussian_filter1d(x, STANDING_S / np.median(np.diff(time_s)), axis=0, mode="nearest")
    speed = np.linalg.norm(np.gradient(smooth, time_s, axis=0), axis=-1)
    limit = np.maximum(STANDING_SHARE * np.percentile(speed, 95, axis=0), STANDING_M_PER_S)
    return 1 / (1 + np.exp(np.minimum((speed / limit - 1) / 0.15, 50.0)))


def contact_cost(body: Body, obs: Observations, w, scale: Array, state) -> Float[Array, " F"]:
    """Cost of the soles in each frame; `w`, `state`: of the solver."""
    x = sole_positions(body, state.qpos, scale)
    height, _ = _height_cm(x, obs, state.floor)
    way, _, share = _way_cm(x, obs)
    cost = w.weight_floor * jnp.sum(obs.contact * costs.huber_of_square(height**2, w.huber_floor_cm), axis=-1)
    slid = costs.huber_of_square(jnp.sum(way**2, axis=-1), w.huber_slide_cm)
    return cost + w.weight_slide * jnp.sum(share * slid, axis=-1)


def floor_cost(floor: Float[Array, "N 3"], slope_sd: Array) -> Float[Array, ""]:
    """Prior of the floors: nearly level. Their height is free (held near 0 where nobody stands)."""
    return 0.5 * jnp.sum(_floor_curvature(floor.shape[0], slope_sd) * floor.reshape(-1) ** 2)


def contact_terms(body: Body, obs: Observations, w, scale: Array, mixer: Array, state):
    """What the soles add to the normal equations, shared unknowns being s (8) and the floors (3 N): blocks (F, 40, 40)
    of each frame and (F, 40, 40) with the next one, borders (F, 40, 8 + 3 N), corner, and the gradients of both."""
    jac = marker_jacobian(body, sole_table(body), state.qpos, scale, jnp.zeros((SOLE_POINTS, 3)))
    x, by_q, by_s = jac.x_world_m, jac.per_qpos, jac.per_scale @ mixer
    n, count = state.floor.shape[0], obs.weight[:, None]
    q = by_q.shape[-1]

    height, up = _height_cm(x, obs, state.floor)
    by_floor = -100 * jnp.concatenate([jnp.ones_like(x[..., :1]), x[..., :2]], axis=-1)
    by_floor = by_floor[:, :, None] * jax.nn.one_hot(obs.trial, n)[:, None, :, None]
    tilted = lambda by: jnp.einsum("fi,fpia->fpa", up, by)  # noqa: E731
    by_all = jnp.concatenate([tilted(by_q), tilted(by_s), by_floor.reshape(*height.shape, 3 * n)], axis=-1)
    c = count * obs.contact * w.weight_floor * costs.huber_weight(height**2, w.huber_floor_cm)
    both = jnp.einsum("fpa,fp,fpb->fab", by_all, c, by_all)
    pull = jnp.einsum("fpa,fp->fa", by_all, c * height)

    way, rate, share = _way_cm(x, obs)
    c = count * share * w.weight_slide * costs.huber_weight(jnp.sum(way**2, axis=-1), w.huber_slide_cm)
    rate = rate[:, None, None, None]
    here, there, shared = -rate * by_q, rate * _later(by_q), rate * (_later(by_s) - by_s)
    gram = lambda a, b: jnp.einsum("fpia,fp,fpib->fab", a, c, b)  # noqa: E731
    force = lambda a: jnp.einsum("fpia,fp,fpi->fa", a, c, way)  # noqa: E731
    H = both[:, :q, :q] + gram(here, here) + _earlier(gram(there, there))
    B = both[:, :q, q:].at[..., :8].add(gram(here, shared) + _earlier(gram(there, shared)))
    g = pull[:, :q] + force(here) + _earlier(force(there))
    curvature = _floor_curvature(n, w.slope_sd)
    C = jnp.sum(both[:, q:, q:], axis=0).at[:8, :8].add(jnp.sum(gram(shared, shared), axis=0))
    C = C + jnp.diag(jnp.concatenate([jnp.zeros(8, C.dtype), curvature]))
    h = jnp.sum(pull[:, q:], axis=0).at[:8].add(jnp.sum(force(shared), axis=0))
    h = h.at[8:].add(curvature * state.floor.reshape(-1))
    return H, gram(here, there), B, C, g, h


def _height_cm(x: Array, obs: Observations, floor: Float[Array, "N 3"]) -> tuple[Array, Array]:
    """Heights (F, 4) over the floor in cm and their gradient (F, 3) by position in m."""
    own = floor[obs.trial]
    up = jnp.concatenate([-own[:, 1:], jnp.ones_like(own[:, :1])], axis=-1)
    # Summed, not multiplied as matrices: a GPU would round those to three digits.
    return 100 * (jnp.sum(x * up[:, None], axis=-1) - own[:, :1]), 100 * up


def _way_cm(x: Array, obs: Observations) -> tuple[Array, Array, Array]:
    """Way (F, 4, 3) of each point to the next frame in cm per 1/30 s, its derivative (F,) by that in m, and the share
    (F, 4) with which it counts."""
    dt = _later(obs.time_s) - obs.time_s
    together = (obs.trial == _later(obs.trial)) & (dt > 0)
    rate = jnp.where(together, 100 * FRAME_S / jnp.where(together, dt, 1.0), 0.0)
    share = obs.contact * _later(obs.contact) * (together * _later(obs.weight))[:, None]
    return rate[:, None, None] * (_later(x) - x), rate, share


def _floor_curvature(n: int, slope_sd: Array) -> Float[Array, " K"]:
    slope = SLOPE_COST / slope_sd**2
    return jnp.tile(jnp.stack([jnp.full_like(slope, 1e-6), slope, slope]), n)


def _later(a: Array) -> Array:
    """Each row's successor; the last one is its own."""
    return jnp.concatenate([a[1:], a[-1:]])


def _earlier(a: Array) -> Array:
    """Each row's predecessor, zeros before the first."""
    return jnp.concatenate([jnp.zeros_like(a[:1]), a[:-1]])
