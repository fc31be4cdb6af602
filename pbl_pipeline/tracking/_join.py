"""Joining what became two tracks because somebody was hidden for longer than the association waits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ._associate import Trail, measure


@dataclasses.dataclass(frozen=True)
class JoinParams:
    """max_gap_s: longest time out of sight. velocity_s: the straight line through this much of a track before and after
    the gap says where the person was going to and coming from. gate, gate_per_s: how far these two may miss the other
    track's end, in body heights at once and per second of the gap. max_growth: largest ratio of sizes across the gap.
    """

    max_gap_s: float = 2.5
    velocity_s: float = 0.6
    gate: float = 0.3
    gate_per_s: float = 0.2
    max_growth: float = 1.25


def join_trails(trails: Sequence[Trail], size_px: tuple[int, int], params: JoinParams) -> list[Trail]:
    """The trails in order of appearance, those of one person put together.

    Two are one person where the first ends before the second begins, at most `max_gap_s` apart, with like sizes, where
    each, going on at its velocity, meets the other, and the way between lies in the picture (who leaves it may be
    anybody when somebody comes in). Where more than one would fit, none is joined: a person must then choose.
    """
    rest = sorted(trails, key=lambda t: (t.frames[0], -t.detections[0].score))
    while True:
        fits = [(a, b) for a in rest for b in rest if a is not b and _one_person(a, b, size_px, params)]
        sole = [(a, b) for a, b in fits if sum(x is a for x, _ in fits) == 1 and sum(y is b for _, y in fits) == 1]
        if not sole:
            return rest
        a, b = sole[0]
        whole = Trail([*a.frames, *b.frames], [*a.times, *b.times], [*a.detections, *b.detections], b.velocity)
        rest = [whole if t is a else t for t in rest if t is not b]


def _one_person(a: Trail, b: Trail, size_px: tuple[int, int], p: JoinParams) -> bool:
    gap = b.times[0] - a.times[-1]
    if not 0 < gap <= p.max_gap_s:
        return False
    before, after = _line(a, a.times[-1], p.velocity_s), _line(b, b.times[0], p.velocity_s)
    if before is None or after is None:
        return False
    (end, going, height), (begin, coming, next_height) = before, after
    if not 1 / p.max_growth <= next_height / height <= p.max_growth:
        return False
    unit = np.sqrt(height * next_height)
    miss = [np.hypot(*(end + going * gap - begin)), np.hypot(*(begin - coming * gap - end))]
    inside = np.all((end > 0) & (end < size_px)) and np.all((begin > 0) & (begin < size_px))
    # Both ends lie in the picture; so must half a body around them, or the person may just have left it.
    room = min(end[0], begin[0], size_px[0] - end[0], size_px[0] - begin[0]) > 0.2 * unit
    return bool(inside and room and max(miss) / unit <= p.gate + p.gate_per_s * gap)


def _line(trail: Trail, at_s: float, length_s: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Place (2,) px at `at_s`, velocity (2,) px/s and height in px, of the sightings within `length_s` of it."""
    near = [i for i, t in enumerate(trail.times) if abs(t - at_s) <= length_s]
    if len(near) < 3:
        return None
    states = np.array([measure(trail.detections[i]) for i in near])
    tau = np.array([trail.times[i] for i in near]) - at_s
    slope, place = np.polyfit(tau, states[:, :2], 1)
    return place, slope, float(np.exp(np.median(states[:, 2])))
