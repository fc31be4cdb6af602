"""`implicit-adam`: the paper's optimisation (sections Implicit Representation and Model Fitting), static camera.

Every trial has its own network, all share one body. The steps run inside `lax.scan`; the host only counts them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError

from .. import _costs as costs
from .._params import CostParams, ImplicitAdamParams
from .._prior import prior_of
from .._problem import FitModel, Observations, Session
from .._start import keypoint_start, paper_start
from .._trajectory import ImplicitTrajectory, fit_ranges, frequencies, pose_of, raw_of
from ._solution import Solution

#: Steps per compiled call: the granularity of the progress bar and of the loss trace.
CHUNK = 250


class _Unknowns(eqx.Module):
    """Everything that is optimised. `networks` has a leading axis of N trials; `s`: the paper's 8 scale parameters."""

    networks: ImplicitTrajectory
    s: Float[Array, " 8"]
    site_offset_m: Float[Array, "J 3"]


class _Constants(eqx.Module):
    omega_rad_s: Float[Array, " F"]
    raw_start: Float[Array, "N 40"]
    low: Float[Array, " 40"]
    high: Float[Array, " 40"]
    is_translation: Array
    neutral: Float[Array, " 40"]
    inverse_sd: Float[Array, " 40"]
    marker_weight_3d: Float[Array, " J"]


def scale_multipliers(s: Float[Array, " 8"]) -> Float[Array, " 8"]:
    """Multipliers of the scale groups: 1 + overall for "overall", 1 + overall + own for the others."""
    return 1.0 + s[0] + jnp.concatenate([jnp.zeros(1, s.dtype), s[1:]])


def solve_implicit_adam(session: Session, params: ImplicitAdamParams) -> Solution:
    """Fit all trials of a session.

    Raises
    ------
    PblError
        FIT_DIVERGED when the loss or the result is not finite.
    """
    begin = time.perf_counter()
    unknowns, constants = _initialise(session, params)
    # The number of steps is data, not part of the compiled program: any number runs without compiling again.
    steps = jnp.asarray(params.steps, jnp.float32)
    fixed = dataclasses.replace(params, steps=0, seed=0)
    state = _optimiser(fixed, steps).init(eqx.filter(unknowns, eqx.is_array))
    key = jax.random.key(params.seed + 1)

    n_chunks, trace, compile_seconds = -(-params.steps // CHUNK), [], 0.0
    done = jnp.zeros((), jnp.int32)
    carry = (unknowns, state, key, done)
    with progress.bar("fit", total=params.steps) as update:
        for chunk in range(n_chunks):
            t0 = time.perf_counter()
            carry, losses = _run_chunk(carry, steps, session.obs, constants, session.model, fixed)
            losses = np.asarray(losses)
            if chunk == 0:
                compile_seconds = time.perf_counter() - t0
            elif chunk == 1:
                compile_seconds -= time.perf_counter() - t0
            kept = min(CHUNK, params.steps - chunk * CHUNK)
            loss = float(np.mean(losses[:kept]))
            trace.append((chunk * CHUNK + kept, loss))
            update(kept, note=f"loss {loss:.2f}")
            if not np.isfinite(loss):
                raise PblError(
                    "FIT_DIVERGED",
                    found=f"loss {loss} after {chunk * CHUNK + kept} steps",
                    expected="a finite loss",
                    next_step="check the keypoints and the camera matrix; report the keypoints file if both are sound",
                )
    solved = carry[0]
    qpos = np.asarray(_evaluate(solved.networks, session.obs.time_s, constants), np.float64)
    return Solution(
        qpos=qpos,
        scale=np.asarray(scale_multipliers(solved.s), np.float64),
        site_offset_m=np.asarray(solved.site_offset_m, np.float64),
        loss_trace=np.asarray(trace, np.float64),
        compile_seconds=max(compile_seconds, 0.0),
        seconds=time.perf_counter() - begin,
    )


def _initialise(session: Session, params: ImplicitAdamParams) -> tuple[_Unknowns, _Constants]:
    body, n = session.model.body, len(session.trials)
    low, high, is_translation = fit_ranges(body.joint_names, np.asarray(body.joint_range_rad))
    if params.start == "keypoints":
        poses = [keypoint_start(session, i) for i in range(n)]
    else:
        poses = [paper_start(session, params.start_distance_m, 0.5 * (low + high)) for _ in range(n)]
    raw_start = np.stack([raw_of(q, low, high, is_translation) for q in poses])
    duration = float(max(t.time_s[-1] - t.time_s[0] for t in session.trials))
    omega = frequencies(duration, params.max_frequency_rad_s, params.pairs_per_octave)
    keys = jax.random.split(jax.random.key(params.seed), n)
    networks = eqx.filter_vmap(
        lambda k: ImplicitTrajectory(len(omega), params.hidden, params.n_skip, len(body.joint_names), 0.1, key=k)
    )(keys)
    unknowns = _Unknowns(networks, jnp.zeros(8), jnp.zeros((len(session.model.markers.names), 3)))
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    neutral, inverse_sd = prior_of(body.joint_names, params.cost.pose_prior_deg)
    constants = _Constants(
        omega_rad_s=f32(omega),
        raw_start=f32(raw_start),
        low=f32(low),
        high=f32(high),
        is_translation=jnp.asarray(is_translation),
        neutral=f32(neutral),
        inverse_sd=f32(inverse_sd),
        marker_weight_3d=f32(session.model.markers.weight_3d),
    )
    return unknowns, constants


def _optimiser(params: ImplicitAdamParams, steps: ArrayLike) -> optax.GradientTransformation:
    log_decay = math.log(params.learning_rate_end / params.learning_rate_start)

    def rate(count: ArrayLike) -> Array:
        return params.learning_rate_start * jnp.exp(log_decay * count / steps)

    def network_only(tree: _Unknowns) -> Any:
        mask = jax.tree.map(lambda _: False, tree)
        return eqx.tree_at(lambda u: u.networks, mask, jax.tree.map(lambda _: True, tree.networks))

    return optax.chain(
        optax.clip_by_global_norm(params.clip_norm),
        optax.adamw(rate, b1=params.adam_b1, weight_decay=params.weight_decay, mask=network_only),
    )


def _qpos(networks: ImplicitTrajectory, time_s: Float[Array, "N B"], k: _Constants) -> Float[Array, "N B 40"]:
    def one_trial(network: ImplicitTrajectory, times: Float[Array, " B"]) -> Float[Array, "B 40"]:
        return jax.vmap(lambda t: network(t, k.omega_rad_s))(times)

    raw = eqx.filter_vmap(one_trial)(networks, time_s)
    return pose_of(raw + k.raw_start[:, None], k.low, k.high, k.is_translation)


@eqx.filter_jit
def _evaluate(networks: ImplicitTrajectory, time_s: Float[Array, "N T"], k: _Constants) -> Float[Array, "N T 40"]:
    return _qpos(networks, time_s, k)


def _loss(unknowns: _Unknowns, obs: Observations, k: _Constants, model: FitModel, cost: CostParams) -> Array:
    qpos = _qpos(unknowns.networks, obs.time_s, k)
    x = model.positions(qpos, scale_multipliers(unknowns.s), unknowns.site_offset_m)
    R_nc, matrix = obs.R_nc[:, None], obs.camera_matrix[:, None]
    d3 = costs.distance_3d_cm2(x, obs.x_cam, R_nc, obs.c, k.marker_weight_3d)
    e3 = costs.huber_of_square(d3, cost.huber_3d_cm)
    e2 = costs.huber_of_square(costs.distance_2d_px2(x, obs.xy_px, R_nc, matrix), cost.huber_2d_px)
    return (
        cost.weight_3d * costs.weighted_mean(e3, obs.c * k.marker_weight_3d, obs.frame_weight)
        + cost.weight_2d * costs.weighted_mean(e2, obs.c, obs.frame_weight)
        + cost.weight_offset_per_m2 * costs.offset_m2(unknowns.site_offset_m)
        + cost.weight_pose * costs.pose_prior(qpos, k.neutral, k.inverse_sd, obs.frame_weight)
        + cost.weight_scale * costs.scale_prior(unknowns.s, cost.scale_sd, cost.scale_sides_sd)
    )


def _sample(obs: Observations, n: int, key: Array) -> Observations:
    """`n` frames of each trial, drawn with replacement from those that count."""

    def draw(k: Array, weight: Float[Array, " T"]) -> Array:
        return jax.random.choice(k, weight.shape[0], (n,), p=weight / jnp.sum(weight))

    index = jax.vmap(draw)(jax.random.split(key, obs.time_s.shape[0]), obs.frame_weight)
    take = jax.vmap(lambda a, i: a[i])
    return Observations(
        time_s=take(obs.time_s, index),
        xy_px=take(obs.xy_px, index),
        x_cam=take(obs.x_cam, index),
        c=take(obs.c, index),
        frame_weight=take(obs.frame_weight, index),
        R_nc=obs.R_nc,
        camera_matrix=obs.camera_matrix,
    )


@functools.partial(jax.jit, static_argnames=("model", "params"), donate_argnums=0)
def _run_chunk(carry, steps: Array, obs: Observations, k: _Constants, model: FitModel, params: ImplicitAdamParams):
    """`CHUNK` steps of Adam; those beyond `steps` change nothing."""
    optimiser = _optimiser(params, steps)

    def step(carry, _):
        unknowns, state, key, done = carry
        key, draw = jax.random.split(key)
        batch = _sample(obs, params.samples_per_trial, draw)
        loss, gradient = jax.value_and_grad(_loss)(unknowns, batch, k, model, params.cost)
        updates, new_state = optimiser.update(gradient, state, unknowns)
        active = done < steps
        unknowns = jax.tree.map(lambda p, u: p + jnp.where(active, u, 0.0), unknowns, updates)
        state = jax.tree.map(lambda new, old: jnp.where(active, new, old), new_state, state)
        return (unknowns, state, key, done + 1), loss

    return jax.lax.scan(step, carry, length=CHUNK)
