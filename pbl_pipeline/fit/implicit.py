"""Method `implicit-adam`: the paper's optimisation (sections Implicit Representation and Model Fitting).

Every trial has its own trajectory, all share one body. The steps run inside one compiled loop; the host only counts
them. The frames of all steps of a chunk are drawn at once.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from pbl_pipeline import progress
from pbl_pipeline.body import Body, marker_positions, mjx_frames, scale_multipliers
from pbl_pipeline.errors import PblError, said

from .initial_pose import median_orientation, median_pose, paper_pose
from .objective import OF_SINGLE_FRAMES, total
from .params import ImplicitAdamParams
from .problem import Problem, State, frames_at, pad_frames
from .session import Session
from .solution import Solution, outcome
from .solvers.adam import Schedule, optimiser, run
from .solvers.result import Result
from .term import At, Phone
from .trajectory import Trajectory, encode, evaluate, fit_ranges, frequencies, initial_trajectories, pose_of, raw_of
from .weights import Weights

#: Steps per compiled call: the granularity of the progress bar and of the loss trace.
CHUNK = 250
#: Converged: the loss fell by less than this fraction of its end over the second half of the steps.
FALL_CONVERGED = 0.2


class Unknowns(eqx.Module):
    """Everything that is optimised: one trajectory per trial, the paper's scale parameters, the marker offsets."""

    trajectories: Trajectory
    s: Float[Array, " S"]
    site_offset_m: Float[Array, "J 3"]


class Draw(eqx.Module):
    """Frames and, where a camera moves, phone samples of each trial, by their numbers."""

    frames: Int[Array, "*k N B"]
    phone: Int[Array, "*k N C"]


class Data(eqx.Module):
    """Constants of the problem: F frames and N trials with M phone samples each, all padded.

    code: the encoded times of all frames, then of all phone samples (row F + i M + k). order: numbers of the frames
    that count, trial after trial; first, count: where each trial's lie in it. phone_count: samples that count, the
    first of each trial. start: what is added to the trajectories' outputs. trial_weight: of a trial in the mean over
    trials.
    """

    body: Body = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    problem: Problem
    weights: Weights
    schedule: Schedule
    code: Float[Array, "R C"]
    order: Int[Array, " F"]
    first: Int[Array, " N"]
    count: Int[Array, " N"]
    phone_quat_wxyz: Float[Array, "NM 4"]
    phone_count: Int[Array, " N"]
    start: Float[Array, "N O"]
    trial_weight: Float[Array, " N"]
    low: Float[Array, " Q"]
    high: Float[Array, " Q"]

    def qpos(self, raw: Float[Array, "*n O"]) -> Float[Array, "*n Q"]:
        """Joint values of the trajectories' outputs."""
        return pose_of(raw[..., : len(self.low)], self.low, self.high, jnp.asarray(self.body.is_slide))

    def turn(self, raw: Float[Array, "*n O"]) -> jaxlie.SO3:
        """The camera's orientation of the trajectories' outputs."""
        return jaxlie.SO3.exp(raw[..., len(self.low) :])


def solve_sessions(
    sessions: Iterable[Session], params: ImplicitAdamParams, starts: Iterable[State]
) -> Iterator[Solution | PblError]:
    """Fit sessions one after the other, from the paramset's own start; an error takes the place of a failed one."""
    for session, _ in zip(sessions, starts, strict=True):
        try:
            yield solve_implicit(session, params)
        except PblError as error:
            yield error


def solve_implicit(session: Session, params: ImplicitAdamParams) -> Solution:
    """Fit all trials of a session.

    Raises `PblError` FIT_INPUT: the paramset has a prior of no joint. FIT_DIVERGED: the loss is not finite.
    """
    begin = time.perf_counter()
    data, unknowns = initialise(session, params)
    state = _chain(data, unknowns).init(eqx.filter(unknowns, eqx.is_array))
    key = jax.random.key(params.seed + 1)
    trace, compile_seconds = [], 0.0

    def record(chunk: int, losses: Array) -> None:
        kept = min(CHUNK, params.steps - chunk * CHUNK)
        loss = float(np.mean(np.asarray(losses)[:kept]))
        trace.append((chunk * CHUNK + kept, loss))
        update(kept, note=f"loss {loss:.2f}")
        if not np.isfinite(loss):
            raise PblError(
                "FIT_DIVERGED",
                found=said("a loss that is not finite, after {n} steps", n=chunk * CHUNK + kept),
                expected="a finite loss",
                next_step="check the keypoints and the camera matrix; report the keypoints file if both are sound",
            )

    pending = None
    with progress.bar("fit", total=params.steps) as update:
        for chunk in range(-(-params.steps // CHUNK)):
            t0 = time.perf_counter()
            unknowns, state, losses = _run_chunk(unknowns, state, jax.random.fold_in(key, chunk), data)
            # The call returns once the program is compiled; what it computes comes later.
            compile_seconds += (time.perf_counter() - t0) * (chunk == 0)
            # The device works on this chunk while the host looks at the one before.
            if pending is not None:
                record(*pending)
            pending = chunk, losses
        if pending is not None:
            record(*pending)
    qpos, R_nc = _on_all_frames(session, unknowns.trajectories, data)
    ended = len(trace) > 1 and trace[(len(trace) - 1) // 2][1] < (1 + FALL_CONVERGED) * trace[-1][1]
    return Solution(
        qpos=qpos,
        R_nc=R_nc,
        s=np.asarray(unknowns.s, np.float64),
        scale=np.asarray(scale_multipliers(unknowns.s), np.float64),
        site_offset_m=np.asarray(unknowns.site_offset_m, np.float64)[: len(session.markers)],
        clock_s=np.zeros(len(session.trials)),
        loss_trace=np.asarray(trace, np.float64).reshape(-1, 2),
        compile_seconds=compile_seconds,
        seconds=time.perf_counter() - begin,
        iterations=params.steps,
        result=Result.SMALL_GAIN if ended else Result.MAX_STEPS_REACHED,
        outcome=jax.device_get(_outcome(data, unknowns, jnp.asarray(qpos), jnp.asarray(R_nc))),
    )


def initialise(session: Session, params: ImplicitAdamParams) -> tuple[Data, Unknowns]:
    """The session's data and the unknowns to start from."""
    body, p, n = session.body, session.problem, len(session.trials)
    n_padded, frames = p.has_phone.shape[0], p.weight.shape[0]
    low, high = fit_ranges(body)
    if params.start == "keypoints":
        poses = [median_pose(session, i) for i in range(n)]
    else:
        poses = [paper_pose(session, i, params.start_distance_m, 0.5 * (low + high)) for i in range(n)]
    start = np.stack([raw_of(q, low, high, body.is_slide) for q in poses])
    if p.moving:
        start = np.concatenate([start, [median_orientation(session, i) for i in range(n)]], axis=1)

    duration = float(max(a.time_s[-1] - a.time_s[0] for a in session.arrays))
    omega = frequencies(duration, params.max_frequency_rad_s, params.pairs_per_octave)
    phone_time, phone_quat, phone_count = phone_samples(session)
    code = encode(np.concatenate([np.asarray(p.time_s, np.float64), phone_time.ravel()]), omega)
    counts = np.flatnonzero(np.asarray(p.weight) > 0)
    per_trial = np.bincount(np.asarray(p.trial)[counts], minlength=n_padded)
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    i32 = functools.partial(jnp.asarray, dtype=jnp.int32)
    data = Data(
        body=body,
        samples=params.samples_per_trial,
        problem=jax.tree.map(jnp.asarray, p),
        weights=Weights.of(body, params),
        schedule=Schedule(
            steps=f32(params.steps),
            rate_start=f32(params.learning_rate_start),
            rate_end=f32(params.learning_rate_end),
            b1=f32(params.adam_b1),
            weight_decay=f32(params.weight_decay),
            clip_norm=f32(params.clip_norm),
        ),
        code=f32(code),
        order=i32(np.pad(counts, (0, frames - len(counts)))),
        first=i32(np.concatenate([[0], np.cumsum(per_trial)[:-1]])),
        count=i32(per_trial),
        phone_quat_wxyz=f32(phone_quat.reshape(-1, 4)),
        phone_count=i32(phone_count),
        start=f32(np.pad(start, [(0, n_padded - n), (0, 0)])),
        trial_weight=f32(np.pad(np.full(n, 1 / n), (0, n_padded - n))),
        low=f32(low),
        high=f32(high),
    )
    shape = code.shape[1], params.hidden, params.n_skip, start.shape[1]
    trajectories = initial_trajectories(params.seed, n_padded, *shape)
    return data, Unknowns(trajectories, jnp.zeros(len(body.scale_names)), jnp.zeros((p.weight_3d.shape[0], 3)))


def phone_samples(session: Session) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The sensor's own samples between frames that count: times (N, M) from each trial's start, orientations
    (N, M, 4), how many there are (N,)."""
    times, quats, n_padded = [], [], session.problem.has_phone.shape[0]
    for a in session.arrays:
        if a.phone_time_s is None or a.phone_quat_wxyz is None:
            times.append(np.zeros(0))
            quats.append(np.zeros((0, 4)))
            continue
        after = np.clip(np.searchsorted(a.time_s, a.phone_time_s), 1, len(a.time_s) - 1)
        inside = (a.phone_time_s >= a.time_s[0]) & (a.phone_time_s <= a.time_s[-1])
        inside &= a.used[after] & a.used[after - 1]
        times.append(a.phone_time_s[inside] - a.time_s[0])
        quats.append(a.phone_quat_wxyz[inside] / np.linalg.norm(a.phone_quat_wxyz[inside], axis=1, keepdims=True))
    count = np.array([len(t) for t in times])
    size = pad_frames(int(count.max())) if session.problem.moving else 0
    time_s, quat = np.zeros((n_padded, size)), np.tile([1.0, 0, 0, 0], (n_padded, size, 1))
    for i, (t, q) in enumerate(zip(times, quats, strict=True)):
        time_s[i, : len(t)], quat[i, : len(t)] = t, q
    return time_s, quat, np.pad(count, (0, n_padded - len(count)))


def loss(unknowns: Unknowns, drawn: Draw, data: Data) -> Float[Array, ""]:
    """The total on some frames and phone samples of each trial."""
    n, b = drawn.frames.shape
    p = frames_at(data.problem, drawn.frames.reshape(-1))
    p = dataclasses.replace(p, weight=jnp.repeat(data.trial_weight / b, b, total_repeat_length=n * b))
    rows = jnp.concatenate([drawn.frames, data.problem.weight.shape[0] + drawn.phone], axis=1)
    raw = evaluate(unknowns.trajectories, data.code.at[rows].get(mode="promise_in_bounds")) + data.start[:, None]
    R_nc = p.R_nc
    if p.moving:
        own = data.turn(raw[:, :b].reshape(n * b, -1)).as_matrix()[:, None]
        R_nc = jnp.where((p.has_phone[p.trial] > 0)[:, None, None, None], own, R_nc)
    none = jnp.zeros_like(data.trial_weight)
    qpos = data.qpos(raw[:, :b]).reshape(n * b, -1)
    state = State(qpos, R_nc, unknowns.s, unknowns.site_offset_m, none, jnp.zeros((n, 3)))
    x, soles, _ = p.split(_points(data, state))
    return total(At(p, data.weights, state, x, soles, _phone(drawn, data, raw[:, b:])), OF_SINGLE_FRAMES)


def _points(data: Data, state: State) -> Array:
    p, scale = data.problem, scale_multipliers(state.s)
    offsets = p.point_offsets(state.site_offset_m)
    return marker_positions(data.body, p.points, state.qpos, scale, offsets, forward=mjx_frames)


def _phone(drawn: Draw, data: Data, raw: Float[Array, "N C O"]) -> Phone | None:
    """Fitted and measured orientations of the phone samples and their weights."""
    if not data.problem.moving:
        return None
    measured = data.phone_quat_wxyz.at[drawn.phone.reshape(-1)].get(mode="promise_in_bounds")
    per_trial = data.trial_weight * (data.phone_count > 0) / drawn.phone.shape[1]
    weights = jnp.broadcast_to(per_trial[:, None], drawn.phone.shape).reshape(-1)
    return Phone(data.turn(raw.reshape(-1, raw.shape[-1])), lambda _: jaxlie.SO3(measured), weights)


def draw(key: Array, data: Data) -> Draw:
    """Frames and phone samples for all steps of a chunk, with replacement from those that count.

    A trial's draws do not depend on how many trials or frames there are.
    """
    shape = (2, CHUNK, data.samples)
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(len(data.count)))
    u = jax.vmap(lambda k: jax.random.uniform(k, shape))(keys)

    def pick(u: Array, count: Array) -> Array:
        most = jnp.maximum(count - 1, 0)[:, None, None]
        return jnp.minimum((u * count[:, None, None]).astype(jnp.int32), most)

    at = data.first[:, None, None] + pick(u[:, 0], data.count)
    frames = jnp.swapaxes(data.order[jnp.minimum(at, len(data.order) - 1)], 0, 1)
    if not data.problem.moving:
        return Draw(frames, frames[..., :0])
    size = len(data.phone_quat_wxyz) // len(data.count)
    phone = jnp.arange(len(data.count))[:, None, None] * size + pick(u[:, 1], data.phone_count)
    return Draw(frames, jnp.swapaxes(phone, 0, 1))


def _chain(data: Data, unknowns: Unknowns) -> Any:
    """The optimiser: weight decay on the networks alone."""
    decayed = jax.tree.map(lambda _: False, unknowns)
    decayed = eqx.tree_at(lambda u: u.trajectories, decayed, jax.tree.map(lambda _: True, unknowns.trajectories))
    return optimiser(data.schedule, decayed)


@functools.partial(jax.jit, donate_argnums=(0, 1))
def _run_chunk(unknowns: Unknowns, state: Any, key: Array, data: Data) -> tuple[Unknowns, Any, Array]:
    """`CHUNK` steps; those beyond the schedule's change no unknown."""
    return run(functools.partial(loss, data=data), _chain(data, unknowns), unknowns, state, draw(key, data))


@jax.jit
def _outcome(data: Data, unknowns: Unknowns, qpos: Array, R_nc: Array) -> Any:
    state = State(qpos, R_nc, unknowns.s, unknowns.site_offset_m, data.trial_weight, jnp.zeros((len(data.count), 3)))
    with jax.default_matmul_precision("highest"):
        return outcome(data.problem, _points(data, state), R_nc)


@jax.jit
def _raw(trajectories: Trajectory, data: Data, index: Int[Array, "N T"]) -> Float[Array, "N T O"]:
    return evaluate(trajectories, data.code[index]) + data.start[:, None]


def _on_all_frames(session: Session, trajectories: Trajectory, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """qpos (F, Q) and R_nc (F, V, 3, 3) of every packed frame."""
    p, n = session.problem, len(data.count)
    trial = np.asarray(p.trial)
    rows = [np.flatnonzero(trial == i) for i in range(n)]
    size = pad_frames(max(len(r) for r in rows))
    index = np.stack([np.pad(r, (0, size - len(r))) for r in rows])
    raw = np.asarray(_raw(trajectories, data, jnp.asarray(index, jnp.int32)))
    out = np.concatenate([raw[i, : len(r)] for i, r in enumerate(rows)])[np.argsort(np.concatenate(rows))]
    qpos = np.asarray(data.qpos(jnp.asarray(out)), np.float64)
    R_nc = np.array(p.R_nc, np.float64)
    if p.moving:
        measured = np.asarray(p.has_phone)[trial] > 0
        R_nc[measured, 0] = np.asarray(data.turn(jnp.asarray(out[measured])).as_matrix(), np.float64)
    return qpos, R_nc
