"""The best sequence of events in the order of walking: left down, right up, right down, left up, left down, ..."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, LEFT, RIGHT, GaitEvent

from .types import EventParams


@dataclasses.dataclass(frozen=True)
class Candidate:
    """An extremum that may be an event: its time, kind and weight (its probability)."""

    time_s: float
    side: str
    event: str
    weight: float


#: Place of each event in the cycle; the next event has the next place.
PLACE = {(LEFT, FOOT_DOWN): 0, (RIGHT, FOOT_UP): 1, (RIGHT, FOOT_DOWN): 2, (LEFT, FOOT_UP): 3}


def comes_next(a: Candidate | GaitEvent, b: Candidate | GaitEvent) -> bool:
    """True if `b` is the next event after `a` in the order of walking."""
    return (PLACE[a.side, a.event] + 1) % 4 == PLACE[b.side, b.event]


def follows(a: Candidate, b: Candidate, params: EventParams) -> bool:
    """True where `b` can be the very next event after `a`: next place, phase neither too short nor too long."""
    if not comes_next(a, b):
        return False
    shortest = params.min_swing_s if b.event == FOOT_DOWN else 0.0
    return shortest < b.time_s - a.time_s <= params.max_phase_s


def best_sequence(candidates: Sequence[Candidate], params: EventParams) -> list[list[Candidate]]:
    """Bouts: runs of candidates in the order of walking with the largest total weight.

    A candidate may be left out (that costs its weight) and a run may end (that costs `break_cost`), so that one
    spurious extremum is dropped and one missing event splits a bout. Dynamic programming over candidates in order of
    time. Runs are then split where two successive initial contacts are outside the limits of cadence.
    """
    found = sorted(candidates, key=lambda c: c.time_s)
    best: list[float] = []
    previous: list[tuple[int, bool] | None] = []
    for i, b in enumerate(found):
        score, origin = b.weight, None
        for j in range(i - 1, -1, -1):
            linked = follows(found[j], b, params)
            value = best[j] + b.weight - (0.0 if linked else params.break_cost)
            if value > score:
                score, origin = value, (j, linked)
        best.append(score)
        previous.append(origin)
    if not found:
        return []
    runs: list[list[Candidate]] = []
    run: list[Candidate] = []
    i = max(range(len(found)), key=best.__getitem__)
    while True:
        run.append(found[i])
        origin = previous[i]
        if origin is None or not origin[1]:
            runs.append(run[::-1])
            run = []
        if origin is None:
            break
        i = origin[0]
    return [part for run in reversed(runs) for part in _split_at_cadence(run, params)]


def _split_at_cadence(run: list[Candidate], params: EventParams) -> list[list[Candidate]]:
    shortest, longest = 60 / params.max_cadence_per_min, 60 / params.min_cadence_per_min
    parts: list[list[Candidate]] = [[]]
    last_down: float | None = None
    for c in run:
        if c.event == FOOT_DOWN:
            if last_down is not None and not shortest <= c.time_s - last_down <= longest:
                parts.append([])
            last_down = c.time_s
        parts[-1].append(c)
    return parts
