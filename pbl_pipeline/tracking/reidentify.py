"""Joining what became two tracks because somebody was hidden, or left the picture and came back.

Behind a pillar a walker goes on walking: the movement before and after tells that it is one person. Who leaves the
picture may come back from anywhere, and so may anybody else: there only the clothes tell, and only where they are the
same and nobody else's are alike. Not to join costs a choice by hand; to join wrongly measures somebody else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from .appearance import appearance_similarity, mean_appearance, with_appearance
from .associate import AssociationParams, Trail, measure, pair_cost
from .detection_schedule import window_around
from .identity_swaps import line_near
from .tiling import detect_in
from .types import PersonDetector, Scene

#: A person may be missed in so many of the kept frames on the way back.
MAX_MISSES = 1


def backtrack(
    trail: Trail,
    kept: Sequence[tuple[int, float, Scene]],
    others: Sequence[Trail],
    detector: PersonDetector,
    window_sizes: float,
    params: AssociationParams,
) -> Trail:
    """The trail with sightings put before it, from frames `kept` (index, time_s, picture) in order of time.

    Ends where the person is not found any more, or where it would become one of `others`, who were seen there.
    """
    back = Trail.of(trail.frames[0], -trail.times[0], trail.detections[0])
    misses = 0
    for index, time_s, scene in reversed(kept):
        if time_s >= trail.times[0]:
            continue
        found = detect_in(detector, scene, [window_around(back.predict(-time_s), window_sizes)])
        taken = [d for t in others for d in t.detections[_at(t, index)]]
        free = [d for d in found if not any(_same(d, o) for o in taken)]
        # As forwards: the gate widens with time, but not for detections that are not sure.
        wider = params.gate_per_s * (-time_s - back.last_time)
        gates = [params.gate + (wider if d.score >= params.sure_score else 0.0) for d in free]
        excess = [pair_cost(back, -time_s, d, params) - g for d, g in zip(free, gates, strict=True)]
        if excess and min(excess) <= 0:
            seen = free[int(np.argmin(excess))]
            back.add(index, -time_s, with_appearance(seen, scene), params.memory_s)
            misses = 0
            continue
        misses += 1
        if misses > MAX_MISSES:
            break
    frames, times = back.frames[:0:-1], [-t for t in back.times[:0:-1]]
    velocity = -back.velocity if len(trail.frames) == 1 else trail.velocity
    return Trail(
        [*frames, *trail.frames], [*times, *trail.times], [*back.detections[:0:-1], *trail.detections], velocity
    )


def _at(trail: Trail, index: int) -> slice:
    row = int(np.searchsorted(trail.frames, index))
    return slice(row, row + 1) if row < len(trail.frames) and trail.frames[row] == index else slice(0, 0)


def _same(a, b) -> bool:
    """Whether two detections of one frame are of one person: nearer than a quarter of a body."""
    here, there = measure(a), measure(b)
    return bool(np.hypot(*(here[:2] - there[:2])) < 0.25 * np.exp((here[2] + there[2]) / 2))


@dataclasses.dataclass(frozen=True)
class JoinParams:
    """max_gap_s: longest time out of sight. velocity_s: the straight line through this much of a track before and after
    the gap says where the person was going to and coming from. gate, gate_per_s: how far these two may miss the other
    track's end, in body heights at once and per second of the gap. max_growth: largest ratio of sizes across the gap.
    other_clothes: similarity (`appearance_similarity`) below which two are never joined.
    same_clothes, clothes_lead: similarity from which somebody out of sight for up to `return_gap_s` is the same,
    and by how much it must exceed that to everybody else. min_looks: sightings that a similarity needs on either side.
    return_growth: largest ratio of sizes, who comes back may be nearer.
    Likeness on seven recordings of four people: the same person in two halves of a recording 0.96 to 0.998, but 0.88 of
    a man who jumps on a wall; two people 0.39 to 0.90.
    """

    max_gap_s: float = 2.5
    velocity_s: float = 0.6
    gate: float = 0.3
    gate_per_s: float = 0.2
    max_growth: float = 1.25
    other_clothes: float = 0.5
    same_clothes: float = 0.92
    clothes_lead: float = 0.03
    min_looks: int = 5
    return_gap_s: float = 120.0
    return_growth: float = 2.5


def join_trails(trails: Sequence[Trail], size_px: tuple[int, int], params: JoinParams) -> list[Trail]:
    """The trails in order of appearance, those of one person put together.

    Two are one person where the first ends before the second begins, at most `max_gap_s` apart, with like sizes, where
    each, going on at its velocity, meets the other, and the way between lies in the picture. Where more than one would
    fit, none is joined. After that, two are one where the clothes say so.
    """
    return _join_by_clothes(_join_by_movement(trails, size_px, params), params)


def _join_by_movement(trails: Sequence[Trail], size_px: tuple[int, int], params: JoinParams) -> list[Trail]:
    rest = sorted(trails, key=lambda t: (t.frames[0], -t.detections[0].score))
    while True:
        fits = [(a, b) for a in rest for b in rest if a is not b and _one_person(a, b, size_px, params)]
        sole = [(a, b) for a, b in fits if sum(x is a for x, _ in fits) == 1 and sum(y is b for _, y in fits) == 1]
        if not sole:
            return rest
        a, b = sole[0]
        rest = [_whole(a, b) if t is a else t for t in rest if t is not b]


def _join_by_clothes(trails: Sequence[Trail], params: JoinParams) -> list[Trail]:
    """In order of time each trail becomes part of a person who was seen before, or a new person."""
    people: list[list[Trail]] = []
    known: dict[tuple[int, ...], np.ndarray] = {}  # a corridor sees hundreds, each compared with all others

    def appearance(*parts: Trail) -> np.ndarray:
        key = tuple(map(id, parts))
        if key not in known:
            known[key] = _appearance(parts, params)
        return known[key]

    for trail in sorted(trails, key=lambda t: t.times[0]):
        gone = [p for p in people if 0 < trail.times[0] - p[-1].times[-1] <= params.return_gap_s]
        ranked = sorted(
            ((appearance_similarity(appearance(*p), appearance(trail)), p) for p in gone),
            key=lambda c: -np.nan_to_num(c[0]),
        )
        if not ranked or not ranked[0][0] >= params.same_clothes:
            people.append([trail])
            continue
        alike, best = ranked[0]
        # Others who left before, and those who are surely somebody else, being there at the same time.
        present = [t for t in trails if t not in best and any(_together(t, mine) for mine in (trail, *best))]
        rivals = [a for a, _ in ranked[1:]] + [
            appearance_similarity(appearance(t), appearance(trail)) for t in present if t is not trail
        ]
        lead = alike - max((r for r in rivals if np.isfinite(r)), default=0.0)
        if lead >= params.clothes_lead and _alike_in_size(best[-1], trail, params):
            best.append(trail)
        else:
            people.append([trail])
    return [_whole(*p) for p in people]


def _together(a: Trail, b: Trail) -> bool:
    return a.times[0] <= b.times[-1] and b.times[0] <= a.times[-1]


def _appearance(parts: Sequence[Trail], params: JoinParams) -> np.ndarray:
    """Mean appearance of a person's trails; NaN where too few sightings know it."""
    return mean_appearance([d.appearance for t in parts for d in t.detections], params.min_looks)


def _alike_in_size(a: Trail, b: Trail, params: JoinParams) -> bool:
    before, after = line_near(a, a.times[-1], params.velocity_s), line_near(b, b.times[0], params.velocity_s)
    if before is None or after is None:
        return False
    return abs(float(np.log(before[2] / after[2]))) <= np.log(params.return_growth)


def _whole(*parts: Trail) -> Trail:
    return Trail(
        [f for p in parts for f in p.frames],
        [t for p in parts for t in p.times],
        [d for p in parts for d in p.detections],
        parts[-1].velocity,
    )


def _one_person(a: Trail, b: Trail, size_px: tuple[int, int], p: JoinParams) -> bool:
    gap = b.times[0] - a.times[-1]
    if not 0 < gap <= p.max_gap_s:
        return False
    before, after = line_near(a, a.times[-1], p.velocity_s), line_near(b, b.times[0], p.velocity_s)
    if (
        before is None
        or after is None
        or appearance_similarity(_appearance([a], p), _appearance([b], p)) < p.other_clothes
    ):
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
