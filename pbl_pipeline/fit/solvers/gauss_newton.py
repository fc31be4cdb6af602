"""Levenberg-Marquardt steps on a bordered banded system, inside one compiled loop. Knows residuals' curvature, nothing
of bodies.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .linear import BorderedBandedSystem, solve

#: A step of a frame's unknown is cut to this.
LONGEST_STEP = 0.5
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-2, 1e-7, 1e7
#: Space for the cost of each iteration: the bound on their number.
MOST_ITERATIONS = 200

S = TypeVar("S")


class Quadratic(Protocol):
    """A cost at a state with its curvature (`system`) and negative gradient (`g` (F, Q) and `h` (K,) of the shared
    unknowns)."""

    @property
    def cost(self) -> Array: ...
    @property
    def system(self) -> BorderedBandedSystem: ...
    @property
    def g(self) -> Array: ...
    @property
    def h(self) -> Array: ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Limits:
    """When the iteration ends, as data: after a step in which no unknown of a frame moved further than `step`, or two
    in a row whose gain was below the fraction `gain` of the cost, or `iterations` steps.
    """

    step: Float[Array, ""]
    gain: Float[Array, ""]
    iterations: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Progress:
    """Where the iteration stands: the best state with its cost, and `latest`, what was evaluated last, which is at that
    state when the loop ends. trace: the cost after each iteration."""

    state: Any
    cost: Array
    latest: Any
    candidate: Any
    #: The candidate is the state itself, evaluated again because the step from it was refused.
    again: Array
    #: Longest step of an unknown from the state to the candidate.
    step: Array
    damping: Array
    iteration: Array
    #: Accepted steps in a row that gained next to nothing.
    idle: Array
    converged: Array
    trace: Array


def minimise(
    evaluate: Callable[[S], Quadratic],
    move: Callable[[S, Array, Array], S],
    start: S,
    counts: Float[Array, " F"],
    limits: Limits,
) -> Progress:
    """Minimise a cost from `start`.

    `evaluate`: cost and its quadratic model at a state; `move`: the state after a step (F, Q) of the frames' unknowns
    and (K,) of the shared ones; `counts`: 0 for frames whose step says nothing of convergence.
    Each pass of the loop evaluates one state: a second copy of that program, for the start or for the cost alone, would
    double the time it takes to compile.
    """

    def step(p: Progress) -> Progress:
        now = evaluate(p.candidate)
        # Single precision: a change below the rounding of the sum is no reason to go back.
        better = ~p.again & (now.cost <= p.cost * (1 + 1e-6))
        stands = better | p.again
        keep = lambda new, old: jnp.where(stands, new, old)  # noqa: E731
        state, cost = jax.tree.map(keep, p.candidate, p.state), keep(now.cost, p.cost)
        damping = jnp.where(p.again, p.damping, jnp.where(better, p.damping / 10, p.damping * 10))
        damping = jnp.clip(damping, DAMPING_LEAST, DAMPING_MOST)
        gained = p.cost - now.cost > limits.gain * p.cost
        # A step that was refused says nothing of the minimum: the next one is damped more.
        idle = jnp.where(better, jnp.where(gained, 0, p.idle + 1), p.idle)
        dx, dy = solve(_damped(now.system, damping), now.g, now.h)
        dx = jnp.clip(dx, -LONGEST_STEP, LONGEST_STEP)
        following = jax.tree.map(lambda new, old: jnp.where(stands, new, old), move(state, dx, dy), state)
        return Progress(
            state=state,
            cost=cost,
            latest=now,
            candidate=following,
            again=~stands,
            step=jnp.max(jnp.abs(dx) * counts[:, None]),
            damping=damping,
            iteration=p.iteration + ~p.again,
            idle=idle,
            converged=(better & (p.step < limits.step)) | (idle >= 2),
            trace=p.trace.at[jnp.where(p.again, MOST_ITERATIONS, p.iteration)].set(cost, mode="drop"),
        )

    shapes = jax.eval_shape(evaluate, start)
    first = Progress(
        state=start,
        cost=jnp.asarray(jnp.inf),
        latest=jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes),
        candidate=start,
        again=jnp.asarray(True),
        step=jnp.asarray(jnp.inf),
        damping=jnp.asarray(DAMPING_START),
        iteration=jnp.asarray(0),
        idle=jnp.asarray(0),
        converged=jnp.asarray(False),
        trace=jnp.full(MOST_ITERATIONS, jnp.nan),
    )
    most = jnp.minimum(limits.iterations, MOST_ITERATIONS)
    # `again` also ends the loop at an evaluated state: at the start, and after a last step that was refused.
    return jax.lax.while_loop(lambda p: ~p.converged & ((p.iteration < most) | p.again), step, first)


def _damped(system: BorderedBandedSystem, damping: Array) -> BorderedBandedSystem:
    """Marquardt's damping of the frames' unknowns: in units of their own curvature, with a floor for what is unseen."""
    own = jnp.diagonal(system.diagonal, axis1=-2, axis2=-1)
    floor = 1e-4 * jnp.max(own, axis=-1, keepdims=True) + 1e-6
    extra = (damping * own + (1e-4 + damping) * floor)[..., None] * jnp.eye(own.shape[-1], dtype=own.dtype)
    corner = jnp.diagonal(system.corner)
    more = damping * corner + 1e-6 * jnp.max(corner)
    return dataclasses.replace(system, diagonal=system.diagonal + extra, corner=system.corner + jnp.diag(more))
