"""The log of one wearable sensor, whatever program wrote it."""

from dataclasses import dataclass

import numpy as np

SEGMENTS = ("pelvis", "thigh_r", "thigh_l", "shank_r", "shank_l", "foot_r", "foot_l")
"""The segments of the body that a sensor can be worn on."""


@dataclass(frozen=True)
class SensorLog:
    """What one sensor measured: one row for each of its T samples, in the axes of the sensor, times increasing.

    `time` is in seconds of one clock of all sensors of a visit, from the start of the first one; `started_utc` says
    when that was, where the file says it. A quantity that the sensor does not give is `None`, a sample that is missing
    is NaN in its row. `orientation` takes vectors of the sensor to a world whose third axis points up; the direction of
    its first axis is free.
    """

    name: str
    segment: str
    time: np.ndarray  # (T,) s
    rate: np.ndarray | None  # (T, 3) rad/s
    acceleration: np.ndarray | None  # (T, 3) m/s2, of a sensor at rest 9.81 upwards
    orientation: np.ndarray | None  # (T, 4) unit quaternion, scalar first
    started_utc: float | None = None  # s since 1970, of time 0
    notes: tuple[str, ...] = ()  # remarks: samples that were left out, differences from the file's own statements
    mounting: np.ndarray | None = None  # (4,) unit quaternion from its axes to the segment's, as the file states it
