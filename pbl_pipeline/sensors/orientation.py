"""Orientation of a sensor over time, from its gyroscope and accelerometer or as it states it.

Magnetometers are not used: iron in floors and treadmills turns a heading by tens of degrees. So the heading of the
sensor's world is free, and drifts slowly with the gyroscope's bias; a fit has both as unknowns.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp
from vqf import offlineVQF

from pbl_pipeline.errors import PblError, as_said, said

from .log import SensorLog

#: Longest gap (s) between samples that is bridged.
BRIDGED_S = 0.05
#: Interval (s) of the orientations of a trial.
SAMPLE_S = 0.01
#: Fewest samples of an unbroken run; and the time (s) below which the filter does not settle.
FEWEST, SETTLES_S = 20, 8.0


@dataclasses.dataclass(frozen=True)
class Orientation:
    """Rotations of a sensor, its axes to a world whose z is up, in unbroken runs of samples.

    runs: of each, times (T,) in s of the log, increasing, and quaternions (T, 4), scalar first. Each run has its own
    heading.
    """

    log: SensorLog
    runs: tuple[tuple[np.ndarray, np.ndarray], ...]

    def part(self, time: Float[np.ndarray, " T"]) -> Orientation:
        """The one run that holds most of some times (s of the log)."""
        best = max(self.runs, key=lambda run: int(np.sum((time >= run[0][0]) & (time <= run[0][-1]))))
        return dataclasses.replace(self, runs=(best,))

    def at(self, time: Float[np.ndarray, " T"]) -> tuple[Float[np.ndarray, "T 4"], Bool[np.ndarray, " T"]]:
        """Quaternions at times (s of the log), without jumps of sign, and which were measured: those in their
        `part`."""
        ((t, quat),) = self.part(time).runs
        turns = Slerp(t, Rotation.from_quat(quat, scalar_first=True))(np.clip(time, t[0], t[-1]))
        quat = turns.as_quat(scalar_first=True)
        jumps = np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0, -1.0, 1.0)
        quat[1:] *= np.cumprod(jumps)[:, None]
        return quat, (time >= t[0]) & (time <= t[-1])

    @property
    def settled(self) -> bool:
        """True if the gyroscope's bias was found: by the filter, or by the sensor's own."""
        return self.log.rate is None or min(t[-1] - t[0] for t, _ in self.runs) >= SETTLES_S

    @property
    def span(self) -> tuple[float, float]:
        """First and last time (s of the log)."""
        return self.runs[0][0][0], self.runs[-1][0][-1]


def oriented(log: SensorLog) -> Orientation:
    """Return the orientation of a sensor: from rate and acceleration by a filter that runs over the log in both
    directions and estimates the gyroscope's bias (VQF, Laidig and Seel, Information Fusion 91, 2023), else its own.

    Raises `PblError` FIT_INPUT: neither is there, or no run of samples is long enough.
    """
    inertial = log.rate is not None and log.acceleration is not None
    if not inertial and log.orientation is None:
        raise log_error(log, "neither rate and acceleration nor orientation", "one of these")
    columns: Any = [log.rate, log.acceleration] if inertial else [log.orientation]
    values = np.hstack(columns)
    known = np.isfinite(values).all(axis=1)
    time, values = log.time[known], values[known]
    cuts = np.flatnonzero(np.diff(time) > BRIDGED_S + _interval(time)) + 1
    runs = [
        (t, _filtered(t, v)) if inertial else (t, v / np.linalg.norm(v, axis=1, keepdims=True))
        for t, v in zip(np.split(time, cuts), np.split(values, cuts), strict=True)
        if len(t) >= FEWEST
    ]
    if not runs:
        raise log_error(log, said("{n} usable samples", n=len(time)), said("runs of at least {n}", n=FEWEST))
    return Orientation(log, tuple(runs))


def rate_of(quat: Float[np.ndarray, "T 4"], step: float = SAMPLE_S) -> Float[np.ndarray, "T 3"]:
    """Angular velocity (rad/s) in the turning axes, from quaternions at even times: central differences."""
    turn = Rotation.from_quat(quat, scalar_first=True)
    between = (turn[:-2].inv() * turn[2:]).as_rotvec() / (2 * step)
    return np.concatenate([between[:1], between, between[-1:]])


def _interval(time: np.ndarray) -> float:
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def _filtered(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Quaternions (T, 4) of a run's rates and accelerations (T, 6), which the filter takes at even times."""
    even = np.linspace(time[0], time[-1], len(time))
    values = np.stack([np.interp(even, time, v) for v in values.T], axis=1)
    rate, acceleration = (np.ascontiguousarray(values[:, k : k + 3]) for k in (0, 3))
    step = even[1] - even[0]
    if even[-1] - even[0] < SETTLES_S:
        turns = _strapdown(rate, acceleration, step)
    else:
        # The filter turns by each rate over the time before its sample.
        rate[1:] = 0.5 * (rate[:-1] + rate[1:])
        turns = Rotation.from_quat(offlineVQF(rate, acceleration, None, step)["quat6D"], scalar_first=True)
    return Slerp(even, turns)(time).as_quat(scalar_first=True)


def _strapdown(rate: np.ndarray, acceleration: np.ndarray, step: float) -> Rotation:
    """Integrated rates, in a world in which the mean acceleration points up."""
    turns = [Rotation.identity()]
    for turn in Rotation.from_rotvec(0.5 * (rate[:-1] + rate[1:]) * step):
        turns.append(turns[-1] * turn)
    turned = Rotation.concatenate(turns)
    up = turned.apply(acceleration).mean(axis=0)
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0] * turned


def input_error(found: str, expected: str, next_step: str = "check the logs of the sensors (docs/imu.md)") -> PblError:
    return PblError("FIT_INPUT", found=found, expected=expected, next_step=next_step)


def log_error(log: SensorLog, found: str, expected: str, *next_step: str) -> PblError:
    """Return the error FIT_INPUT about a log."""
    on = as_said(log.segment)
    about = said("sensor {name} on {segment}: {found}", name=log.name, segment=on, found=as_said(found))
    return input_error(about, expected, *next_step).about(log.name)
