"""Cadence, stride and step time, stance, swing and double support from cycles."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ._cycles import GaitCycle
from .events import LEFT, RIGHT

#: Measures in the order of metrics.json; the unit is in the name.
MEASURES: tuple[str, ...] = (
    "cadence_steps_per_min",
    "stride_time_s",
    "step_time_s",
    "stance_percent",
    "swing_percent",
    "double_support_percent",
    "double_support_time_s",
    "speed_m_per_s",
    "stride_length_m",
    "step_width_m",
)
_NO_SCALE = "the absolute scale of a single camera is not validated in this version"


@dataclasses.dataclass(frozen=True)
class Measure:
    """Mean and sd (n - 1; None for one value) over the n values of both sides; `left`, `right` are means of a side."""

    left: float | None
    right: float | None
    mean: float
    sd: float | None
    n: int

    def to_dict(self) -> dict:
        return {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}


@dataclasses.dataclass(frozen=True)
class Spatiotemporal:
    """Measures by name (`MEASURES`); None where one cannot be trusted, with the reason in `reasons`.

    `n_cycles_found` and `n_cycles_used` count before and after the exclusions of `find_cycles`.
    """

    status: str
    reason: str
    measures: dict[str, Measure | None]
    reasons: dict[str, str]
    n_cycles_found: int
    n_cycles_used: int
    n_steps_used: int

    def __getitem__(self, name: str) -> Measure | None:
        return self.measures[name]


def spatiotemporal(cycles: Sequence[GaitCycle]) -> Spatiotemporal:
    """Measures over the used cycles of one or several trials (formulas and sources in docs/measures.md).

    For a cycle with foot down D, opposite foot up U', opposite foot down D', foot up U, next foot down E:
    stride time E - D; stance 100 (U - D) / (E - D); swing 100 - stance; double support time (U' - D) + (U - D');
    double support the same in percent of the stride; cadence 120 / (E - D). Step time is between successive foot downs
    and belongs to the side that lands: D' - D is a step of the other side, E - D' one of this side; a step that is
    part of two cycles counts once.

    Status EMPTY with a reason where no cycle is used.
    """
    used = [c for c in cycles if c.used]
    reasons: dict[str, str] = dict.fromkeys(MEASURES[-3:], _NO_SCALE)
    measures: dict[str, Measure | None] = dict.fromkeys(MEASURES)
    if not used:
        reason = _none_used(cycles)
        reasons.update(dict.fromkeys(MEASURES[:-3], reason))
        return Spatiotemporal("EMPTY", reason, measures, reasons, len(cycles), 0, 0)
    by_cycle: dict[str, list[tuple[str, float]]] = {name: [] for name in MEASURES[:-3]}
    steps: dict[tuple[str, str, float], float] = {}
    for c in used:
        stride = c.stride_time_s
        both = (c.opposite_foot_up_s - c.start_s) + (c.foot_up_s - c.opposite_foot_down_s)
        stance = 100.0 * (c.foot_up_s - c.start_s) / stride
        by_cycle["cadence_steps_per_min"].append(("", 120.0 / stride))
        by_cycle["stride_time_s"].append((c.side, stride))
        by_cycle["stance_percent"].append((c.side, stance))
        by_cycle["swing_percent"].append((c.side, 100.0 - stance))
        by_cycle["double_support_time_s"].append((c.side, both))
        by_cycle["double_support_percent"].append((c.side, 100.0 * both / stride))
        other = RIGHT if c.side == LEFT else LEFT
        steps[c.trial, other, c.opposite_foot_down_s] = c.opposite_foot_down_s - c.start_s
        steps[c.trial, c.side, c.end_s] = c.end_s - c.opposite_foot_down_s
    by_cycle["step_time_s"] = [(side, value) for (_, side, _), value in steps.items()]
    measures.update({name: _measure(values) for name, values in by_cycle.items()})
    return Spatiotemporal("PASS", "", measures, reasons, len(cycles), len(used), len(steps))


def _none_used(cycles: Sequence[GaitCycle]) -> str:
    if not cycles:
        return "no complete gait cycle"
    if failed := next((c.excluded for c in cycles if c.fit_failed), ""):
        return failed
    odd = " and strides of odd length" if any(c.odd_length for c in cycles) else ""
    return f"{len(cycles)} gait cycles, none left without the first and last step{odd}"


def _measure(values: Sequence[tuple[str, float]]) -> Measure:
    numbers = np.array([v for _, v in values])
    by_side = {side: [v for s, v in values if s == side] for side in (LEFT, RIGHT)}
    left, right = (float(np.mean(by_side[s])) if by_side[s] else None for s in (LEFT, RIGHT))
    sd = float(np.std(numbers, ddof=1)) if len(numbers) > 1 else None
    return Measure(left, right, float(numbers.mean()), sd, len(numbers))
