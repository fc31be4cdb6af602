"""Wearable sensors: the orientation of a segment and the one that a sensor on it measured.

With R the rotation of the segment, S that of the sensor on it, M what the sensor measured in a world of its own, A from
that world to the trial's, and b the gyroscope's bias, which turns M by exp(-B b) since the middle of the trial, the
error is log(R S (A exp(-B b) M)^-1). It comes from soft tissue, which has a memory, so each frame's error is compared
with the next one's.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, body_turns

from .feet_terms import later
from .problem import CLOCK_RANGE_S, SAMPLE_S, Problem, State, Wearables
from .term import At, Segments, SharedTerm, Term, Unknowns, frame_count

#: Seconds for which the gain of a clock is stated.
MINUTE_S = 60.0


def segments_at(body: Body, p: Problem, state: State) -> Segments | None:
    """The segments with sensors of a problem at a state; None without sensors."""
    return None if p.wearables is None else Segments(*body_turns(body, p.wearables.body_index, state.qpos))


def _exp(w: Float[Array, "*n 3"]) -> jaxlie.SO3:
    return jaxlie.SO3.exp(w)


def error_rad(
    at: At, worn: Wearables, turn: Float[Array, "F m 3"], shared: Float[Array, "F m 11"]
) -> Float[Array, "F m 3"]:
    """Rotation vectors, in the world, from the measured to the fitted orientations of the sensors.

    turn: a change of the segments' rotations; shared: `mount`, `world`, `bias` and `clock` of each sensor (`Wearing`).
    """
    assert at.segments is not None
    p, n = at.problem, worn.quat_wxyz.shape[2]
    mount, world, bias, clock = (shared[..., i:j] for i, j in ((0, 3), (3, 6), (6, 9), (9, 11)))
    segment = _exp(turn) @ jaxlie.SO3.from_matrix(at.segments.rotation)
    sensor = _exp(mount) @ jaxlie.SO3(jnp.broadcast_to(worn.mount, (*turn.shape[:2], 4)))
    own = _exp(world) @ jaxlie.SO3(worn.world[p.trial])
    gained = clock[..., 1] * ((p.time_s - worn.middle_s[p.trial]) / MINUTE_S)[:, None]
    place = (p.time_s[:, None] + CLOCK_RANGE_S + clock[..., 0] + gained) / SAMPLE_S
    place = jnp.clip(place, 0.0, n - 1.001)
    i = jnp.floor(place).astype(jnp.int32)
    here = p.trial[:, None], jnp.arange(i.shape[1])
    before, after = (jaxlie.SO3(worn.quat_wxyz[(*here, k)]) for k in (i, i + 1))
    measured = _exp((after @ before.inverse()).log() * (place - i)[..., None]) @ before
    drift = _exp(-jnp.sum(worn.turned * bias[..., None, :], axis=-1))
    return (segment @ sensor @ (own @ drift @ measured).inverse()).log()


def _variables(at: At) -> Float[Array, "F m 17"]:
    """Turns of a segment in a frame and the next one, both 0, and the unknowns of the sensor."""
    worn, state = at.problem.wearables, at.state.wearing
    if worn is None or state is None:
        return jnp.zeros((0, 0, 17))
    frames, m = worn.count.shape
    trial = at.problem.trial
    of_frames = [state.mount[None], state.world[trial], state.bias[None], state.clock[trial][:, None]]
    return jnp.concatenate(
        [jnp.zeros((frames, m, 6)), *(jnp.broadcast_to(a, (frames, m, a.shape[-1])) for a in of_frames)], axis=-1
    )


def _residual(at: At, z: Float[Array, "F m 17"]) -> Float[Array, "F m 3"]:
    """Each frame's error less what the next one's tells of it, in standard deviations."""
    worn = at.problem.wearables
    assert worn is not None
    here = error_rad(at, worn, z[..., :3], z[..., 6:])
    ahead = at._replace(problem=_next_frames(at.problem), segments=Segments(*(later(a) for a in at.segments or ())))
    assert ahead.problem.wearables is not None
    there = error_rad(ahead, ahead.problem.wearables, z[..., 3:6], z[..., 6:])
    follows = worn.follows[..., None]
    return (here - follows * there) / (jnp.sqrt(1 - follows**2) * worn.sd_rad[:, None])


def error_of_sensors(at: At) -> Float[Array, "F m 3"]:
    """Each frame's error less what the next one's tells of it, in standard deviations."""
    return _residual(at, _variables(at))


def _next_frames(p: Problem) -> Problem:
    """The problem of the next frames, as far as sensors see it."""
    assert p.wearables is not None
    worn = dataclasses.replace(p.wearables, turned=later(p.wearables.turned))
    return dataclasses.replace(p, time_s=later(p.time_s), trial=later(p.trial), wearables=worn)


def _prior(at: At) -> Array:
    worn, state, w = at.problem.wearables, at.state.wearing, at.weights
    if worn is None or state is None:
        return jnp.zeros(())
    z2 = jnp.sum((state.mount / jnp.deg2rad(w["mount_sd_deg"])) ** 2)
    z2 += jnp.sum((state.bias / jnp.deg2rad(w["bias_sd_deg_s"])) ** 2)
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
    variables=_variables,
    residual=_residual,
    count=lambda at: jnp.zeros(0) if at.problem.wearables is None else at.problem.wearables.count,
    frames=lambda at: at.problem.weight * at.problem.wearables.dispersion,
)
WEARING = SharedTerm("sensor prior", "weight_sensor", _prior)
