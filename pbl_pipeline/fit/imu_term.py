"""Wearable sensors: the orientation of a segment and the one that a sensor on it measured.

With R the rotation of the segment, S that of the sensor on it, M what the sensor measured in its own world, A from that
world to the trial's, and b the gyroscope's bias, which turns M by exp(-B b) since the middle of the trial, the
error is log(R S (A exp(-B b) M)^-1). It comes from soft tissue, which has a memory, so each frame's error is compared
with the next one's.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, body_turns

from .feet_terms import later
from .linearised import cross_matrix, times
from .problem import CLOCK_RANGE_S, SAMPLE_S, Problem, State, Wearables
from .term import At, Segments, SharedTerm, Term, Unknowns, frame_count, square

#: Seconds for which the gain of a clock is stated.
MINUTE_S = 60.0


def segments_at(body: Body, p: Problem, state: State) -> Segments | None:
    """The segments with sensors of a problem at a state; None without sensors."""
    return None if p.wearables is None else Segments(*body_turns(body, p.wearables.body_index, state.qpos))


class _Errors(NamedTuple):
    """Rotation vectors (rad), in the world, from the measured to the fitted orientations of the sensors, and their
    derivatives by a turn of the segment (rotation vector, world) and by `mount`, `world`, `bias` and `clock` of each
    sensor (`Wearing`)."""

    r: Float[Array, "F m 3"]
    by_turn: Float[Array, "F m 3 3"]
    by_sensor: Float[Array, "F m 3 11"]


def _worn(at: At) -> Wearables:
    assert at.problem.wearables is not None
    return at.problem.wearables


def _errors(at: At) -> _Errors:
    """The error turns with a segment like `log(exp(d) X)`, whose derivative by d is that of the logarithm."""
    p, worn, state = at.problem, _worn(at), at.state.wearing
    assert state is not None
    assert at.segments is not None
    trial, R = p.trial, at.segments.rotation
    minutes = (p.time_s - worn.middle_s[trial]) / MINUTE_S
    measured, rate = _measured(worn, p, state.clock[trial, 0] + state.clock[trial, 1] * minutes)
    bias = -jnp.sum(worn.turned * state.bias[:, None, :], axis=-1)
    mount, own = _turned(state.mount, worn.mount), _turned(state.world, worn.world)[trial]
    drifted = times(own, jaxlie.SO3.exp(bias).as_matrix())
    X = times(times(R, mount), times(drifted, measured).swapaxes(-1, -2))
    r = jaxlie.SO3.from_matrix(X).log()
    by_turn = _log_slope(r)
    from_own = times(X, own)
    by_clock = -jnp.sum(times(X, drifted) * rate[..., None, :], axis=-1)[..., None]
    by_sensor = [
        times(R, _exp_slope(state.mount)[None]),
        -times(X, _exp_slope(state.world)[trial]),
        times(from_own, times(_exp_slope(bias), worn.turned)),
        by_clock,
        by_clock * minutes[:, None, None, None],
    ]
    return _Errors(r, by_turn, times(by_turn, jnp.concatenate(by_sensor, axis=-1)))


def _turned(w: Float[Array, "*n 3"], start: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    return (jaxlie.SO3.exp(w) @ jaxlie.SO3(start)).as_matrix()


def _measured(worn: Wearables, p: Problem, clock_s: Float[Array, " F"]) -> tuple[Array, Array]:
    """Rotations (F, m, 3, 3) that the sensors measured, and their rates (F, m, 3), in rad/s and the sensors' worlds."""
    place = (p.time_s + CLOCK_RANGE_S + clock_s) / SAMPLE_S
    place = jnp.clip(place, 0.0, worn.quat_wxyz.shape[2] - 1.001)
    i = jnp.floor(place).astype(jnp.int32)
    before, after = (worn.quat_wxyz[p.trial, :, k] for k in (i, i + 1))
    between = before + (place - i)[:, None, None] * (after - before)
    between /= jnp.linalg.norm(between, axis=-1, keepdims=True)
    turn = (jaxlie.SO3(after) @ jaxlie.SO3(before).inverse()).wxyz
    return jaxlie.SO3(between).as_matrix(), 2 * turn[..., 1:] / SAMPLE_S


def _exp_slope(w: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """J of exp(w + d) = exp(J d) exp(w), to first order in d."""
    angle2 = square(w)
    near = angle2 < 1e-4
    angle = jnp.sqrt(jnp.where(near, 1.0, angle2))
    first = jnp.where(near, 0.5, (1 - jnp.cos(angle)) / angle**2)
    return _polynomial(w, first, jnp.where(near, 1 / 6, (angle - jnp.sin(angle)) / angle**3))


def _log_slope(r: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Its inverse at r: J of log(exp(d) exp(r)) = r + J d."""
    angle2 = square(r)
    near = angle2 < 1e-4
    angle = jnp.sqrt(jnp.where(near, 1.0, angle2))
    second = jnp.where(near, 1 / 12, 1 / angle**2 - 0.5 / (angle * jnp.tan(0.5 * angle)))
    return _polynomial(r, -0.5 * jnp.ones_like(second), second)


def _polynomial(w: Float[Array, "*n 3"], first: Array, second: Array) -> Float[Array, "*n 3 3"]:
    """1 + first W + second W^2 with W the cross product with w."""
    W2 = w[..., :, None] * w[..., None, :] - square(w)[..., None, None] * jnp.eye(3)
    return jnp.eye(3) + first[..., None, None] * cross_matrix(w) + second[..., None, None] * W2


def whitened(at: At) -> tuple[Float[Array, "F m 3"], Float[Array, "F m 3 17"]]:
    """Each frame's error less what the next one's tells of it, in standard deviations, and its derivatives by turns of
    the segment in the frame and in the next one and by the unknowns of the sensor."""
    worn, here = _worn(at), _errors(at)
    there = _Errors(*(later(a) for a in here))
    size = 1 / (jnp.sqrt(1 - worn.follows**2) * worn.sd_rad)
    tells = (size * worn.follows)[..., None]
    size = size[..., None]
    by = [size[..., None] * here.by_turn, -tells[..., None] * there.by_turn]
    by.append(size[..., None] * here.by_sensor - tells[..., None] * there.by_sensor)
    return size * here.r - tells * there.r, jnp.concatenate(by, axis=-1)


def on_segments(at: At) -> Float[Array, "F m 3"]:
    """The errors as rotation vectors in the axes of the segments (rad)."""
    assert at.segments is not None
    return jnp.einsum("fmij,fmi->fmj", at.segments.rotation, _errors(at).r)


def _residual(at: At, z: Float[Array, "F m 17"]) -> Float[Array, "F m 3"]:
    """The whitened error after small changes z of what it depends on."""
    r, by = whitened(at)
    return r + jnp.sum(by * z[..., None, :], axis=-1)


def _prior(at: At) -> Array:
    worn, state, w = at.problem.wearables, at.state.wearing, at.weights
    assert worn is not None
    assert state is not None
    z2 = jnp.sum((state.mount / jnp.deg2rad(jnp.minimum(w["mount_sd_deg"], worn.mount_sd_deg))[:, None]) ** 2)
    z2 += jnp.sum((state.bias / worn.bias_sd_rad_s[:, None]) ** 2)
    z2 += jnp.sum((state.clock / jnp.stack([w["sensor_clock_sd_s"], w["sensor_gain_sd_s"]])) ** 2)
    # The vertical of a world is off by its own error and by that of the trial, which all sensors share; the heading is
    # free.
    level = worn.level_sd_rad[..., None] ** -2
    off = jnp.sum(level * state.world[..., :2], axis=1)
    common = worn.tilt_sd_rad**2 / (1 + worn.tilt_sd_rad**2 * jnp.sum(level[..., 0], axis=1))
    z2 += jnp.sum(level * state.world[..., :2] ** 2) - jnp.sum(common[:, None] * off**2)
    return 0.5 * worn.dispersion * z2 / frame_count(at.problem)


#: The weight of the sensors against the keypoints is that of a number whose standard deviation is known.
LIMU = Term(
    name="Limu",
    weight="weight_sensor",
    width="huber_sensor",
    unknowns=Unknowns.SEGMENT_IN_TWO_FRAMES,
    variables=lambda at: jnp.zeros((*_worn(at).count.shape, 17)),
    residual=_residual,
    count=lambda at: jnp.zeros(0) if at.problem.wearables is None else at.problem.wearables.count,
    frames=lambda at: at.problem.weight * _worn(at).dispersion,
)
WEARING = SharedTerm("sensor prior", "weight_sensor", _prior, empty=lambda at: at.state.wearing is None)
