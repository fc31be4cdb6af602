"""Method `gauss-newton`: robust least squares over per-frame poses, with everything the session shares in the same
system. Deterministic, bounded, compiled once per size of session.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline import progress
from pbl_pipeline.body import Body, scale_multipliers
from pbl_pipeline.errors import PblError
from pbl_pipeline.jax_setup import compile_seconds
from pbl_pipeline.sampling import interval_of

from . import depths
from .augmented_pelvis import with_augmented_pelvis
from .blas_threads import one_blas_thread
from .initial_pose import placed_poses
from .lanes import Found, Task, begin_one, fetch, fit_many, fit_one
from .measured_weights import with_measured_weights
from .params import GaussNewtonParams
from .phone_error import phone_variance
from .problem import Problem, State, pixels_alone
from .session import Session
from .solution import Solution
from .solvers.gauss_newton import Limits, Progress
from .solvers.result import Result
from .wearables import sensor_fits, shares_of_floors, with_wearables
from .weights import Weights

#: A point that stands is slower than this fraction of its own fastest, or than this (m/s); speeds are means over some
#: time (s, standard deviation).
STANDING_FRACTION, STANDING_M_PER_S, STANDING_S = 0.25, 0.2, 0.03
#: Knees at their straight end in more than this fraction of the frames may belong to a body that faces the wrong way.
BACKWARDS_FRACTION = 0.2
#: Iterations between two steps of the bar: each call of the program takes new memory, which costs half an iteration.
SHOWN = 8


def solve_per_frame(
    sessions: Iterable[Session], params: GaussNewtonParams, starts: Iterable[State]
) -> Iterator[Solution | PblError]:
    """Fit sessions that are packed to the same sizes from `start_of` each: where there may be several
    (`operator.length_hint`), side by side on the device, which fits the others while the first solutions are taken, and
    is given more where the iterables have more after they ended.

    The result does not depend on which sessions are fitted together. A session whose result is suspicious is solved
    again from a start that faces the other way, and the better one of the two is kept. If the paramset has feet on the
    floor, the augmenter's pelvis or measured weights, or there are sensors or depths, a first solution shows when each
    foot stands, what the augmenter sees, how far each point errs, how the sensors sit and which depths are the
    person's, and a second one uses it. Where the augmenter is needed and not available, its error takes the place of
    the solution.

    Raises `PblError` FIT_INPUT: the paramset has a prior of no joint.
    """
    several, given = operator.length_hint(sessions) > 1, zip(sessions, starts, strict=True)
    first = next(given, None)
    if first is None:
        return
    body, w = first[0].body, Weights.of(first[0].body, params, size_unseen=pixels_alone(first[0].problem))
    fit = fit_many if several and first[0].plain else _one_by_one
    begun, done = dict[Task, tuple[int, _Steps]](), dict[int, Solution | PblError]()
    waiting, numbers, due = deque[Task](), itertools.count(), 0

    def go_on(i: int, steps: _Steps, found: Found | None) -> None:
        try:
            task = steps.send(found) if found else next(steps)
        except StopIteration as end:
            done[i] = end.value
        except PblError as error:
            done[i] = error
        else:
            begun[task] = i, steps
            waiting.append(task)

    def ready(n: int) -> list[Task]:
        nonlocal first
        while len(waiting) < n:
            # A zip may be asked again after it ended: it ends anew each time that `sessions` does.
            pair, first = first or next(given, None), None
            if pair is None:
                break
            go_on(next(numbers), _steps(*pair, params), None)
        return [waiting.popleft() for _ in range(min(n, len(waiting)))]

    def ended() -> Iterator[Solution | PblError]:
        nonlocal due, begin, compiled
        while due in done:
            solution, now, compiled_now = done.pop(due), time.perf_counter(), compile_seconds()
            if isinstance(solution, Solution):
                # Since the last one, without what the caller did meanwhile.
                spent = {"seconds": now - begin, "compile_seconds": compiled_now - compiled}
                solution = dataclasses.replace(solution, **spent)
            yield solution
            due, begin, compiled = due + 1, time.perf_counter(), compiled_now

    begin, compiled = time.perf_counter(), compile_seconds()
    with one_blas_thread():
        for task, found in fit(body, ready, w, limits_of(params)):
            go_on(*begun.pop(task), found)
            yield from ended()
    yield from ended()


#: The problems of a session one after the other: each is sent its end, and the last end gives the solution.
_Steps = Generator[Task, Found, Solution]


def _steps(session: Session, start: State, params: GaussNewtonParams) -> _Steps:
    """Solve the problems of a session: each is yielded, and its end is sent back.

    Raises `PblError` where the augmenter is needed and not available.
    """
    one_camera = session.problem.c_2d.shape[1] == 1  # of several, residuals are also of their calibration
    measured = one_camera and (params.points_px > 0 or params.points_cm > 0)
    refined = params.weight_floor > 0 or params.weight_slide > 0 or params.weight_pelvis > 0
    twice = measured or refined or not session.plain
    p = session.problem
    found = yield Task(p, _with_detector(start, params), last=not twice)
    if suspicious(session, found.end.state.qpos):
        turned = yield Task(p, _with_detector(start_of(session, flip=True), params), last=not twice)
        found = min(found, turned, key=lambda f: float(f.end.cost))
    trace, told, moves_with, in_place = found.trace, None, (), np.zeros(0)
    if twice:
        p, start = _on_floor(session, found)
        if measured:
            p = with_measured_weights(p, Weights.of(session.body, params), found)
        if params.weight_pelvis > 0:
            p = with_augmented_pelvis(session, p, np.asarray(start.qpos), np.asarray(scale_multipliers(start.s)))
            told = np.asarray(p.c_pelvis)
        if session.worn is not None:
            p, start, moves_with = with_wearables(session, p, start, float(found.dispersion))
        if session.depths:
            assert found.x is not None
            p, start, in_place = depths.with_depths(session, p, start, p.split(found.x)[0], float(found.dispersion))
        found = yield Task(p, start, last=True)
        # The cost of the second one has a term more.
        trace = np.concatenate([trace, found.trace + np.array([len(trace), 0.0])])
    solution = _solution(session, p, params, found, trace, told)
    if session.worn is not None:
        sensors = sensor_fits(session, p, found.end.state, params.huber_sensor, moves_with)
        solution = dataclasses.replace(solution, sensors=sensors)
    if session.depths:
        x = solution.outcome.x_world_m
        of_trials = depths.depth_fit(session, p, start, found.end.state, x, in_place, params.depth_point_sd_m)
        solution = dataclasses.replace(solution, depths=of_trials)
    return solution


def start_of(session: Session, flip: bool = False) -> State:
    """The standing body placed by the keypoints, unscaled; `flip`: facing the other way."""
    p, n_markers = session.problem, session.problem.weight_3d.shape[0]
    qpos = np.concatenate([placed_poses(session, i, flip) for i in range(len(session.arrays))])
    qpos = np.pad(qpos, [(0, p.weight.shape[0] - len(qpos)), (0, 0)], mode="edge")
    zeros = functools.partial(np.zeros, dtype=np.float32)
    n_trials = p.has_phone.shape[0]
    values: dict[str, Any] = {
        "qpos": np.asarray(qpos, np.float32),
        "R_nc": p.R_nc,
        "s": zeros(len(session.body.scale_names)),
        "site_offset_m": zeros((n_markers, 3)),
        "clock_s": zeros(n_trials),
        "floor": zeros((n_trials, 3)),
        # On the host like the others: arrays of a device are fetched one by one before a batch is stacked.
        "lean": zeros((0, 3)),
        "depth_m": zeros((0, 0)),
    }
    return State(**values)


def _with_detector(start: State, params: GaussNewtonParams) -> State:
    """Add the errors of a single camera's detector to the unknowns, if the paramset has them."""
    if params.weight_detector == 0 or start.R_nc.shape[1] != 1:
        return start
    trials, markers = start.floor.shape[0], start.site_offset_m.shape[0]
    lean, depth_m = np.zeros((trials, 3), np.float32), np.zeros((trials, markers), np.float32)
    seen: Any = lean, depth_m
    return dataclasses.replace(start, lean=seen[0], depth_m=seen[1])


def _step_by_step(body: Body, p: Problem, w: Weights, begin: Progress, limits: Limits) -> Progress:
    """`fit_one` with a bar that moves every few iterations; all at once if no bar is shown."""
    if not progress.enabled():
        return fit_one(body, p, w, begin, limits)
    most, at, done = int(limits.iterations), begin, 0
    with progress.bar("fit", unit=" iterations") as update:
        for n in (*range(SHOWN, most, SHOWN), most):
            at = fit_one(body, p, w, at, dataclasses.replace(limits, iterations=jnp.asarray(n, jnp.int32)))
            done, before = int(at.iteration), done
            update(done - before, f"of at most {most}, cost {float(at.cost):.4g}")
            if int(at.result) != Result.MAX_STEPS_REACHED:
                break
    return at


def _one_by_one(
    body: Body, ready: Callable[[int], Sequence[Task]], w: Weights, limits: Limits
) -> Iterator[tuple[Task, Found]]:
    """What `fit_many` does, without its lanes."""
    while tasks := ready(1):
        p, start = jax.device_put((tasks[0].problem, tasks[0].start))
        yield tasks[0], fetch(p, _step_by_step(body, p, w, begin_one(body, p, w, start), limits), tasks[0].last)


def _on_floor(session: Session, found: Found) -> tuple[Problem, State]:
    """The problem with the frames in which feet stand in a solution, and that solution to start from."""
    p, state = session.problem, found.end.state
    assert found.x is not None
    soles = p.split(found.x)[1]
    contact, floor = np.zeros(p.contact.shape, np.float32), np.zeros(state.floor.shape, np.float32)
    for i, arrays in enumerate(session.arrays):
        first, last = np.flatnonzero(arrays.used)[[0, -1]]  # frames beside them stay where they started
        at = slice(session.frames(i).start + first, session.frames(i).start + last + 1)
        contact[at] = standing(arrays.time_s[first : last + 1], soles[at]) * arrays.used[first : last + 1, None]
        floor[i, 0] = np.average(soles[at][..., 2], weights=contact[at] + 1e-9)
    seen: Any = contact, floor
    return dataclasses.replace(p, contact=seen[0]), dataclasses.replace(state, floor=seen[1])


def standing(time_s: Float[np.ndarray, " T"], x: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "T P"]:
    """Certainty (0 to 1) that each point of the soles stands: one half where it is just slow enough."""
    smooth = gaussian_filter1d(x, STANDING_S / interval_of(time_s), axis=0, mode="nearest")
    speed = np.linalg.norm(np.gradient(smooth, time_s, axis=0), axis=-1)
    limit = np.maximum(STANDING_FRACTION * np.percentile(speed, 95, axis=0), STANDING_M_PER_S)
    return 1 / (1 + np.exp(np.minimum((speed / limit - 1) / 0.15, 50.0)))


def _solution(
    session: Session,
    p: Problem,
    params: GaussNewtonParams,
    found: Found,
    trace: np.ndarray,
    pelvis_told: np.ndarray | None,
) -> Solution:
    """The solution, without the time it took."""
    state, names = jax.tree.map(lambda a: np.asarray(a, np.float64), found.end.state), session.body.joint_names
    factor, floor = by_joint(names, params.sd_factor, 1.0), floors_of(session.body, params.sd_floor)
    if session.worn is not None:
        floor = floor * shares_of_floors(session, p)
    if session.depths:
        floor = floor * depths.shares_of_floors(session, p)
    assert found.variance is not None
    assert found.outcome is not None
    variance = np.maximum(found.variance[:, : len(factor)], 0.0)
    return Solution(
        qpos=state.qpos,
        R_nc=state.R_nc,
        s=state.s,
        scale=np.asarray(scale_multipliers(found.end.state.s), np.float64),
        site_offset_m=state.site_offset_m[: len(session.markers)],
        clock_s=state.clock_s[: len(session.arrays)],
        loss_trace=trace,
        compile_seconds=0.0,
        seconds=0.0,
        iterations=len(trace),
        result=Result(int(found.end.result)),
        outcome=found.outcome,
        # The factors were found on recordings that contain the phone's part, so they apply to both.
        qpos_sd=np.sqrt((variance + phone_variance(session, state.qpos)) * factor**2 + floor**2),
        pelvis_told=pelvis_told,
    )


def limits_of(params: GaussNewtonParams) -> Limits:
    """The limits of the iteration, on the device."""
    return Limits(
        jnp.asarray(params.tolerance_rad, jnp.float32),
        jnp.asarray(params.tolerance_cost, jnp.float32),
        jnp.asarray(params.max_iterations, jnp.int32),
    )


def by_joint(joint_names: Sequence[str], values: Sequence[tuple[str, float]], other: float) -> np.ndarray:
    """(Q,) values; a name stands for every joint that begins with it, later ones win, `other` where none does."""
    out = np.full(len(joint_names), other)
    for prefix, value in values:
        out[[n.startswith(prefix) for n in joint_names]] = value
    return out


def floors_of(body: Body, sd_floor: Sequence[tuple[str, float]]) -> np.ndarray:
    """(Q,) least standard deviations in rad and m, from degrees and (slides) centimetres."""
    return by_joint(body.joint_names, sd_floor, 0.0) * np.where(body.is_slide, 0.01, np.deg2rad(1.0))


def suspicious(session: Session, qpos: Float[np.ndarray, "F Q"]) -> bool:
    """True if the body may face the wrong way, unseen in pixels alone: knees then stay at their straight end."""
    if pixels_alone(session.problem):
        return True
    used = np.asarray(session.problem.weight) > 0
    high = np.asarray(session.body.joint_range_rad)[:, 1]
    knees = [i for i, n in enumerate(session.body.joint_names) if n.startswith("knee_angle")]
    straight = qpos[used][:, knees] > high[knees] - np.deg2rad(1.0)
    return bool(knees) and bool(np.mean(straight) > BACKWARDS_FRACTION)  # another body may have none
