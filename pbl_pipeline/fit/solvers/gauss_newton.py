"""`gauss-newton`: robust least squares over per-frame poses, with everything the session shares in the same system.

Levenberg-Marquardt steps on the exact normal equations (`_normal.py`), solved with their structure (`_arrow.py`).
Deterministic, bounded, compiled once per size of session.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array

from pbl_pipeline.body import SLIDES, Body
from pbl_pipeline.body._jacobian import MarkerTable
from pbl_pipeline.jax_setup import compile_seconds

from .._inputs import Session
from .._marker_cost import Kinds, kinds_of
from .._observations import Observations, power_of_2
from .._outcome import Outcome, outcome
from .._params import GaussNewtonParams
from .._phone_error import phone_variance
from .._place import placed_poses
from .._prior import prior_of
from .._threads import one_blas_thread
from ._arrow import Arrow, marginal_variance, solve
from ._contact import sole_positions, standing
from ._normal import MIXER, State, Weights, cost, dispersion, normal_equations, scale_multipliers
from ._solution import Solution

#: A step of a joint or camera is cut to this (rad; m for slides).
LONGEST_STEP = 0.5
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-2, 1e-7, 1e7


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Progress:
    """Where the iteration stands. `largest_step`: of the last accepted step (rad or m, on frames that count)."""

    state: State
    cost: Array
    damping: Array
    iteration: Array
    largest_step: Array
    #: Accepted steps in a row that gained next to nothing.
    idle: Array
    converged: Array
    trace: Array


#: Space for the cost of each iteration: the bound on their number.
MOST_ITERATIONS = 200


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Limits:
    """When the iteration ends (`GaussNewtonParams`), as data."""

    tolerance_rad: Array
    tolerance_cost: Array
    max_iterations: Array


def minimise(
    body: Body, kinds: Kinds, table: MarkerTable, obs: Observations, w: Weights, start: State, limits: Limits
) -> Progress:
    """Minimise `cost` from `start`."""
    arguments = (body, table, obs, w, kinds)

    def step(p: Progress) -> Progress:
        matrix, g, h = normal_equations(*arguments, p.state)
        dx, dy = solve(_damped(matrix, p.damping), g, h)
        dx = jnp.clip(dx, -LONGEST_STEP, LONGEST_STEP)
        state = _moved(p.state, dx, dy, kinds)
        value = cost(*arguments, state)
        # Single precision: a change below the rounding of the sum is no reason to go back.
        accepted = value <= p.cost * (1 + 1e-6)
        keep = lambda new, old: jnp.where(accepted, new, old)  # noqa: E731
        size = jnp.max(jnp.abs(dx) * obs.weight[:, None])
        damping = jnp.where(accepted, p.damping / 10, p.damping * 10)
        gained = p.cost - value > limits.tolerance_cost * p.cost
        # A step that was refused says nothing of the minimum: the next one is damped more.
        idle = jnp.where(accepted, jnp.where(gained, 0, p.idle + 1), p.idle)
        return Progress(
            state=jax.tree.map(keep, state, p.state),
            cost=keep(value, p.cost),
            damping=jnp.clip(damping, DAMPING_LEAST, DAMPING_MOST),
            iteration=p.iteration + 1,
            largest_step=keep(size, p.largest_step),
            idle=idle,
            converged=(accepted & (size < limits.tolerance_rad)) | (idle >= 2),
            trace=p.trace.at[p.iteration].set(keep(value, p.cost)),
        )

    first = Progress(
        state=start,
        cost=cost(*arguments, start),
        damping=jnp.asarray(DAMPING_START),
        iteration=jnp.asarray(0),
        largest_step=jnp.asarray(jnp.inf),
        idle=jnp.asarray(0),
        converged=jnp.asarray(False),
        trace=jnp.full(MOST_ITERATIONS, jnp.nan),
    )
    most = jnp.minimum(limits.max_iterations, MOST_ITERATIONS)
    return jax.lax.while_loop(lambda p: ~p.converged & (p.iteration < most), step, first)


def _damped(matrix: Arrow, damping: Array) -> Arrow:
    """Marquardt's damping of the frames' unknowns: in units of their own curvature, with a floor for what is unseen."""
    own = jnp.diagonal(matrix.diagonal, axis1=-2, axis2=-1)
    floor = 1e-4 * jnp.max(own, axis=-1, keepdims=True) + 1e-6
    extra = (damping * own + (1e-4 + damping) * floor)[..., None] * jnp.eye(own.shape[-1], dtype=own.dtype)
    corner = jnp.diagonal(matrix.corner)
    more = damping * corner + 1e-6 * jnp.max(corner)
    return dataclasses.replace(matrix, diagonal=matrix.diagonal + extra, corner=matrix.corner + jnp.diag(more))


def _moved(state: State, dx: Array, dy: Array, kinds: Kinds) -> State:
    k = 8 + state.site_offset_m.size
    R_nc, clock = state.R_nc, state.clock_s
    if kinds.moving:
        turn = jaxlie.SO3.exp(dx[:, 40:]).as_matrix()
        R_nc = jnp.einsum("fij,fvjk->fvik", turn, R_nc, precision="highest")
        clock = clock + dy[k : k + clock.size]
        k += clock.size
    return State(
        qpos=state.qpos + dx[:, :40],
        R_nc=R_nc,
        s=state.s + dy[:8],
        site_offset_m=state.site_offset_m + dy[8 : 8 + state.site_offset_m.size].reshape(-1, 3),
        clock_s=clock,
        floor=state.floor + dy[k:].reshape(-1, 3) if kinds.contact else state.floor,
    )


def finish(
    body: Body, kinds: Kinds, table: MarkerTable, obs: Observations, w: Weights, state: State
) -> tuple[Array, Outcome]:
    """Variances (F, 40) of qpos as far as the residuals tell (dispersion times the inverse curvature's diagonal)."""
    matrix, _, _ = normal_equations(body, table, obs, w, kinds, state)
    own = jnp.diagonal(matrix.diagonal, axis1=-2, axis2=-1)
    # What nothing holds gets a variance that is large, not infinite: each joint on its own scale, so that the pelvis'
    # curvature does not make the toes look sure.
    held = matrix.diagonal + jnp.diag(1e-6 * jnp.max(own, axis=0))
    corner = matrix.corner + 1e-6 * jnp.max(jnp.diagonal(matrix.corner)) * jnp.eye(matrix.corner.shape[0])
    variance, _ = marginal_variance(dataclasses.replace(matrix, diagonal=held, corner=corner))
    seen = outcome(body, table, obs, state.qpos, state.R_nc, scale_multipliers(state.s), state.site_offset_m)
    return variance[:, :40] * dispersion(body, table, obs, w, kinds, state), seen


_minimise_one = jax.jit(minimise, static_argnames=("body", "kinds"))
_finish_one = jax.jit(finish, static_argnames=("body", "kinds"))


@functools.partial(jax.jit, static_argnames=("body", "kinds"))
def _minimise_many(body, kinds, table, obs, w, start, limits):
    one = functools.partial(minimise, body, kinds)
    return jax.vmap(one, in_axes=(0, 0, None, 0, None))(table, obs, w, start, limits)


@functools.partial(jax.jit, static_argnames=("body", "kinds"))
def _finish_many(body, kinds, table, obs, w, state):
    return jax.vmap(functools.partial(finish, body, kinds), in_axes=(0, 0, None, 0))(table, obs, w, state)


def solve_gauss_newton(
    sessions: Sequence[Session], params: GaussNewtonParams, starts: Sequence[State]
) -> list[Solution]:
    """Fit sessions that are packed to the same sizes from `start_of` each: one as it is, several at once on the device.

    The result does not depend on which sessions are fitted together. A session whose result is suspicious is solved
    again from a start that faces the other way, and the better one of the two is kept.
    """
    begin, compiled = time.perf_counter(), compile_seconds()
    on_floor = params.weight_floor > 0 or params.weight_slide > 0
    found = _solve(sessions, params, starts, last=not on_floor)
    again = [i for i, s in enumerate(found) if suspicious(sessions[i], s)]
    if again:
        part = [sessions[i] for i in again]
        turned = _solve(part, params, [start_of(s, flip=True) for s in part], last=not on_floor)
        for i, other in zip(again, turned, strict=True):
            if other.loss_trace[-1, 1] < found[i].loss_trace[-1, 1]:
                found[i] = other
    if on_floor:
        standing_sessions, starts = zip(*map(_on_floor, sessions, found), strict=True)
        found = list(map(_after, found, _solve(standing_sessions, params, starts, last=True, contact=True)))
    seconds = (time.perf_counter() - begin) / len(sessions)
    compiled = (compile_seconds() - compiled) / len(sessions)
    return [dataclasses.replace(s, seconds=seconds, compile_seconds=compiled) for s in found]


def _solve(
    sessions: Sequence[Session], params: GaussNewtonParams, starts: Sequence[State], last: bool, contact: bool = False
) -> list[Solution]:
    """Solutions from given starts; standard deviations and outcome only of the `last` ones."""
    body, kinds = sessions[0].body, dataclasses.replace(kinds_of(sessions[0]), contact=contact)
    w, limits = weights_of(sessions[0], params), limits_of(params)
    given = [(s.table, s.obs, start) for s, start in zip(sessions, starts, strict=True)]
    alone = len(given) == 1
    if not alone:
        # The last one stands in for those that are missing, so that a worker compiles a program for few sizes.
        given += [given[-1]] * (power_of_2(len(given)) - len(given))
    # Stacked on the host, so that each array goes to the device once.
    table, obs, start = jax.device_put(given[0] if alone else jax.tree.map(lambda *a: np.stack(a), *given))
    minimise_, finish_ = (_minimise_one, _finish_one) if alone else (_minimise_many, _finish_many)
    with one_blas_thread():
        progress = minimise_(body, kinds, table, obs, w, start, limits)
        ends = finish_(body, kinds, table, obs, w, progress.state) if last else ()
        found = jax.device_get((progress, *ends))
    each = [found] if alone else [jax.tree.map(lambda a, i=i: a[i], found) for i in range(len(sessions))]
    names = sessions[0].body.joint_names
    sd = by_joint(names, params.sd_factor, 1.0), floors_of(names, params.sd_floor)
    return [_solution(s, *sd, *one) for s, one in zip(sessions, each, strict=True)]


def _after(first: Solution, second: Solution) -> Solution:
    """The second solution with the iterations of both; the cost of the second has a term more."""
    steps = second.loss_trace + np.array([first.iterations, 0.0])
    trace = np.concatenate([first.loss_trace, steps])
    return dataclasses.replace(second, loss_trace=trace, iterations=first.iterations + second.iterations)


def _on_floor(session: Session, found: Solution) -> tuple[Session, State]:
    """The session with the frames in which feet stand, as a solution shows them, and that solution to start from."""
    obs, f32 = session.obs, functools.partial(np.asarray, dtype=np.float32)
    x = np.asarray(sole_positions(session.body, f32(found.qpos), f32(found.scale)))
    contact, floor = np.zeros(obs.contact.shape, np.float32), np.zeros((obs.has_phone.shape[0], 3), np.float32)
    for i, arrays in enumerate(session.arrays):
        first, last = np.flatnonzero(arrays.used)[[0, -1]]  # frames beside them stay where they started
        at = slice(session.frames(i).start + first, session.frames(i).start + last + 1)
        contact[at] = standing(arrays.time_s[first : last + 1], x[at]) * arrays.used[first : last + 1, None]
        floor[i, 0] = np.average(x[at][..., 2], weights=contact[at] + 1e-9)
    values: dict[str, Any] = {
        "qpos": f32(found.qpos),
        "R_nc": f32(found.R_nc),
        "s": f32(found.s),
        "site_offset_m": f32(_padded(found.site_offset_m, obs.c_world.shape[1])),
        "clock_s": f32(_padded(found.clock_s, len(floor))),
        "floor": floor,
    }
    seen: Any = contact
    return dataclasses.replace(session, obs=dataclasses.replace(obs, contact=seen)), State(**values)


def _padded(a: np.ndarray, n: int) -> np.ndarray:
    return np.pad(a, [(0, n - len(a)), *[(0, 0)] * (a.ndim - 1)])


def _solution(
    session: Session,
    factor: np.ndarray,
    floor: np.ndarray,
    p: Progress,
    variance: np.ndarray | None = None,
    seen: Outcome | None = None,
) -> Solution:
    n = int(p.iteration)
    trace = np.stack([np.arange(1, n + 1), np.asarray(p.trace)[:n]], axis=1).astype(np.float64)
    qpos, sd = np.asarray(p.state.qpos, np.float64), None
    if variance is not None:
        # The phone's share was in the recordings on which the factors were found, so they are of both.
        sd = np.sqrt((np.maximum(variance, 0.0) + phone_variance(session, qpos)) * factor**2 + floor**2)
    return Solution(
        qpos=qpos,
        R_nc=np.asarray(p.state.R_nc, np.float64),
        s=np.asarray(p.state.s, np.float64),
        scale=1.0 + MIXER @ np.asarray(p.state.s, np.float64),
        site_offset_m=np.asarray(p.state.site_offset_m, np.float64)[: len(session.markers)],
        clock_s=np.asarray(p.state.clock_s, np.float64)[: len(session.arrays)],
        loss_trace=trace,
        compile_seconds=0.0,
        seconds=0.0,
        iterations=n,
        converged=bool(p.converged),
        qpos_sd=sd,
        outcome=seen,
    )


def limits_of(params: GaussNewtonParams) -> Limits:
    """When to end, on the device."""
    return Limits(
        jnp.asarray(params.tolerance_rad, jnp.float32),
        jnp.asarray(params.tolerance_cost, jnp.float32),
        jnp.asarray(params.max_iterations, jnp.int32),
    )


def weights_of(session: Session, params: GaussNewtonParams) -> Weights:
    """The paramset's numbers on the device."""
    names, c = session.body.joint_names, params.cost
    low, high = np.asarray(session.body.joint_range_rad).T
    slide = np.array([n in SLIDES for n in names])
    neutral, inverse_sd = prior_of(names, c.pose_prior_deg)
    values = {
        "weight_3d": c.weight_3d,
        "weight_2d": c.weight_2d,
        "weight_phone": c.weight_phone,
        "weight_offset_per_m2": c.weight_offset_per_m2,
        "depth_ratio": c.depth_ratio,
        "huber_3d_cm": c.huber_3d_cm,
        "huber_2d_px": c.huber_2d_px,
        "huber_phone_deg": params.huber_phone_deg,
        "weight_limit": params.weight_limit_per_deg2,
        "weight_pose": c.weight_pose,
        "weight_scale": c.weight_scale,
        "scale_sd": c.scale_sd,
        "scale_sides_sd": c.scale_sides_sd,
        "weight_size": PIXELS_WEIGHT_SIZE if _pixels_alone(session) else 0.0,
        "clock_sd_s": params.clock_sd_s,
        "weight_floor": params.weight_floor,
        "weight_slide": params.weight_slide,
        "huber_floor_cm": params.huber_floor_cm,
        "huber_slide_cm": params.huber_slide_cm,
        "slope_sd": np.deg2rad(params.slope_sd_deg),
        "neutral": neutral,
        "inverse_sd": inverse_sd,
        "smooth": np.where(slide, params.smooth_per_m2, params.smooth_per_rad2),
        "low": low,
        "high": high,
    }
    return Weights(**{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})


#: One camera without 3D points cannot tell a small person from a far one: half this times the squared overall scale
#: parameter, an adult's standard deviation of 0.05 counted as the other priors are.
PIXELS_WEIGHT_SIZE = 0.1 / 0.05**2


def _pixels_alone(session: Session) -> bool:
    kinds = kinds_of(session)
    return not (kinds.camera_3d or kinds.world) and session.obs.c_2d.shape[1] == 1


def start_of(session: Session, flip: bool = False) -> State:
    """The standing body placed by the keypoints, unscaled."""
    obs = session.obs
    qpos = np.concatenate([placed_poses(session, i, flip) for i in range(len(session.arrays))])
    qpos = np.pad(qpos, [(0, obs.weight.shape[0] - len(qpos)), (0, 0)], mode="edge")
    zeros = functools.partial(np.zeros, dtype=np.float32)
    values: dict[str, Any] = {
        "qpos": np.asarray(qpos, np.float32),
        "R_nc": obs.R_nc,
        "s": zeros(8),
        "site_offset_m": zeros((obs.c_world.shape[1], 3)),
        "clock_s": zeros(obs.has_phone.shape[0]),
        "floor": zeros((obs.has_phone.shape[0], 3)),
    }
    return State(**values)


def by_joint(joint_names: Sequence[str], values: Sequence[tuple[str, float]], other: float) -> np.ndarray:
    """(40,) values; a name stands for every joint that begins with it, later ones win, `other` where none does."""
    out = np.full(len(joint_names), other)
    for prefix, value in values:
        out[[n.startswith(prefix) for n in joint_names]] = value
    return out


def floors_of(joint_names: Sequence[str], sd_floor: Sequence[tuple[str, float]]) -> np.ndarray:
    """(40,) least standard deviations in rad and m, from degrees and (slides) centimetres."""
    slides = np.array([n in SLIDES for n in joint_names])
    return by_joint(joint_names, sd_floor, 0.0) * np.where(slides, 0.01, np.deg2rad(1.0))


#: Knees at their straight end in more than this share of the frames may belong to a body that faces the wrong way.
BACKWARDS_SHARE = 0.2


def suspicious(session: Session, solution: Solution) -> bool:
    """Whether the body may face the wrong way: pixels alone do not tell, and knees then stay at their straight end."""
    if _pixels_alone(session):
        return True
    used = np.asarray(session.obs.weight) > 0
    high = np.asarray(session.body.joint_range_rad)[:, 1]
    share = []
    for name in ("knee_angle_r", "knee_angle_l"):
        i = session.body.joint_names.index(name)
        share.append(np.mean(solution.qpos[used, i] > high[i] - np.deg2rad(1.0)))
    return bool(np.mean(share) > BACKWARDS_SHARE)
