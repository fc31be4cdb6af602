"""Circles held over gaps in time, forward and backward."""

from __future__ import annotations

import dataclasses

import numpy as np

from .params import HeadParams
from .types import FACE, HELD, KEYPOINTS, NONE, Head


def held(head: Head, time_s: np.ndarray, size_px: tuple[int, int], params: HeadParams) -> Head:
    """The head with its gaps filled; where its place is in doubt, also where the sure frames around say it is.

    Gaps up to `bridge_s` are interpolated. Beyond the ends, and at both sides of a longer gap, the circle stays: for
    `hold_s`, but no longer than the head was seen (a wrong sighting is short), or `leave_s` where it touches the edge
    of the picture, through which a head comes and goes. It grows meanwhile.
    """
    n_seen = int((head.source != NONE).sum())
    seen_s = n_seen * float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    hold_s = params.leave_s if head.body_px is None else params.hold_s
    params = dataclasses.replace(params, hold_s=min(hold_s, max(seen_s, params.leave_s)))
    sure = (head.source == KEYPOINTS) | (head.source == FACE)
    doubt = (head.source != NONE) & ~sure
    also = np.full_like(head.circle_px, np.nan)
    _fill(also, head.circle_px, np.flatnonzero(sure), np.flatnonzero(doubt), time_s, size_px, params)
    circle = head.circle_px.copy()
    absent = np.flatnonzero(head.source == NONE)
    _fill(circle, head.circle_px, np.flatnonzero(head.source != NONE), absent, time_s, size_px, params)
    # A track that goes astray before it ends leaves its head where it was last sure.
    _fill(also, head.circle_px, np.flatnonzero(sure), absent, time_s, size_px, params)
    source = head.source.copy()
    filled = np.isfinite(circle[absent]).all(axis=1) | np.isfinite(also[absent]).all(axis=1)
    source[absent[filled]] = HELD
    return dataclasses.replace(head, circle_px=circle, source=source, also_px=also)


def _fill(
    out: np.ndarray,
    circle: np.ndarray,
    known: np.ndarray,
    wanted: np.ndarray,
    time_s: np.ndarray,
    size_px: tuple[int, int],
    params: HeadParams,
) -> None:
    """Write into the rows `wanted` of `out` the circles held from the rows `known` of `circle`, where any is."""
    if not len(known):
        return
    for t in wanted:
        place = int(np.searchsorted(known, t))
        before = int(known[place - 1]) if place else None
        after = int(known[place]) if place < len(known) else None
        since = float(time_s[t] - time_s[before]) if before is not None else np.inf
        until = float(time_s[after] - time_s[t]) if after is not None else np.inf
        if before is not None and after is not None and since + until <= params.bridge_s:
            between = circle[before] + since / (since + until) * (circle[after] - circle[before])
            out[t] = _grown(between, min(since, until), params)
            continue
        near, for_s = (before, since) if since <= until else (after, until)
        longest = params.leave_s if near is not None and _at_edge(circle[near], size_px) else params.hold_s
        if near is not None and for_s <= longest + 1e-9:
            out[t] = _grown(circle[near], for_s, params)


def _at_edge(circle: np.ndarray, size_px: tuple[int, int]) -> bool:
    x, y, r = circle
    return bool(x < r or y < r or x > size_px[0] - r or y > size_px[1] - r)


def _grown(circle: np.ndarray, for_s: float, params: HeadParams) -> np.ndarray:
    return np.array([*circle[:2], circle[2] * min(1.0 + params.hold_growth * for_s, params.hold_most)])
