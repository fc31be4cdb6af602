"""The sensors of a session: before a fit, and what it found of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from pbl_pipeline.errors import said

from .log import SEGMENTS, SensorLog
from .orientation import Orientation, input_error, oriented
from .start import Stated


@dataclasses.dataclass(frozen=True)
class Worn:
    """Sensors of a session. `clock_s`: what is stated of their time at time 0 of each trial's video."""

    sensors: tuple[Orientation, ...]
    clock_s: tuple[Stated, ...]


def worn(logs: Sequence[SensorLog], clock_s: Sequence[Stated] | None, n_trials: int) -> Worn | None:
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
    stated = [0.0 if n_trials == 1 else None] * n_trials if clock_s is None else clock_s
    clocks: list[Stated] = [c if c is None or isinstance(c, tuple) else float(c) for c in stated]
    if len(clocks) != n_trials:
        raise input_error(said("{n} clocks of sensors", n=len(clocks)), said("one for each of {n} trials", n=n_trials))
    return Worn(tuple(oriented(log) for log in logs), tuple(clocks))
