"""The sensors of a session: before a fit, and what it found of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.errors import said

from .log import SEGMENTS, SensorLog
from .orientation import Orientation, input_error, oriented


@dataclasses.dataclass(frozen=True)
class Worn:
    """Sensors of a session. `clock_s`: their time at time 0 of each trial's video, None where it is not stated."""

    sensors: tuple[Orientation, ...]
    clock_s: tuple[float | None, ...]


@dataclasses.dataclass(frozen=True)
class SensorFit:
    """What a fit of N trials found of a sensor.

    `moves_with`: the segment whose motion it shows, the stated one unless another is much more likely. `mounting`:
    rotation from its axes to the segment's (quaternion, scalar first); `bias_rad_s` (3,) of its gyroscope, beyond what
    its own filter took off; `heading_rad`, `tilt_rad` (N,): of its world in that of the trial's camera; `clock_s` (N,):
    its time at the video's time 0, and `gain` (N,): how much faster it runs, as a share; `z` (N,): root mean square of
    its error in standard deviations, 1 if it moves on its segment as people's do; `dropped` (N,): share of the frames
    in which it was not measured or errs by more than the Huber width; `slip` (N,): how far it turned on its segment
    from the first to the last third, over what soft tissue makes likely; `rate_rad_s` (N,): root mean square of its
    angular velocity.
    """

    name: str
    segment: str
    moves_with: str
    mounting: np.ndarray
    bias_rad_s: np.ndarray
    heading_rad: np.ndarray
    tilt_rad: np.ndarray
    clock_s: np.ndarray
    gain: np.ndarray
    z: np.ndarray
    dropped: np.ndarray
    slip: np.ndarray
    rate_rad_s: np.ndarray


def worn(logs: Sequence[SensorLog], clock_s: Sequence[float | None] | None, n_trials: int) -> Worn | None:
    """Check logs for a session of some trials and find the sensors' orientations; None without logs.

    Raises `PblError` FIT_INPUT (a segment that is unknown or named twice, clocks for another number of trials, a log
    without usable samples).
    """
    if not logs:
        return None
    segments = [log.segment for log in logs]
    unknown = sorted({s for s in segments if s not in SEGMENTS})
    twice = sorted({s for s in segments if segments.count(s) > 1})
    if unknown or twice:
        raise input_error(f"sensors on {', '.join(unknown or twice)}", f"each once: {', '.join(SEGMENTS)}")
    clocks = [0.0 if n_trials == 1 else None] * n_trials if clock_s is None else list(clock_s)
    if len(clocks) != n_trials:
        raise input_error(said("{n} clocks of sensors", n=len(clocks)), said("one for each of {n} trials", n=n_trials))
    return Worn(tuple(oriented(log) for log in logs), tuple(clocks))
