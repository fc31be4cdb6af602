"""Following a person who was just found back to where she came into view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from .appearance import appearance_of
from .associate import AssociationParams, Trail, measure, pair_cost
from .detection_schedule import window_around
from .tiling import detect_in
from .types import PersonDetector

#: A person may be missed in so many of the kept frames on the way back.
MAX_MISSES = 1


def backtrack(
    trail: Trail,
    kept: Sequence[tuple[int, float, np.ndarray]],
    others: Sequence[Trail],
    detector: PersonDetector,
    window_sizes: float,
    params: AssociationParams,
) -> Trail:
    """The trail with sightings put before it, from frames `kept` (index, time_s, image) in order of time.

    Ends where the person is not found any more, or where it would become one of `others`, who were seen there.
    """
    back = Trail.of(trail.frames[0], -trail.times[0], trail.detections[0])
    misses = 0
    for index, time_s, image in reversed(kept):
        if time_s >= trail.times[0]:
            continue
        found = detect_in(detector, image, [window_around(back.predict(-time_s), window_sizes)])
        taken = [d for t in others for d in t.detections[_at(t, index)]]
        free = [d for d in found if not any(_same(d, o) for o in taken)]
        # As forwards: the gate widens with time, but not for detections that are not sure.
        wider = params.gate_per_s * (-time_s - back.last_time)
        gates = [params.gate + (wider if d.score >= params.sure_score else 0.0) for d in free]
        excess = [pair_cost(back, -time_s, d, params) - g for d, g in zip(free, gates, strict=True)]
        if excess and min(excess) <= 0:
            seen = free[int(np.argmin(excess))]
            seen = dataclasses.replace(seen, appearance=appearance_of(image, measure(seen), seen.roi_px[3]))
            back.add(index, -time_s, seen, params.memory_s)
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
