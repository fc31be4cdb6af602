"""Correction of identities that were exchanged when two people were close, from before and after the encounter.

While two bodies overlap, a detector sees one of them or a mixture, and an association that only knows the past may
continue with the wrong one. Here both sides of the encounter are known: velocity, size and clothes of each person. The
two ends are exchanged if that fits clearly better.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from .appearance import appearance_similarity, mean_appearance
from .associate import Trail, measure


def line_near(trail: Trail, at_s: float, length_s: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Position (2,) px at `at_s`, velocity (2,) px/s and height in px, from the sightings within `length_s` of it; None
    if those are fewer than three."""
    near = [i for i, t in enumerate(trail.times) if abs(t - at_s) <= length_s]
    if len(near) < 3:
        return None
    states = np.array([measure(trail.detections[i]) for i in near])
    tau = np.array([trail.times[i] for i in near]) - at_s
    slope, place = np.polyfit(tau, states[:, :2], 1)
    return place, slope, float(np.exp(np.median(states[:, 2])))


@dataclasses.dataclass(frozen=True)
class UncrossParams:
    """Parameters of `undo_swaps`."""

    near: float = 0.5  # distance below which two people are in an encounter, in body heights
    pause_s: float = 0.3  # longest time apart within one encounter
    velocity_s: float = 0.6  # length of the straight line through a track before and after the encounter
    gate: float = 0.3  # distance between that line and the other track that costs 1, in body heights,
    gate_per_s: float = 0.4  # and its increase per second of the encounter
    size_gate: float = 0.25  # natural logarithm of the ratio of sizes that costs 1
    look_gate: float = 0.1  # one minus the similarity that costs 1
    worst: float = 3.0  # largest cost of each of the three
    margin: float = 0.3  # least reduction of the cost by an exchange, summed over both people


def undo_swaps(trails: Sequence[Trail], params: UncrossParams) -> list[Trail]:
    """Return the trails, with their ends exchanged after encounters if that fits better."""
    out = list(trails)
    for i in range(len(out)):
        for j in range(i + 1, len(out)):
            if max(out[i].times[0], out[j].times[0]) > min(out[i].times[-1], out[j].times[-1]):
                continue  # never in view together
            # Each encounter is judged on the trails as corrected at the earlier ones.
            n = 0
            while (spans := list(_encounters(out[i], out[j], params)))[n:]:
                begin, end = spans[n]
                if _exchange_fits(out[i], out[j], begin, end, params):
                    out[i], out[j] = _exchanged(out[i], out[j], _closest(out[i], out[j], begin, end))
                n += 1
    return out


def _encounters(a: Trail, b: Trail, params: UncrossParams) -> Iterator[tuple[float, float]]:
    """First and last time of each encounter, in order."""
    time, apart = _apart(a, b)
    close = time[apart < params.near]
    for span in np.split(close, np.flatnonzero(np.diff(close) > params.pause_s) + 1):
        if len(span):
            yield float(span[0]), float(span[-1])


def _apart(a: Trail, b: Trail) -> tuple[np.ndarray, np.ndarray]:
    """Times at which both are followed (10 Hz), and their distance in body heights."""
    time = np.arange(max(a.times[0], b.times[0]), min(a.times[-1], b.times[-1]) + 1e-9, 0.1)
    here, there = a.states(time), b.states(time)
    return time, np.hypot(*(here - there)[:, :2].T) / np.exp((here[:, 2] + there[:, 2]) / 2)


def _closest(a: Trail, b: Trail, begin: float, end: float) -> float:
    time, apart = _apart(a, b)
    inside = (time >= begin) & (time <= end)
    return float(time[inside][np.argmin(apart[inside])])


def _exchange_fits(a: Trail, b: Trail, begin: float, end: float, params: UncrossParams) -> bool:
    before = [_part(t, -np.inf, begin) for t in (a, b)]
    after = [_part(t, end, np.inf) for t in (a, b)]
    if min(len(p.frames) for p in (*before, *after)) < 3:
        return False
    cost = [[_cost(p, q, params) for q in after] for p in before]
    return cost[0][1] + cost[1][0] + params.margin < cost[0][0] + cost[1][1]


def _part(trail: Trail, low: float, high: float) -> Trail:
    rows = slice(int(np.searchsorted(trail.times, low, "right")), int(np.searchsorted(trail.times, high)))
    return trail.part(rows)


def _cost(before: Trail, after: Trail, params: UncrossParams) -> float:
    """Cost of continuing one trail with another across an encounter."""
    gap = after.times[0] - before.times[-1]
    one = line_near(before, before.times[-1], params.velocity_s)
    two = line_near(after, after.times[0], params.velocity_s)
    cost = 0.0
    if one is not None and two is not None:
        (place, going, height), (next_place, coming, next_height) = one, two
        unit = np.sqrt(height * next_height)
        miss = max(np.hypot(*(place + going * gap - next_place)), np.hypot(*(next_place - coming * gap - place))) / unit
        cost += min(miss / (params.gate + params.gate_per_s * gap), params.worst)
        cost += min(abs(np.log(next_height / height)) / params.size_gate, params.worst)
    alike = appearance_similarity(_appearance_near(before, before.times[-1]), _appearance_near(after, after.times[0]))
    return cost + (min((1 - alike) / params.look_gate, params.worst) if np.isfinite(alike) else 0.0)


def _appearance_near(trail: Trail, at_s: float) -> np.ndarray:
    """Mean appearance of the sightings within 1.5 s of `at_s`; NaN if not known."""
    return mean_appearance(
        [d.appearance for d, t in zip(trail.detections, trail.times, strict=True) if abs(t - at_s) <= 1.5]
    )


def _exchanged(a: Trail, b: Trail, at_s: float) -> tuple[Trail, Trail]:
    i, j = (int(np.searchsorted(t.times, at_s)) for t in (a, b))
    return (
        Trail.of_parts(a.part(slice(i)), b.part(slice(j, None))),
        Trail.of_parts(b.part(slice(j)), a.part(slice(i, None))),
    )
