"""Levenberg-Marquardt steps on a bordered banded system, inside one compiled loop. Knows residuals' curvature, nothing
of bodies.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .linear import BorderedBandedSystem, solve
from .result import Result

#: A step of a frame's unknown is cut to this.
LONGEST_STEP = 0.5
#: Damping of the first step, the least at all and after a step that was refused (less changes no step), and the most.
DAMPING_START, DAMPING_LEAST, DAMPING_REFUSED, DAMPING_MOST = 1e-2, 1e-7, 1e-3, 1e7
#: Where no unknown of a frame moves further than `NEAR`, the step is as many Gauss-Newton steps long as a secant
#: estimates, within these bounds: weak directions creep, or oscillate, by a fixed share of the remaining way.
NEAR, SHORTEST, LONGEST = 0.2, 0.4, 2.5
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
    """End of the iteration, as data: after a step in which no unknown of a frame moved further than `step`, or three
    in a row whose gain was below the fraction `gain` of the cost, or `iterations` steps.
    """

    step: Float[Array, ""]
    gain: Float[Array, ""]
    iterations: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Progress:
    """State of the iteration: the best state with its cost and quadratic model (`latest`), and the state to try
    next. trace: the cost after each iteration.
    """

    state: Any
    cost: Array
    latest: Any
    candidate: Any
    #: The Gauss-Newton step (F, Q) and (K,) from the state, how many times it the candidate lies away, and how steeply
    #: the cost falls along it.
    direction: tuple[Array, Array]
    length: Array
    slope: Array
    #: Longest step of a frame's unknown in that direction.
    step: Array
    damping: Array
    #: Candidates tried, the start not counted (-1 before it was evaluated).
    iteration: Array
    #: Accepted steps in a row that gained next to nothing.
    idle: Array
    #: A `Result`.
    result: Array
    trace: Array


@dataclasses.dataclass(frozen=True)
class LevenbergMarquardt(Generic[S]):
    """The iteration as its `init`, `step` and `terminate`, which `iterate` repeats."""

    #: Cost and its quadratic model at a state.
    evaluate: Callable[[S], Quadratic]
    #: The state after a step (F, Q) of the frames' unknowns and (K,) of the shared ones.
    move: Callable[[S, Array, Array], S]
    #: (F,) 0 for frames whose step does not count for convergence.
    counts: Float[Array, " F"]

    def init(self, start: S) -> Progress:
        """`Progress` in which nothing is evaluated yet."""
        shapes = jax.eval_shape(self.evaluate, start)
        return Progress(
            state=start,
            cost=jnp.asarray(jnp.inf, jnp.float32),
            latest=jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes),
            candidate=start,
            direction=(jnp.zeros(shapes.g.shape, shapes.g.dtype), jnp.zeros(shapes.h.shape, shapes.h.dtype)),
            length=jnp.asarray(1.0, jnp.float32),
            slope=jnp.asarray(jnp.inf, jnp.float32),
            step=jnp.asarray(jnp.inf, jnp.float32),
            damping=jnp.asarray(DAMPING_START, jnp.float32),
            iteration=jnp.asarray(-1, jnp.int32),
            idle=jnp.asarray(0, jnp.int32),
            result=jnp.asarray(Result.MAX_STEPS_REACHED, jnp.int32),
            trace=jnp.full(MOST_ITERATIONS, jnp.nan, jnp.float32),
        )

    def step(self, p: Progress, limits: Limits) -> Progress:
        """Evaluate the candidate, keep it if the cost has not grown, and choose the next; after the end nothing.

        Each evaluates one state: a second copy of that program, for the start or for the cost alone, would double the
        time it takes to compile.
        """
        now, first, on = self.evaluate(p.candidate), p.iteration < 0, ~terminate(p, limits)
        # Single precision: a change below the rounding of the sum does not refuse a step.
        accepted = on & (now.cost <= p.cost * (1 + 1e-6))
        better = accepted & ~first
        keep = lambda new, old: jnp.where(accepted, new, old)  # noqa: E731
        state, latest, cost = jax.tree.map(keep, (p.candidate, now, now.cost), (p.state, p.latest, p.cost))
        damping = jnp.where(first, p.damping, jnp.where(accepted, p.damping / 10, p.damping * 10))
        damping = jnp.clip(damping, jnp.where(accepted, DAMPING_LEAST, DAMPING_REFUSED), DAMPING_MOST)
        gained = p.cost - now.cost > limits.gain * p.cost
        # A refused step is not evidence of a minimum: the next one is damped more.
        idle = jnp.where(better, jnp.where(gained, 0, p.idle + 1), p.idle)
        result = jnp.where(idle >= 3, Result.SMALL_GAIN, Result.MAX_STEPS_REACHED)
        result = jnp.where(better & (p.step < limits.step), Result.SMALL_STEP, result)
        dx, dy = solve(_damped(latest.system, damping), latest.g, latest.h)
        dx = jnp.clip(dx, -LONGEST_STEP, LONGEST_STEP)
        longest = jnp.max(jnp.abs(dx) * self.counts[:, None])
        # The length at which the slope along the last direction would have been 0.
        secant = p.length / jnp.maximum(1 - _slope(latest, *p.direction) / p.slope, 1e-3)
        near = better & (jnp.maximum(p.step, longest) < NEAR)
        length = jnp.where(near, jnp.clip(secant, SHORTEST, LONGEST), 1.0)
        after = Progress(
            state=state,
            cost=cost,
            latest=None,
            candidate=self.move(state, length * dx, length * dy),
            direction=(dx, dy),
            length=length,
            slope=_slope(latest, dx, dy),
            step=longest,
            damping=damping,
            iteration=p.iteration + 1,
            idle=idle,
            result=result.astype(jnp.int32),
            trace=p.trace.at[jnp.where(first, MOST_ITERATIONS, p.iteration)].set(cost, mode="drop"),
        )
        # `latest`, which is large, was chosen above.
        after = jax.tree.map(lambda new, old: jnp.where(on, new, old), after, dataclasses.replace(p, latest=None))
        return dataclasses.replace(after, latest=latest)

    def iterate(self, begin: Progress, limits: Limits, steps: Any = None) -> Progress:
        """Minimise the cost, from `init` or from where a call with fewer iterations ended: both ways take the same
        steps.

        `steps`: for many problems side by side (`vmap`): so many steps, in which one that has ended stays as it is. A
        loop that ends for each at another step would copy all of `latest` once more in each.
        """
        if steps is not None:
            return jax.lax.fori_loop(0, steps, lambda _, p: self.step(p, limits), begin)
        return jax.lax.while_loop(lambda p: ~terminate(p, limits), lambda p: self.step(p, limits), begin)


def terminate(p: Progress, limits: Limits) -> Array:
    """True where the iteration has ended."""
    return (p.result != Result.MAX_STEPS_REACHED) | (p.iteration >= jnp.minimum(limits.iterations, MOST_ITERATIONS))


def _slope(at: Quadratic, dx: Float[Array, "F Q"], dy: Float[Array, " K"]) -> Float[Array, ""]:
    """Slope of the cost along a step, positive where it falls."""
    return jnp.sum(at.g * dx) + jnp.sum(at.h * dy)


def _damped(system: BorderedBandedSystem, damping: Array) -> BorderedBandedSystem:
    """Marquardt's damping of the frames' unknowns: in units of their curvature, with a floor for unobserved ones."""
    own = jnp.diagonal(system.diagonal, axis1=-2, axis2=-1)
    floor = 1e-4 * jnp.max(own, axis=-1, keepdims=True) + 1e-6
    extra = (damping * own + (1e-4 + damping) * floor)[..., None] * jnp.eye(own.shape[-1], dtype=own.dtype)
    corner = jnp.diagonal(system.corner)
    more = damping * corner + 1e-6 * jnp.max(corner)
    return dataclasses.replace(system, diagonal=system.diagonal + extra, corner=system.corner + jnp.diag(more))
