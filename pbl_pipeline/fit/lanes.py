"""The compiled solve of one problem, and of many side by side on a GPU, each for as long as it takes.

Problems differ in how many iterations they need (8 to 43 of 256 walks), and a batch that is solved together waits for
its slowest. So a program has lanes: after every few iterations those that have ended make room for the next.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body

from .normal_equations import Linearised, linearise, moved
from .problem import Problem, State, power_of_2
from .solution import Outcome, outcome
from .solvers.gauss_newton import MOST_ITERATIONS, Limits, Progress, before_first, minimise
from .solvers.linear import marginal_variance
from .solvers.result import Result
from .weights import Weights

#: Lanes of a program: enough to fill a GPU, where an iteration takes longer with each lane from 16 on; and of the one
#: for few problems, which the last ones move to. No others: each takes most of a minute to compile.
LANES, FEW = 32, 8
#: Most frames of all lanes together, which bounds the memory.
MOST_FRAMES = 32768
#: Most problems held on the device for each lane; their number is padded to a power of 2, for few programs.
HELD = 4
#: Iterations between two looks at which have ended: a lane that has ended idles until the next one.
ROUND = 2

#: Problems and where each stands.
_Lanes = tuple[Problem, Progress]


@dataclasses.dataclass(frozen=True)
class Found:
    """End of an iteration, on the host; with the points there or, for the last one, the variances (F, U) of the frames'
    unknowns and the outcome."""

    end: Progress
    x: np.ndarray | None  # (F, P, 3)
    variance: np.ndarray | None = None
    outcome: Outcome | None = None

    @property
    def trace(self) -> np.ndarray:
        """(K, 2): iteration and cost after it."""
        n = int(self.end.iteration)
        return np.stack([np.arange(1, n + 1), np.asarray(self.end.trace)[:n]], axis=1).astype(np.float64)


def begin_of(body: Body, p: Problem, w: Weights, start: State) -> Progress:
    """State in which `fit_problem` begins."""
    return before_first(lambda state: linearise(body, p, w, state), start)


def fit_problem(body: Body, p: Problem, w: Weights, begin: Progress, limits: Limits) -> Progress:
    """Minimise the total of `objective.py` over per-frame poses, from `begin_of` or where it ended before."""
    return minimise(lambda state: linearise(body, p, w, state), moved, begin, p.weight, limits)


def finish(p: Problem, latest: Linearised, R_nc: Array) -> tuple[Float[Array, "F U"], Outcome]:
    """Variances of the frames' unknowns by the residuals (dispersion times the inverse curvature's diagonal), and the
    outcome."""
    system = latest.system
    own = jnp.diagonal(system.diagonal, axis1=-2, axis2=-1)
    # An unknown that no residual holds gets a variance that is large, not infinite: each joint on its own scale, so
    # that the pelvis' curvature does not make the toes look sure.
    held = system.diagonal + jnp.diag(1e-6 * jnp.max(own, axis=0))
    corner = system.corner + 1e-6 * jnp.max(jnp.diagonal(system.corner)) * jnp.eye(system.corner.shape[0])
    variance, _ = marginal_variance(dataclasses.replace(system, diagonal=held, corner=corner))
    return variance * latest.dispersion, outcome(p, latest.x, R_nc)


begin_one = jax.jit(begin_of, static_argnames="body")
fit_one = jax.jit(fit_problem, static_argnames="body")
_finish_one = jax.jit(finish)
_finish_many = jax.jit(jax.vmap(finish))


def fetch(p: Problem, end: Progress, last: bool) -> Found:
    """Fetch the end of an iteration to the host."""
    return Found(*jax.device_get(_wanted(_finish_one, p, end, last)))


def _wanted(finished: Callable[..., Any], p: Problem, end: Progress, last: bool) -> tuple[Any, ...]:
    """The fields of `Found`, still on the device."""
    kept = dataclasses.replace(end, latest=None, candidate=None, direction=None)
    return (kept, None, *finished(p, end.latest, end.state.R_nc)) if last else (kept, end.latest.x)


def fit_many(
    body: Body, given: Sequence[tuple[Problem, State]], w: Weights, limits: Limits, last: bool
) -> Iterator[Found]:
    """Fit problems of the same sizes from their starts: see `Found`, in their order, while the device fits the others.

    The result does not depend on which problems are given together beyond rounding.
    """
    frames = given[0][0].weight.shape[0]
    n = min(LANES if len(given) > FEW else FEW, max(1, MOST_FRAMES // frames))
    if len(given) > HELD * n:
        for i in range(0, len(given), HELD * n):
            yield from fit_many(body, given[i : i + HELD * n], w, limits, last)
        return
    size = min(HELD * n, max(n, power_of_2(len(given))))
    # Stacked on the host, so that each array goes to the device once.
    rows = [*given, *[given[-1]] * (size - len(given))]
    held = jax.device_put(jax.tree.map(lambda *a: np.stack(a), *rows))
    waiting = iter(range(len(given)))
    holds = [next(waiting, None) for _ in range(n)]
    lanes, ended = (_begin(body, w, held, np.arange(n) % len(given)) for _ in range(2))
    slots = list[int]()  # which problem each slot of `ended` holds
    found, due = dict[int, Found](), list(range(len(given)))[::-1]
    to_fetch: list[tuple[list[int], tuple[Any, ...]]] = []

    def take_ended() -> None:
        to_fetch.append((slots.copy(), _wanted(_finish_many, ended[0], ended[1], last)))
        slots.clear()

    def fetched() -> Iterator[Found]:
        for problems, wanted in to_fetch:
            here = jax.device_get(wanted)
            for k, i in enumerate(problems):
                found[i] = Found(*jax.tree.map(lambda a, k=k: a[k], here))
        to_fetch.clear()
        while due and due[-1] in found:
            yield found.pop(due.pop())

    most = min(int(limits.iterations), MOST_ITERATIONS)
    while any(i is not None for i in holds):
        lanes = lanes[0], _round(body, lanes[0], w, lanes[1], limits, ROUND)
        yield from fetched()  # while the device iterates
        result, iteration = jax.device_get((lanes[1].result, lanes[1].iteration))
        ends = (result != Result.BOUND) | (iteration >= most)
        over = [(k, i) for k, i in enumerate(holds) if i is not None and ends[k]]
        if over:
            if len(slots) + len(over) > n:
                take_ended()
            slot, row = np.full(len(holds), n), np.full(len(holds), size)  # beyond the end: a lane stays
            for k, i in over:
                slot[k] = len(slots)
                slots.append(i)
                holds[k] = following = next(waiting, None)
                row[k] = size if following is None else following
            lanes, ended = _exchange(body, w, lanes, ended, held, slot, row)
        busy = [lane for lane, i in enumerate(holds) if i is not None]
        if 0 < len(busy) <= FEW < len(holds):  # a lane is empty only where none waits
            at = (busy * FEW)[:FEW]
            lanes, holds = _some(lanes, np.asarray(at)), [holds[i] for i in busy] + [None] * (FEW - len(busy))
    take_ended()
    yield from fetched()


@functools.partial(jax.jit, static_argnames="body")
def _begin(body: Body, w: Weights, held: tuple[Problem, State], rows: Any) -> _Lanes:
    """Some rows of the problems and starts, before their first iteration."""
    p, start = _some(held, rows)
    return p, jax.vmap(functools.partial(begin_of, body), in_axes=(0, None, 0))(p, w, start)


@functools.partial(jax.jit, static_argnames="body", donate_argnames="at")
def _round(body: Body, p: Problem, w: Weights, at: Progress, limits: Limits, iterations: Any) -> Progress:
    """Some iterations more of each lane that has not ended."""

    def more(p: Problem, at: Progress) -> Progress:
        most = jnp.minimum(limits.iterations, at.iteration + iterations)
        return fit_problem(body, p, w, at, dataclasses.replace(limits, iterations=most))

    return jax.vmap(more)(p, at)


@functools.partial(jax.jit, static_argnames="body", donate_argnames="lanes")
def _exchange(
    body: Body, w: Weights, lanes: _Lanes, ended: _Lanes, held: tuple[Problem, State], slot: Any, row: Any
) -> tuple[_Lanes, _Lanes]:
    """Move each lane to its slot of `ended` and the problem of its row into it; where these lie beyond the end, it
    stays."""
    ended = jax.tree.map(lambda a, b: a.at[slot].set(b, mode="drop"), ended, lanes)
    stays = row >= held[0].weight.shape[0]
    among = lambda a, b: jnp.where(stays.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
    return jax.tree.map(among, lanes, _begin(body, w, held, row)), ended


@jax.jit
def _some(rows: Any, at: Any) -> Any:
    return jax.tree.map(lambda a: a[at], rows)
