"""The compiled solve of one problem, and of many side by side on a GPU, each for as long as it takes.

Problems differ in how many iterations they need (8 to 43 of 256 walks), and a batch that is solved together waits for
its slowest. So a program has lanes: after every few iterations those that have ended make room for the next, which may
have become ready meanwhile.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pbl_pipeline.body import Body

from .normal_equations import Linearised, linearise, moved
from .problem import Problem, State
from .solution import Outcome, outcome
from .solvers.gauss_newton import LevenbergMarquardt, Limits, Progress, terminate
from .solvers.linear import marginal_variance
from .weights import Weights

#: Lanes of a program: enough to fill a GPU, where an iteration takes longer with each lane from 16 on; and of the one
#: for few problems. No others: each takes most of a minute to compile.
LANES, FEW = 32, 8
#: Most frames of all lanes together, which bounds the memory.
MOST_FRAMES = 32768
#: Problems that go to the device in one call; fewer are filled up to as many.
MOVED = 8
#: Iterations between two looks at which have ended: a lane that has ended idles until the next one.
ROUND = 2

#: Problems and where each stands.
_Lanes = tuple[Problem, Progress]


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A problem and where its fit starts; `last`: its end is wanted with variances and the outcome."""

    problem: Problem
    start: State
    last: bool


@dataclasses.dataclass(frozen=True)
class Found:
    """End of an iteration, on the host; with the keypoints' dispersion (`Linearised`) and the points there or, for the
    last one, the variances (F, U) of the frames' unknowns and the outcome."""

    end: Progress
    x: np.ndarray | None  # (F, P, 3)
    dispersion: np.ndarray
    variance: np.ndarray | None = None
    outcome: Outcome | None = None

    @property
    def trace(self) -> np.ndarray:
        """(K, 2): iteration and cost after it."""
        n = int(self.end.iteration)
        return np.stack([np.arange(1, n + 1), np.asarray(self.end.trace)[:n]], axis=1).astype(np.float64)


#: Inlined. All programs that evaluate a problem of the same sizes share the second that tracing it takes.
_evaluate = jax.jit(linearise, static_argnames="body", inline=True)


def _solver(body: Body, p: Problem, w: Weights) -> LevenbergMarquardt[State]:
    return LevenbergMarquardt(lambda state: _evaluate(body, p, w, state), moved, p.weight)


def begin_of(body: Body, p: Problem, w: Weights, start: State) -> Progress:
    """State in which `fit_problem` begins."""
    return _solver(body, p, w).init(start)


def fit_problem(body: Body, p: Problem, w: Weights, begin: Progress, limits: Limits, steps: Any = None) -> Progress:
    """Minimise the total of `objective.py` over per-frame poses, from `begin_of` or where it ended before; with
    `steps`, at most so many now."""
    return _solver(body, p, w).iterate(begin, limits, steps)


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


def fetch(p: Problem, end: Progress, last: bool) -> Found:
    """Fetch the end of an iteration to the host."""
    rest = _finish_one(p, end.latest, end.state.R_nc) if last else ()
    return Found(*jax.device_get((_kept(end), None if last else end.latest.x, end.latest.dispersion, *rest)))


def _kept(end: Progress) -> Progress:
    return dataclasses.replace(end, latest=None, candidate=None, direction=None)


def fit_many(
    body: Body, ready: Callable[[int], Sequence[Task]], w: Weights, limits: Limits
) -> Iterator[tuple[Task, Found]]:
    """Fit problems of the same sizes: yields each with its end, while the device fits the others.

    `ready(n)` returns up to n that are ready now, and is asked again while lanes are free; when none is ready and all
    have ended, this ends. The result does not depend on which problems are fitted together beyond rounding.
    """
    new = ready(1)
    if not new:
        return
    frames = new[0].problem.weight.shape[0]
    most, few = (min(n, max(1, MOST_FRAMES // frames)) for n in (LANES, FEW))
    new = [*new, *ready(most - 1)]
    holds = list[Task | None]([None] * (most if len(new) > few else few))
    empty = functools.partial(_begin, body, w, _stacked(new[:1]), np.zeros(len(holds), int))
    lanes, ended = empty(), empty()
    room, slots = len(holds), list[Task]()  # of `ended`, and what they hold
    to_fetch = list[tuple[list[Task], tuple[Any, ...]]]()

    def take_ended() -> None:
        to_fetch.append((slots.copy(), _finished(*ended)))
        slots.clear()

    def fetched() -> Iterator[tuple[Task, Found]]:
        for tasks, wanted in to_fetch:
            here = jax.device_get(wanted)
            for k, task in enumerate(tasks):
                yield task, Found(*jax.tree.map(lambda a, k=k: a[k], here))
        to_fetch.clear()

    while True:
        busy = [k for k, task in enumerate(holds) if task is not None]
        if len(busy) + len(new) < most:
            new = [*new, *ready(most - len(busy) - len(new))]
        n = most if len(busy) + len(new) > few else few
        if n != len(holds) and (busy or new):
            lanes = _some(lanes, _filled_up(busy, n, 0))
            holds = [*(holds[k] for k in busy), *[None] * (n - len(busy))]
        while new:
            now, new = new[:MOVED], new[MOVED:]
            free = [k for k, task in enumerate(holds) if task is None][: len(now)]
            lanes = _filled(body, w, lanes, _stacked(now), _filled_up(free, MOVED, n))
            for k, task in zip(free, now, strict=True):
                holds[k] = task
        if not any(holds):
            if slots:
                take_ended()
            if not to_fetch:
                return
            yield from fetched()
            continue
        at, on = _round(body, lanes[0], w, lanes[1], limits, ROUND)
        lanes = lanes[0], at
        yield from fetched()  # while the device iterates
        going = jax.device_get(on)
        over = [(k, task) for k, task in enumerate(holds) if task is not None and not going[k]]
        last = [(k, task) for k, task in over if task.last]
        others = [(k, task) for k, task in over if not task.last]
        if others:
            reached = _reached(lanes[1], _filled_up([k for k, _ in others], n, 0))
            to_fetch.append(([task for _, task in others], reached))
        for part in (last[i : i + room] for i in range(0, len(last), room)):
            if len(slots) + len(part) > room:
                take_ended()
            slot = np.full(n, room)  # beyond the end: stays behind
            slot[[k for k, _ in part]] = np.arange(len(slots), len(slots) + len(part))
            slots += [task for _, task in part]
            ended = _moved(ended, lanes, slot)
        for k, _ in over:
            holds[k] = None


def _filled_up(numbers: Sequence[int], n: int, by: int) -> np.ndarray:
    return np.asarray([*numbers, *[by] * (n - len(numbers))])


def _stacked(tasks: Sequence[Task]) -> tuple[Problem, State]:
    """Problems and starts on the device, filled up to `MOVED`; stacked on the host, so that each array goes once."""
    rows = [(t.problem, t.start) for t in tasks]
    return jax.device_put(jax.tree.map(lambda *a: np.stack(a), *rows, *[rows[-1]] * (MOVED - len(rows))))


@functools.partial(jax.jit, static_argnames="body")
def _begin(body: Body, w: Weights, given: tuple[Problem, State], rows: Any) -> _Lanes:
    """Some rows of the problems and starts, before their first iteration."""
    p, start = _some(given, rows)
    return p, jax.vmap(functools.partial(begin_of, body), in_axes=(0, None, 0))(p, w, start)


@functools.partial(jax.jit, static_argnames="body", donate_argnames="lanes")
def _filled(body: Body, w: Weights, lanes: _Lanes, given: tuple[Problem, State], lane: Any) -> _Lanes:
    """The lanes with each of the given problems in its lane; where that lies beyond the end, nowhere."""
    return _placed(lanes, lane, _begin(body, w, given, np.arange(MOVED)))


@functools.partial(jax.jit, donate_argnames="ended")
def _moved(ended: _Lanes, lanes: _Lanes, slot: Any) -> _Lanes:
    """`ended` with each lane in its slot; where that lies beyond the end, nowhere."""
    return _placed(ended, slot, lanes)


def _placed(rows: Any, at: Any, given: Any) -> Any:
    return jax.tree.map(lambda a, b: a.at[at].set(b, mode="drop"), rows, given)


@functools.partial(jax.jit, static_argnames="body", donate_argnames="at")
def _round(
    body: Body, p: Problem, w: Weights, at: Progress, limits: Limits, steps: Any
) -> tuple[Progress, Bool[Array, " lanes"]]:
    """Some iterations more of each lane that has not ended, and which have not ended then."""
    at = jax.vmap(lambda p, at: fit_problem(body, p, w, at, limits, steps))(p, at)
    return at, ~terminate(at, limits)


@jax.jit
def _finished(p: Problem, end: Progress) -> tuple[Any, ...]:
    """The fields of `Found` of last ends: copies, because the arrays of `end` are given away."""
    return jax.tree.map(
        jnp.copy, (_kept(end), None, end.latest.dispersion, *jax.vmap(finish)(p, end.latest, end.state.R_nc))
    )


@jax.jit
def _reached(end: Progress, at: Any) -> tuple[Any, ...]:
    """The fields of `Found` of some lanes whose ends are not the last."""
    return _some((_kept(end), end.latest.x, end.latest.dispersion), at)


@jax.jit
def _some(rows: Any, at: Any) -> Any:
    return jax.tree.map(lambda a: a[at], rows)
