"""`implicit-adam`: the paper's optimisation (sections Implicit Representation and Model Fitting).

Every trial has its own network, all share one body. The steps run inside `lax.scan`; the host only counts them. All
unknowns lie in one vector, so that clipping and Adam are a few operations whatever the number of layers, and the frames
of all steps of a chunk are drawn at once.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from pbl_pipeline import progress
from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable
from pbl_pipeline.body._marker_chain import chained_markers
from pbl_pipeline.errors import PblError

from .. import _costs as costs
from .._inputs import Session
from .._marker_cost import Kinds, MarkerWeights, frames_at, kinds_of, marker_cost
from .._network_start import camera_start, keypoint_start, paper_start
from .._observations import Observations, pad_frames
from .._paper_objective import angle_between_deg
from .._params import ImplicitAdamParams
from .._prior import prior_of
from .._trajectory import Networks, encode, evaluate, fit_ranges, frequencies, initial_networks, pose_of, raw_of
from ._normal import scale_multipliers
from ._solution import Solution

#: Steps per compiled call: the granularity of the progress bar and of the loss trace.
CHUNK = 250
#: Adam's second moment and its guard against division by zero: the usual values, which the paper does not change.
ADAM_B2, ADAM_EPS = 0.999, 1e-8
#: Converged: the loss fell by less than this share of its end over the second half of the steps.
FALL_CONVERGED = 0.2


class Unknowns(NamedTuple):
    """Everything that is optimised. `s`: the paper's 8 scale parameters."""

    networks: Networks
    s: Float[Array, " 8"]
    site_offset_m: Float[Array, "J 3"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Numbers:
    """The numbers of a paramset as arrays, so that another paramset runs the same compiled program."""

    markers: MarkerWeights
    weight_phone: Array
    weight_offset_per_m2: Array
    weight_pose: Array
    weight_scale: Array
    scale_sd: Array
    scale_sides_sd: Array
    neutral: Array
    inverse_sd: Array
    steps: Array
    rate_start: Array
    log_decay: Array
    adam_b1: Array
    weight_decay: Array
    clip_norm: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Data:
    """What does not change: F frames and N trials with P phone samples each, all padded.

    code: the encoded times of all frames, then of all phone samples (row F + i P + k). order: rows of the frames that
    count, trial after trial; first, count: where each trial's lie in it. phone_count: samples that count, the first of
    each trial. start: what is added to the networks' outputs. share: of a trial in the mean over trials.
    """

    obs: Observations
    table: MarkerTable
    code: Float[Array, "R C"]
    order: Int[Array, " F"]
    first: Int[Array, " N"]
    count: Int[Array, " N"]
    phone_quat_wxyz: Float[Array, "NP 4"]
    phone_count: Int[Array, " N"]
    start: Float[Array, "N O"]
    share: Float[Array, " N"]
    low: Float[Array, " 40"]
    high: Float[Array, " 40"]
    is_translation: Array


class _Static(NamedTuple):
    """What a compiled program is made for."""

    body: Body
    kinds: Kinds
    samples: int
    priors: bool
    #: The unknowns' leaves are slices of one vector: where each begins and its shape, networks first.
    shapes: tuple[tuple[int, ...], ...]


def solve_implicit_adam(session: Session, params: ImplicitAdamParams) -> Solution:
    """Fit all trials of a session.

    Raises
    ------
    PblError
        FIT_INPUT: the paramset has a prior of no joint. FIT_DIVERGED: the loss is not finite.
    """
    begin = time.perf_counter()
    data, unknowns = _initialise(session, params)
    numbers = _numbers(session.body, params)
    priors = params.cost.weight_pose > 0 or params.cost.weight_scale > 0
    static = _Static(session.body, kinds_of(session), params.samples_per_trial, priors, _shapes(unknowns))
    flat = jnp.concatenate([jnp.ravel(a) for a in jax.tree.leaves(unknowns)])
    carry = (flat, jnp.zeros_like(flat), jnp.zeros_like(flat))
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
                found=f"loss {loss} after {chunk * CHUNK + kept} steps",
                expected="a finite loss",
                next_step="check the keypoints and the camera matrix; report the keypoints file if both are sound",
            )

    pending = None
    with progress.bar("fit", total=params.steps) as update:
        for chunk in range(-(-params.steps // CHUNK)):
            t0 = time.perf_counter()
            carry, losses = _run_chunk(carry, jnp.asarray(chunk, jnp.int32), key, data, numbers, static)
            # The call returns once the program is compiled; what it computes comes later.
            compile_seconds += (time.perf_counter() - t0) * (chunk == 0)
            # The device works on this chunk while the host looks at the one before.
            if pending is not None:
                record(*pending)
            pending = chunk, losses
        if pending is not None:
            record(*pending)
    solved = _split(carry[0], static.shapes)
    qpos, R_nc = _on_all_frames(session, solved.networks, data, static)
    return Solution(
        qpos=qpos,
        R_nc=R_nc,
        s=np.asarray(solved.s, np.float64),
        scale=np.asarray(scale_multipliers(solved.s), np.float64),
        site_offset_m=np.asarray(solved.site_offset_m, np.float64)[: len(session.markers)],
        clock_s=np.zeros(len(session.trials)),
        loss_trace=np.asarray(trace, np.float64).reshape(-1, 2),
        compile_seconds=compile_seconds,
        seconds=time.perf_counter() - begin,
        iterations=params.steps,
        converged=len(trace) > 1 and trace[(len(trace) - 1) // 2][1] < (1 + FALL_CONVERGED) * trace[-1][1],
    )


def _initialise(session: Session, params: ImplicitAdamParams) -> tuple[_Data, Unknowns]:
    body, obs, n = session.body, session.obs, len(session.trials)
    n_padded, frames = obs.has_phone.shape[0], obs.weight.shape[0]
    low, high, is_translation = fit_ranges(body.joint_names, np.asarray(body.joint_range_rad))
    if params.start == "keypoints":
        poses = [keypoint_start(session, i) for i in range(n)]
    else:
        poses = [paper_start(session, i, params.start_distance_m, 0.5 * (low + high)) for i in range(n)]
    start = np.stack([raw_of(q, low, high, is_translation) for q in poses])
    if session.moving:
        start = np.concatenate([start, [camera_start(session, i) for i in range(n)]], axis=1)

    duration = float(max(a.time_s[-1] - a.time_s[0] for a in session.arrays))
    omega = frequencies(duration, params.max_frequency_rad_s, params.pairs_per_octave)
    phone_time, phone_quat, phone_count = _phone_samples(session, n_padded)
    code = encode(np.concatenate([np.asarray(obs.time_s, np.float64), phone_time.ravel()]), omega)
    counts = np.flatnonzero(np.asarray(obs.weight) > 0)
    per_trial = np.bincount(np.asarray(obs.trial)[counts], minlength=n_padded)
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    i32 = functools.partial(jnp.asarray, dtype=jnp.int32)
    data = _Data(
        obs=obs,
        table=session.table,
        code=f32(code),
        order=i32(np.pad(counts, (0, frames - len(counts)))),
        first=i32(np.concatenate([[0], np.cumsum(per_trial)[:-1]])),
        count=i32(per_trial),
        phone_quat_wxyz=f32(phone_quat.reshape(-1, 4)),
        phone_count=i32(phone_count),
        start=f32(np.pad(start, [(0, n_padded - n), (0, 0)])),
        share=f32(np.pad(np.full(n, 1 / n), (0, n_padded - n))),
        low=f32(low),
        high=f32(high),
        is_translation=jnp.asarray(is_translation),
    )
    networks = initial_networks(params.seed, n_padded, len(omega), params.hidden, params.n_skip, start.shape[1])
    offset = np.zeros((session.table.weight.shape[0], 3), np.float32)
    return data, Unknowns(networks, np.zeros(8, np.float32), offset)  # type: ignore[arg-type]


def _phone_samples(session: Session, n_padded: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The sensor's own samples between frames that count: times (N, P) from each trial's start, orientations
    (N, P, 4), how many there are (N,)."""
    times, quats = [], []
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
    size = pad_frames(int(count.max())) if session.moving else 0
    time_s, quat = np.zeros((n_padded, size)), np.tile([1.0, 0, 0, 0], (n_padded, size, 1))
    for i, (t, q) in enumerate(zip(times, quats, strict=True)):
        time_s[i, : len(t)], quat[i, : len(t)] = t, q
    return time_s, quat, np.pad(count, (0, n_padded - len(count)))


def _numbers(body: Body, params: ImplicitAdamParams) -> _Numbers:
    cost, f32 = params.cost, functools.partial(jnp.asarray, dtype=jnp.float32)
    neutral, inverse_sd = prior_of(body.joint_names, cost.pose_prior_deg)
    return _Numbers(
        markers=MarkerWeights.of(cost),
        weight_phone=f32(cost.weight_phone),
        weight_offset_per_m2=f32(cost.weight_offset_per_m2),
        weight_pose=f32(cost.weight_pose),
        weight_scale=f32(cost.weight_scale),
        scale_sd=f32(cost.scale_sd),
        scale_sides_sd=f32(cost.scale_sides_sd),
        neutral=f32(neutral),
        inverse_sd=f32(inverse_sd),
        steps=f32(params.steps),
        rate_start=f32(params.learning_rate_start),
        log_decay=f32(math.log(params.learning_rate_end / params.learning_rate_start)),
        adam_b1=f32(params.adam_b1),
        weight_decay=f32(params.weight_decay),
        clip_norm=f32(params.clip_norm),
    )


def _shapes(unknowns: Unknowns) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(a.shape) for a in jax.tree.leaves(unknowns))


def _split(flat: Float[Array, " P"], shapes: tuple[tuple[int, ...], ...]) -> Unknowns:
    """The unknowns as views of the one vector."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    *layers, s, offset = (flat[e - math.prod(shape) : e].reshape(shape) for e, shape in zip(ends, shapes, strict=True))
    return Unknowns(list(zip(layers[::2], layers[1::2], strict=True)), s, offset)


def _qpos(raw: Float[Array, "*n O"], d: _Data) -> Float[Array, "*n 40"]:
    return pose_of(raw[..., :40], d.low, d.high, d.is_translation)


def _loss(
    unknowns: Unknowns, rows: Int[Array, "N B"], phone_rows: Int[Array, "N B"], d: _Data, w: _Numbers, static: _Static
) -> Array:
    """The cost on some frames and phone samples of each trial."""
    kinds, (n, b) = static.kinds, rows.shape
    index = rows
    if kinds.moving:
        index = jnp.concatenate([rows, d.obs.weight.shape[0] + phone_rows], axis=1)
    code = d.code.at[index].get(mode="promise_in_bounds")
    raw = evaluate(unknowns.networks, code) + d.start[:, None]
    qpos = _qpos(raw[:, :b], d).reshape(n * b, 40)
    seen = frames_at(d.obs, rows.reshape(-1))
    R_nc = seen.R_nc
    per_sample = jnp.repeat(d.share / b, b, total_repeat_length=n * b)
    shared = w.weight_offset_per_m2 * costs.offset_m2(unknowns.site_offset_m)
    if static.priors:
        shared += w.weight_scale * costs.scale_prior(unknowns.s, w.scale_sd, w.scale_sides_sd)
    if kinds.moving:
        turn = jaxlie.SO3.exp(raw[..., 40:])
        own = jaxlie.SO3(turn.wxyz[:, :b]).as_matrix().reshape(n * b, 1, 3, 3)
        measured = jnp.repeat(d.obs.has_phone, b, total_repeat_length=n * b) > 0
        R_nc = jnp.where(measured[:, None, None, None], own, R_nc)
        off = angle_between_deg(turn.wxyz[:, b:], d.phone_quat_wxyz.at[phone_rows].get(mode="promise_in_bounds"))
        shared += w.weight_phone * jnp.sum(off * (d.share * (d.phone_count > 0) / b)[:, None])
    scale = scale_multipliers(unknowns.s)
    x = jnp.moveaxis(chained_markers(static.body, d.table, qpos, scale, unknowns.site_offset_m), -1, 0)
    total = marker_cost(x, seen, R_nc, d.table, w.markers, kinds)
    if static.priors:
        total += 0.5 * w.weight_pose * jnp.sum(((qpos - w.neutral) * w.inverse_sd) ** 2, axis=-1)
    return jnp.sum(total * per_sample) + shared


def _draw(key: Array, d: _Data, static: _Static) -> tuple[Int[Array, "K N B"], Int[Array, "K N B"]]:
    """Frames and phone samples of each trial for all steps of a chunk, with replacement from those that count.

    A trial's draws do not depend on how many trials or frames there are.
    """
    shape = (2 if static.kinds.moving else 1, CHUNK, static.samples)
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(len(d.count)))
    u = jax.vmap(lambda k: jax.random.uniform(k, shape))(keys)

    def pick(u: Array, count: Array) -> Array:
        most = jnp.maximum(count - 1, 0)[:, None, None]
        return jnp.minimum((u * count[:, None, None]).astype(jnp.int32), most)

    place = d.first[:, None, None] + pick(u[:, 0], d.count)
    rows = jnp.swapaxes(d.order[jnp.minimum(place, len(d.order) - 1)], 0, 1)
    if not static.kinds.moving:
        return rows, rows
    size = len(d.phone_quat_wxyz) // len(d.count)
    phone = jnp.arange(len(d.count))[:, None, None] * size + pick(u[:, 1], d.phone_count)
    return rows, jnp.swapaxes(phone, 0, 1)


def adam_step(
    flat: Float[Array, " P"],
    mean: Float[Array, " P"],
    square: Float[Array, " P"],
    g: Float[Array, " P"],
    done: Array,
    n_decayed: int,
    w: _Numbers,
) -> tuple[Array, Array, Array]:
    """Adam (Kingma and Ba 2015) with the gradient's norm clipped and decoupled weight decay of the first unknowns.

    The rate falls exponentially with the steps `done`; from the last step on nothing moves.
    """
    g = g * (w.clip_norm / jnp.maximum(jnp.sqrt(jnp.sum(g**2)), w.clip_norm))
    mean = w.adam_b1 * mean + (1 - w.adam_b1) * g
    square = ADAM_B2 * square + (1 - ADAM_B2) * g**2
    count = (done + 1).astype(jnp.float32)
    unbiased = mean / (1 - w.adam_b1**count)
    spread = jnp.sqrt(square / (1 - ADAM_B2**count)) + ADAM_EPS
    decay = jnp.where(jnp.arange(flat.shape[0]) < n_decayed, w.weight_decay, 0.0) * flat
    rate = jnp.where(done < w.steps, w.rate_start * jnp.exp(w.log_decay * done / w.steps), 0.0)
    return flat - rate * (unbiased / spread + decay), mean, square


@functools.partial(jax.jit, static_argnames="static", donate_argnums=0)
def _run_chunk(carry, chunk: Array, key: Array, d: _Data, w: _Numbers, static: _Static):
    """`CHUNK` steps of Adam with weight decay on the networks; those beyond `steps` change no unknown."""
    size = sum(math.prod(shape) for shape in static.shapes)
    n_network = size - math.prod(static.shapes[-1]) - 8
    rows, phone_rows = _draw(jax.random.fold_in(key, chunk), d, static)

    def step(carry, drawn):
        flat, mean, square = carry
        done, rows, phone_rows = drawn
        loss, slope = jax.value_and_grad(_loss)(_split(flat, static.shapes), rows, phone_rows, d, w, static)
        g, _ = ravel_pytree(slope)
        return adam_step(flat, mean, square, g, done, n_network, w), loss

    done = chunk * CHUNK + jnp.arange(CHUNK)
    return jax.lax.scan(step, carry, (done, rows, phone_rows))


def _on_all_frames(session: Session, networks: Networks, d: _Data, static: _Static) -> tuple[np.ndarray, np.ndarray]:
    """qpos (F, 40) and R_nc (F, V, 3, 3) of every packed frame."""
    trial, n = np.asarray(session.obs.trial), len(d.count)
    rows = [np.flatnonzero(trial == i) for i in range(n)]
    size = pad_frames(max(len(r) for r in rows))
    index = np.stack([np.pad(r, (0, size - len(r))) for r in rows])
    raw = np.asarray(_raw(networks, d, jnp.asarray(index, jnp.int32)))
    out = np.concatenate([raw[i, : len(r)] for i, r in enumerate(rows)])[np.argsort(np.concatenate(rows))]
    qpos = np.asarray(_qpos(jnp.asarray(out), d), np.float64)
    R_nc = np.array(session.obs.R_nc, np.float64)
    if static.kinds.moving:
        measured = np.asarray(session.obs.has_phone)[trial] > 0
        R_nc[measured, 0] = np.asarray(jaxlie.SO3.exp(jnp.asarray(out[measured, 40:])).as_matrix(), np.float64)
    return qpos, R_nc


@jax.jit
def _raw(networks: Networks, d: _Data, index: Int[Array, "N T"]) -> Float[Array, "N T O"]:
    return evaluate(networks, d.code[index]) + d.start[:, None]
