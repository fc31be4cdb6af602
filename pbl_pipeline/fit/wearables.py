"""Logs of wearable sensors on their way into a fit, and what it found of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body, body_frames, scale_multipliers
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results import SensorFit
from pbl_pipeline.sensors.orientation import Orientation, input_error, log_error, rate_of
from pbl_pipeline.sensors.pairing import better_pairing
from pbl_pipeline.sensors.start import BODY_OF, Moved, clock_of, moved, vectors, verticals, wahba

from .imu_term import MINUTE_S, on_segments, segments_at, whitened
from .problem import CLOCK_RANGE_S, FRAME_S, SAMPLE_S, Problem, State, Wearables, Wearing, pad_samples
from .session import LEVEL, Session
from .term import At

#: Standard deviation (deg, each axis) of a sensor's orientation on its segment: soft tissue, measured on recorded walks
#: with markers and sensors; and its correlation over 1/30 s.
WOBBLE_DEG = {"pelvis": 2.0, "thigh": 2.7, "shank": 2.0, "foot": 2.5}
MEMORY = 0.8
#: That memory in seconds; and what a sensor turns in the mean over a recording (standard deviation of the whole angle).
MEMORY_S, SLIP_SD_RAD = 0.15, np.deg2rad(2.0)
#: Standard deviations (deg) of the vertical of a sensor's world, and of a camera's that was taken as level.
LEVEL_SD_DEG, TILT_SD_DEG = 1.5, 5.0
#: Standard deviation (deg, each axis) of a mounting that is stated.
STATED_MOUNT_SD_DEG = 5.0
#: Angle (deg) of a vertical by a stated mounting to the video's from which on the mounting is refused.
MOUNT_OFF_DEG = 45.0
#: Standard deviation (deg/s) of a gyroscope's bias, before and after a filter found it.
BIAS_SD_DEG_S = 1.0, 0.4
#: Change of velocity (m/s) by which the mean acceleration of a short log tilts the vertical.
SPEED_M_PER_S = {"pelvis": 0.3, "thigh": 0.7, "shank": 1.5, "foot": 2.5}
#: Time (s) around a frame in which a sensor must have been measured: the clock's start may be off by so much.
AROUND_S = 0.05


#: Joints by the beginning of their names -> the segments on their two sides, "_r" and "_l" left out, and the share of
#: the least standard deviation that is left where sensors are on none, one and both of them. Such that 90 % intervals
#: held 85 to 95 % of the samples of four synthetic persons from the side and the front, where both views allow it.
#: Sensors show how an angle changes: a detector's constant error stays, which is most of it at the hip's rotation.
FLOOR_SHARES = {
    "hip_flexion": (("pelvis", "thigh"), (1.0, 0.8, 0.7)),
    "hip_adduction": (("pelvis", "thigh"), (1.0, 0.67, 0.62)),
    "hip_rotation": (("pelvis", "thigh"), (1.0, 0.75, 0.7)),
    "knee_": (("thigh", "shank"), (1.0, 0.8, 0.61)),
    "ankle_": (("shank", "foot"), (1.0, 0.9, 0.75)),
}


def floor_shares(joint_names: Sequence[str], segments: Sequence[str]) -> Float[np.ndarray, " Q"]:
    """Shares of the joints' least standard deviations that are left with sensors on some segments."""
    out = np.ones(len(joint_names))
    for i, name in enumerate(joint_names):
        for start, (sides, shares) in FLOOR_SHARES.items():
            if name.startswith(start):
                out[i] = shares[sum(k in segments or f"{k}{name[-2:]}" in segments for k in sides)]
    return out


def shares_of_floors(session: Session, p: Problem) -> Float[np.ndarray, "F Q"]:
    """`floor_shares` in each frame, of the sensors that were measured in most of its trial."""
    assert session.worn is not None
    assert p.wearables is not None
    count, names = np.asarray(p.wearables.count), session.body.joint_names
    out = np.ones((len(count), len(names)))
    for i, arrays in enumerate(session.arrays):
        measured = 2 * count[session.frames(i)].sum(axis=0) > arrays.used.sum()
        segments = [s.log.segment for s, most in zip(session.worn.sensors, measured, strict=True) if most]
        out[session.frames(i)] = floor_shares(names, segments)
    return out


def with_wearables(
    session: Session, p: Problem, start: State, dispersion: float
) -> tuple[Problem, State, tuple[str, ...]]:
    """Add sensors to a problem, with their start by a solution without them; and the segments they move with.

    A trial that the logs do not reach is fitted without. Raises `PblError` FIT_INPUT: they reach none.
    """
    assert session.worn is not None
    sensors, body = session.worn.sensors, session.body
    seen = [_moved(body, session, i, start) for i in range(len(session.arrays))]
    clocks = _clocks(session, seen)
    mounts = [_mount(session.names, seen, clocks, sensor) for sensor in sensors]
    m, frames, n = len(sensors), len(p.weight), len(p.has_phone)
    longest = max(a.time_s[-1] - a.time_s[0] for a in session.arrays)
    needed = int(np.ceil((longest + 2 * CLOCK_RANGE_S) / SAMPLE_S)) + 2
    quats = np.tile([1.0, 0, 0, 0], (n, m, pad_samples(needed), 1))
    world = np.tile([1.0, 0, 0, 0], (n, m, 1))
    turned, count = np.zeros((frames, m, 3, 3)), np.zeros((frames, m))
    follows, level, middle = np.zeros((frames, m)), np.full((n, m), np.deg2rad(LEVEL_SD_DEG)), np.zeros(n)
    settled = np.ones(m, int)
    for i, (arrays, clock) in enumerate(zip(session.arrays, clocks, strict=True)):
        at, time = session.frames(i), arrays.time_s - arrays.time_s[0]
        middle[i] = time[-1] / 2
        grid = np.arange(needed) * SAMPLE_S - CLOCK_RANGE_S
        for j, sensor in enumerate(sensors):
            part = sensor.part(grid + arrays.time_s[0] + clock)
            quat, known = part.at(grid + arrays.time_s[0] + clock)
            settled[j] &= part.settled or not known.any()
            quats[i, j, :needed], quats[i, j, needed:] = quat, quat[-1]
            measured = all_around(grid, known, time)
            count[at, j] = measured & arrays.used
            R = Rotation.from_quat(quat, scalar_first=True).as_matrix()
            total = np.cumsum(R, axis=0) * SAMPLE_S
            row = np.clip(((time + CLOCK_RANGE_S) / SAMPLE_S).round().astype(int), 0, needed - 1)
            turned[at, j] = total[row] - total[int((middle[i] + CLOCK_RANGE_S) / SAMPLE_S)]
            world[i, j] = _heading(seen[i], clock, sensor, mounts[j])
            level[i, j] = np.hypot(level[i, j], _speed_error(part))
        pair = np.append(np.diff(time), 1.0)[:, None]
        both = count[at] * np.append(count[at][1:], np.zeros((1, m)), axis=0)
        follows[at] = both * MEMORY ** (pair / FRAME_S)
    kinds = [s.log.segment.split("_")[0] for s in sensors]
    values: dict[str, Any] = {
        "quat_wxyz": quats,
        "turned": turned,
        "count": count,
        "follows": follows,
        "mount": Rotation.from_matrix(mounts).as_quat(scalar_first=True),
        "mount_sd_deg": np.array([np.inf if s.log.mounting is None else STATED_MOUNT_SD_DEG for s in sensors]),
        "world": world,
        "sd_rad": np.deg2rad([WOBBLE_DEG[k] for k in kinds]),
        "bias_sd_rad_s": np.deg2rad(BIAS_SD_DEG_S)[settled],
        "level_sd_rad": level,
        "tilt_sd_rad": np.pad(
            [np.deg2rad(TILT_SD_DEG) * (o == LEVEL) for o in session.orientation], (0, n - len(clocks))
        ),
        "middle_s": middle,
        "clock_s": np.pad(clocks, (0, n - len(clocks))),
        "dispersion": dispersion,
    }
    index: Any = np.asarray([body.body_names.index(BODY_OF[s.log.segment]) for s in sensors], np.int32)
    zeros: Any = [np.zeros(shape, np.float32) for shape in ((m, 3), (n, m, 3), (m, 3), (n, 2))]
    packed: dict[str, Any] = {k: np.asarray(v, np.float32) for k, v in values.items()}
    wearables = Wearables(index, **packed)
    fullest = max(range(len(seen)), key=lambda i: count[session.frames(i)].sum())
    moves_with = better_pairing(seen[fullest], clocks[fullest], sensors)
    return dataclasses.replace(p, wearables=wearables), dataclasses.replace(start, wearing=Wearing(*zeros)), moves_with


def all_around(grid: np.ndarray, known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Times at whose sides, `AROUND_S` away, a sensor is known."""
    at = lambda t: known[np.clip(((t - grid[0]) / SAMPLE_S).round().astype(int), 0, len(grid) - 1)]  # noqa: E731
    return at(time - AROUND_S) & at(time + AROUND_S)


def _moved(body: Body, session: Session, i: int, state: State) -> Moved:
    """The segments of a trial, from its first to its last frame that counts."""
    arrays, at = session.arrays[i], session.frames(i)
    first, last = np.flatnonzero(arrays.used)[[0, -1]]
    qpos = np.asarray(state.qpos, float)[at][first : last + 1]
    frames = body_frames(body, qpos, np.asarray(scale_multipliers(state.s), float))
    index = {k: body.body_names.index(name) for k, name in BODY_OF.items()}
    return moved(
        arrays.time_s[first : last + 1],
        {k: frames.rotation[:, b] for k, b in index.items()},
        {k: frames.position_m[:, b] for k, b in index.items()},
    )


def _clocks(session: Session, seen: Sequence[Moved]) -> list[float]:
    """Times of the logs at the trials' time 0; after their end for a trial that they do not reach."""
    assert session.worn is not None
    clocks, errors = [max(s.span[1] for s in session.worn.sensors) + 1e3] * len(seen), []
    for i, s in enumerate(seen):
        try:
            clocks[i] = _clock(session, i, s)
        except PblError as error:
            errors.append(error)
    if len(errors) == len(seen):
        raise errors[0]
    return clocks


def _clock(session: Session, i: int, seen: Moved) -> float:
    assert session.worn is not None
    try:
        return clock_of(seen, session.worn.sensors, session.worn.clock_s[i])[0]
    except ValueError as error:
        spans = [s.span for s in session.worn.sensors]
        raise input_error(
            said(
                "sensors measured together from {a:.1f} to {b:.1f} s",
                a=max(s[0] for s in spans),
                b=min(s[1] for s in spans),
            ),
            said("one time in them at which trial {name} fits", name=session.names[i]),
            "pass the log of this recording and state when it started in the log's time: strides are alike",
        ) from error


def _mount(names: Sequence[str], seen: Sequence[Moved], clocks: Sequence[float], sensor: Orientation) -> np.ndarray:
    """The rotation (3, 3) from a sensor to its segment: the stated one, or as they move. Raises `PblError` FIT_INPUT
    for a stated one that contradicts gravity in a trial."""
    segment = sensor.log.segment
    reached = [(n, s, c) for n, s, c in zip(names, seen, clocks, strict=True) if sensor.at(s.time + c)[1].any()]
    if sensor.log.mounting is None:
        return wahba([pair for _, s, c in reached for pair in vectors(s, c, sensor, segment)])
    mount = Rotation.from_quat(sensor.log.mounting, scalar_first=True)
    for trial, s, clock in reached:
        ours, theirs = (v.mean(axis=0) for v in verticals(s, clock, sensor, segment))
        theirs = mount.apply(theirs)
        off = np.degrees(np.arccos(ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs)))
        if off > MOUNT_OFF_DEG:
            about = said("a stated mounting that is {off:.0f} deg off gravity in trial {trial}", off=off, trial=trial)
            expected = "a mounting from the sensor's axes to the segment's (docs/imu.md)"
            raise log_error(sensor.log, about, expected, "correct it, or leave it out")
    return mount.as_matrix()


def _heading(seen: Moved, clock: float, sensor: Orientation, mount: np.ndarray) -> np.ndarray:
    """The rotation about the vertical (quaternion) from a sensor's world to the trial's."""
    quat, known = sensor.at(seen.time + clock)
    ours = Rotation.from_matrix(seen.rotation[sensor.log.segment]) * Rotation.from_matrix(mount)
    mean = (ours * Rotation.from_quat(quat, scalar_first=True).inv()).as_matrix()[known].sum(axis=0)
    yaw = np.arctan2(mean[1, 0] - mean[0, 1], mean[0, 0] + mean[1, 1])
    return Rotation.from_rotvec([0.0, 0.0, yaw]).as_quat(scalar_first=True)


def _speed_error(sensor: Orientation) -> float:
    """Error (rad) of a sensor's vertical because its speed changes over the log."""
    return SPEED_M_PER_S[sensor.log.segment.split("_")[0]] / (9.81 * (sensor.span[1] - sensor.span[0]))


@functools.partial(jax.jit, static_argnames="body")
def _errors(body: Body, p: Problem, end: State) -> tuple[Array, Array]:
    """Errors of the sensors (F, m, 3): whitened, and as turns on their segments."""
    none: Any = None
    at = At(p, none, end, none, none, None, segments_at(body, p, end))
    return whitened(at)[0], on_segments(at)


def sensor_fits(
    session: Session, p: Problem, end: State, width: float, moves_with: Sequence[str]
) -> tuple[tuple[SensorFit, ...], ...]:
    """Results of a solution for the sensors in each trial."""
    worn, state, given = p.wearables, jax.tree.map(np.asarray, end.wearing), session.worn
    assert worn is not None
    assert given is not None
    errors, turned = (np.asarray(a) for a in _errors(session.body, p, end))
    z = np.linalg.norm(errors, axis=-1)
    turn = lambda more, q: Rotation.from_rotvec(more) * Rotation.from_quat(q, scalar_first=True)  # noqa: E731

    def of_trial(i: int, j: int, sensor: Orientation) -> SensorFit:
        at, used = session.frames(i), session.arrays[i].used
        measured = np.asarray(worn.count)[at, j] > 0
        size, off = z[at, j][measured], turned[at, j][measured]
        R, bounds = turn(state.world[i, j], worn.world[i, j]).as_matrix(), given.clock_s[i]
        found = SensorFit(
            segment=sensor.log.segment,
            name=sensor.log.name,
            moves_with=moves_with[j],
            mounting=turn(state.mount[j], worn.mount[j]).as_quat(scalar_first=True),
            bias_rad_s=state.bias[j],
            heading_rad=float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])),
            tilt_rad=float(np.arccos(np.clip(R[2, 2], -1, 1))),
            **dict.fromkeys(("clock_s", "off_s", "z", "slip", "rate_rad_s"), np.nan),
            gain=float(state.clock[i, 1] / MINUTE_S),
            dropped=1.0,
        )
        if not len(size):
            return found
        third = -(-len(off) // 3)
        seconds = 2 * float(worn.middle_s[i]) / 3
        likely = np.hypot(SLIP_SD_RAD, float(worn.sd_rad[j]) * np.sqrt(12 * MEMORY_S / seconds))
        slip = np.linalg.norm(off[-third:].mean(axis=0) - off[:third].mean(axis=0)) / likely
        first, last = (int((t + CLOCK_RANGE_S) / SAMPLE_S) for t in (0.0, 2 * float(worn.middle_s[i])))
        rate = rate_of(np.asarray(worn.quat_wxyz, float)[i, j, first : last + 1])
        clock = float(worn.clock_s[i] + state.clock[i, 0])
        return dataclasses.replace(
            found,
            clock_s=clock,
            off_s=clock - float(np.clip(clock, *bounds)) if isinstance(bounds, tuple) else np.nan,
            z=float(np.sqrt(np.mean(size**2) / 3)),
            dropped=float(1 - np.sum(size < width) / np.sum(used)),
            slip=float(slip),
            rate_rad_s=float(np.sqrt(np.mean(np.sum(rate**2, axis=1)))),
        )

    return tuple(tuple(of_trial(i, j, s) for j, s in enumerate(given.sensors)) for i in range(len(session.arrays)))
