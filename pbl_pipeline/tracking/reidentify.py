"""Joining of two tracks of a person who was hidden, or who left the picture and came back.

A walker goes on walking behind a pillar: the movement before and after shows that it is one person. A person who left
the picture may come back from anywhere, and so may another person: then only the clothes decide, if they are the same
and no other person's are similar. Two tracks not joined cost a choice by hand; two joined wrongly measure another
person.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pbl_pipeline.video import Frame

from .appearance import appearance_similarity, mean_appearance, with_appearance
from .associate import AssociationParams, Trail, measure, pair_cost, same_body
from .detection_schedule import WatchParams, window_around
from .identity_swaps import line_near
from .tiling import detect_in
from .types import PersonDetector, Scene

#: Most kept frames in a row in which a person may be missed on the way back.
MAX_MISSES = 1


def backtrack(
    trail: Trail,
    kept: Sequence[tuple[int, float, Scene]],
    others: Sequence[Trail],
    detector: PersonDetector,
    watch: WatchParams,
    params: AssociationParams,
) -> Trail:
    """Extend a trail to earlier frames, `kept` (index, time_s, picture) in order of time.

    Ends when the person is no longer found, or would be one of the `others` that were seen there.
    """

    def taken(index: int, _: float) -> list[np.ndarray]:
        return [measure(d) for t in others for d in t.detections[_at(t, index)]]

    before = [k for k in reversed(kept) if k[1] < trail.times[0]]
    return _with_sightings(trail, before, taken, detector, watch, params)


def with_exact_ends(
    trails: Sequence[Trail],
    time_s: np.ndarray,
    frames: Callable[[int, int], Iterable[Frame]],
    within_s: float,
    detector: PersonDetector,
    watch: WatchParams,
    params: AssociationParams,
) -> list[Trail]:
    """Extend the trails to the first and the last frame in which the person is found, up to `within_s` at either end.

    Parameters
    ----------
    time_s
        Stamps of all frames.
    frames
        Function that returns the frames from one number up to, but not including, another.
    """
    out, wanted = list(trails), defaultdict(list)
    for i, t in enumerate(trails):
        first, last = t.frames[0], t.frames[-1]
        begin, end = np.searchsorted(time_s, [time_s[first] - within_s - 1e-6, time_s[last] + within_s + 1e-6])
        for part in (range(int(begin), first), range(last + 1, int(end))):
            for index in part:
                wanted[index].append((i, part))
    scenes: dict[tuple[int, range], list[tuple[int, float, Scene]]] = defaultdict(list)
    for frame in frames(min(wanted), max(wanted) + 1) if wanted else ():
        for i, part in wanted.get(frame.index, ()):
            scenes[i, part].append((frame.index, frame.time_s, frame))
            if frame.index == part[-1]:
                shown, others = scenes.pop((i, part)), [*out[:i], *out[i + 1 :]]
                shown = shown if frame.index > out[i].frames[0] else shown[::-1]
                taken = functools.partial(_between_sightings, others)
                out[i] = _with_sightings(out[i], shown, taken, detector, watch, params)
    return out


def _between_sightings(trails: Sequence[Trail], _: int, at_s: float) -> list[np.ndarray]:
    """States (`measure`) at a time of those who were seen before and after it."""
    return [t.states(np.array([at_s]))[0] for t in trails if t.times[0] <= at_s <= t.times[-1]]


def _with_sightings(
    trail: Trail,
    shown: Sequence[tuple[int, float, Scene]],
    taken: Callable[[int, float], Sequence[np.ndarray]],
    detector: PersonDetector,
    watch: WatchParams,
    params: AssociationParams,
) -> Trail:
    """Extend a trail with sightings in frames (index, time_s, picture), which are before it in reverse order, or after
    it. `taken`: function from number and time of a frame to the states of others."""
    if not shown:
        return trail
    sign, end = (-1.0, 0) if shown[0][1] < trail.times[0] else (1.0, -1)
    more, misses = Trail.of(trail.frames[end], sign * trail.times[end], trail.detections[end]), 0
    for index, time_s, scene in shown:
        at = sign * time_s
        found = detect_in(detector, scene, [window_around(more.predict(at), watch)])
        others = taken(index, time_s)
        free = [d for d in found if not any(same_body(measure(d), o) for o in others)]
        # As in `Associator`: the gate widens with time, but not for detections that are not sure.
        wider = params.gate_per_s * (at - more.last_time)
        gates = [params.gate + (wider if d.score >= params.sure_score else 0.0) for d in free]
        excess = [pair_cost(more, at, d, params) - g for d, g in zip(free, gates, strict=True)]
        if excess and min(excess) <= 0:
            best = free[int(np.argmin(excess))]
            more.add(index, at, with_appearance(best, scene), params.memory_s)
            misses = 0
            continue
        misses += 1
        if misses > MAX_MISSES:
            break
    seen = Trail(more.frames, [sign * t for t in more.times], more.detections, trail.velocity)
    if sign > 0:
        return Trail.of_parts(trail, seen.part(slice(1, None)))
    whole = Trail.of_parts(seen.part(slice(None, 0, -1)), trail)
    return dataclasses.replace(whole, velocity=-more.velocity) if len(trail.frames) == 1 else whole


def _at(trail: Trail, index: int) -> slice:
    row = int(np.searchsorted(trail.frames, index))
    return slice(row, row + 1) if row < len(trail.frames) and trail.frames[row] == index else slice(0, 0)


@dataclasses.dataclass(frozen=True)
class JoinParams:
    """Parameters of `join_trails`.

    `appearance_similarity` on seven recordings of four people: the same person in two halves of a recording 0.96 to
    0.998, but 0.88 of a man who jumps on a wall; two people 0.39 to 0.90.
    """

    max_gap_s: float = 2.5  # longest time out of sight for a join by movement
    velocity_s: float = 0.6  # length of the straight line through a track before and after the gap
    gate: float = 0.3  # largest distance between that line and the other track's end, in body heights,
    gate_per_s: float = 0.2  # and its increase per second of the gap
    max_growth: float = 1.25  # largest ratio of sizes across the gap
    other_clothes: float = 0.5  # similarity below which two are never joined
    same_clothes: float = 0.92  # similarity from which a person out of sight for up to `return_gap_s` is the same
    clothes_lead: float = 0.03  # least excess over the similarity to all others
    min_looks: int = 5  # least number of sightings on either side for a similarity
    return_gap_s: float = 120.0
    return_growth: float = 2.5  # largest ratio of sizes for a join by clothes: the person may come back nearer


def join_trails(trails: Sequence[Trail], size_px: tuple[int, int], params: JoinParams) -> list[Trail]:
    """Join the trails of one person; returned in order of appearance.

    Two trails are joined if the first ends before the second begins, at most `max_gap_s` apart, with similar sizes, if
    each, extrapolated at its velocity, meets the other, and if the way in between lies in the picture. If more than one
    fits, none is joined. After that, trails are joined by clothes.
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
        rest = [Trail.of_parts(a, b) if t is a else t for t in rest if t is not b]


def _join_by_clothes(trails: Sequence[Trail], params: JoinParams) -> list[Trail]:
    """Assign each trail, in order of time, to a person who was seen before, or to a new person."""
    people: list[list[Trail]] = []
    known: dict[tuple[int, ...], np.ndarray] = {}  # in a corridor hundreds of trails are compared with all others

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
        # Others who left before, and those who are in view at the same time and so certainly another person.
        spans = [(mine.times[0], mine.times[-1]) for mine in (trail, *best)]
        present = [t for t in trails if t not in best and any(t.times[0] <= b and a <= t.times[-1] for a, b in spans)]
        rivals = [a for a, _ in ranked[1:]] + [
            appearance_similarity(appearance(t), appearance(trail)) for t in present if t is not trail
        ]
        lead = alike - max((r for r in rivals if np.isfinite(r)), default=0.0)
        if lead >= params.clothes_lead and _alike_in_size(best[-1], trail, params):
            best.append(trail)
        else:
            people.append([trail])
    return [Trail.of_parts(*p) for p in people]


def _appearance(parts: Sequence[Trail], params: JoinParams) -> np.ndarray:
    """Mean appearance of a person's trails; NaN if too few sightings have one."""
    return mean_appearance([d.appearance for t in parts for d in t.detections], params.min_looks)


def _alike_in_size(a: Trail, b: Trail, params: JoinParams) -> bool:
    before, after = line_near(a, a.times[-1], params.velocity_s), line_near(b, b.times[0], params.velocity_s)
    if before is None or after is None:
        return False
    return abs(float(np.log(before[2] / after[2]))) <= np.log(params.return_growth)


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
    # Both ends lie in the picture, with some room around them: otherwise the person may just have left it.
    room = min(end[0], begin[0], size_px[0] - end[0], size_px[0] - begin[0]) > 0.2 * unit
    return bool(inside and room and max(miss) / unit <= p.gate + p.gate_per_s * gap)
