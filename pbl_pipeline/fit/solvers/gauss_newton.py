"""`gauss-newton`: robust least squares over per-frame poses, with everything the session shares in the same system.

Levenberg-Marquardt steps on the exact normal equations (`_normal.py`), solved with their structure (`_arrow.py`).
Deterministic, bounded, compiled once per size of session.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array

from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable

from .._observations import Observations
from ._arrow import Arrow, solve
from ._normal import Kinds, State, Weights, cost, normal_equations

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
    converged: Array
    trace: Array


@functools.partial(jax.jit, static_argnames=("body", "kinds", "max_iterations"))
def iterate(
    body: Body,
    table: MarkerTable,
    obs: Observations,
    w: Weights,
    kinds: Kinds,
    start: State,
    tolerance: Array,
    max_iterations: int,
) -> Progress:
    """Minimise `cost` from `start`; at most `max_iterations` steps, fewer once a step is below `tolerance`."""
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
        return Progress(
            state=jax.tree.map(keep, state, p.state),
            cost=keep(value, p.cost),
            damping=jnp.clip(damping, DAMPING_LEAST, DAMPING_MOST),
            iteration=p.iteration + 1,
            largest_step=keep(size, p.largest_step),
            converged=(accepted & (size < tolerance)) | (p.damping >= DAMPING_MOST),
            trace=p.trace.at[p.iteration].set(keep(value, p.cost)),
        )

    first = Progress(
        state=start,
        cost=cost(*arguments, start),
        damping=jnp.asarray(DAMPING_START),
        iteration=jnp.asarray(0),
        largest_step=jnp.asarray(jnp.inf),
        converged=jnp.asarray(False),
        trace=jnp.full(max_iterations, jnp.nan),
    )
    return jax.lax.while_loop(lambda p: ~p.converged & (p.iteration < max_iterations), step, first)


def _damped(matrix: Arrow, damping: Array) -> Arrow:
    """Marquardt's damping of the frames' unknowns: in units of their own curvature, with a floor for what is unseen."""
    own = jnp.diagonal(matrix.diagonal, axis1=-2, axis2=-1)
    floor = 1e-4 * jnp.max(own, axis=-1, keepdims=True) + 1e-6
    extra = (damping * own + (1e-4 + damping) * floor)[..., None] * jnp.eye(own.shape[-1], dtype=own.dtype)
    corner = jnp.diagonal(matrix.corner)
    more = damping * corner + 1e-6 * jnp.max(corner)
    return dataclasses.replace(
        matrix, diagonal=matrix.diagonal + extra, corner=matrix.corner + jnp.diag(more)
    )


def _moved(state: State, dx: Array, dy: Array, kinds: Kinds) -> State:
    k = 8 + state.site_offset_m.size
    R_nc, clock = state.R_nc, state.clock_s
    if kinds.moving:
        turn = jaxlie.SO3.exp(dx[:, 40:]).as_matrix()
        R_nc = jnp.einsum("fij,fvjk->fvik", turn, R_nc, precision="highest")
        clock = clock + dy[k:]
    return State(
        qpos=state.qpos + dx[:, :40],
        R_nc=R_nc,
        s=state.s + dy[:8],
        site_offset_m=state.site_offset_m + dy[8:k].reshape(-1, 3),
        clock_s=clock,
    )
