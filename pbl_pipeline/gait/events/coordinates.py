"""Coordinate-based detection of initial contact and toe-off."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.methods import Method
from pbl_pipeline.qc import PASS, Check, warn_if
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, SIDES, GaitEvent, GaitEvents

from ._preconditions import check_preconditions
from .order import Candidate, best_sequence
from .signal import Segment, refine_extremum, uniform_segments
from .types import EventParams, heading_check, no_events

_HEEL, _TOE = slice(0, 2), slice(2, 4)


def detect_by_coordinates(feet: FootTrajectories, method: Method[EventParams]) -> GaitEvents:
    """Initial contact and toe-off from the forward movement of the feet relative to the pelvis.

    Method: Zeni, Richards, Higginson 2008, Gait & Posture 27:710-714. Initial contact is where the heel is foremost,
    toe-off where the toe is rearmost, relative to the pelvis along the heading. The signals are interpolated onto a
    uniform grid, low-passed without lag at `cutoff_hz`, extrema refined by a parabola; each must be prominent against
    the leg length and against the other steps of its side, and together they must follow the order left down, right up,
    right down, left up within the limits of cadence.

    Known bias, which is not removed: against the labels of 11 laboratory walks of children (optical markers, force
    plates) initial contact is 39 +- 12 ms early and toe-off 13 +- 10 ms late (mean +- sd), so stance comes out 50 ms
    and double support 100 ms too long. On fitted video the bias is not measured yet. An extremum within about 0.15 s of
    the end of view is not found: it cannot be seen to be one.

    `probability` of an event is `c / (1 + (threshold / prominence)^2)`: 0.5 for an extremum just at the detection
    threshold, near 1 for one far above it, times the confidence `c` of the points where the source states one. It
    orders events by how clear they are; it is not calibrated against truth.

    Raises `PblError` GAIT_INPUT if no frame has feet, pelvis and heading, or the legs are upside down or mirrored.

    The status is PASS, or EMPTY with a reason without walking (standing, sit-to-stand, too short in view), if one foot
    is never seen, or if the person walks backwards.
    """
    p = method.params
    _, reason, advice = check_preconditions(feet, p.min_segment_s)
    if reason:
        return no_events(method.name, method.hash, feet.source, reason, advice)
    x, leg = forward_signals(feet, p)
    return detect_by_extrema(
        feet, method, x, leg, lambda segment: _candidates(segment, leg, p), p.min_excursion_leg * leg
    )


def detect_by_extrema(
    feet: FootTrajectories,
    method: Method[Any],
    x: np.ndarray,
    leg: float,
    extrema: Callable[[Segment], list[Extremum]],
    least: float,
) -> GaitEvents:
    """Events among the `extrema` of each segment of the signals `x` (T, C), whose first two columns are the heels'
    places ahead of the pelvis; `least` is the smallest prominence that counts."""
    p: EventParams = method.params
    segments = uniform_segments(
        np.asarray(feet.time_s, float),
        x,
        grid_hz=p.grid_hz,
        cutoff_hz=p.cutoff_hz,
        filter_order=p.filter_order,
        max_gap_s=p.max_gap_s,
        min_segment_s=p.min_segment_s,
    )
    if not segments:
        return no_events(
            method.name, method.hash, feet.source, f"the feet are not seen for {p.min_segment_s:g} s at a time"
        )
    confidence = _mean_known(feet.confidence, np.ones(2))
    per_segment = [extrema(s) for s in segments]
    threshold = _thresholds(per_segment, least, p)
    bouts: list[list[Candidate]] = []
    n_candidates = breaks = 0
    for segment, candidates in zip(segments, per_segment, strict=True):
        c = _mean_known(feet.confidence[segment.frames[0] : segment.frames[1] + 1], confidence)
        kept = [_candidate(e, threshold, c) for e in candidates if e.prominence >= threshold[e.side, e.event]]
        n_candidates += len(kept)
        runs = best_sequence(kept, p)
        good = [r for r in runs if _walks(r, segment, leg, p)]
        breaks += max(0, len(runs) - 1)
        bouts += good
    swing = max(float(np.ptp(s.values[:, 0] - s.values[:, 1])) for s in segments) / leg
    if not bouts:
        reason = _why_not(swing, n_candidates, p)
        return no_events(method.name, method.hash, feet.source, reason, "", n_candidates, breaks)
    offset = {FOOT_DOWN: p.foot_down_offset_s, FOOT_UP: p.foot_up_offset_s}
    events = tuple(
        GaitEvent(c.time_s + offset[c.event], c.side, c.event, c.weight, number)
        for number, bout in enumerate(bouts)
        for c in bout
    )
    return GaitEvents(
        status="PASS",
        events=tuple(sorted(events, key=lambda e: (e.time_s, e.bout))),
        reason="",
        method=method.name,
        params_hash=method.hash,
        source=feet.source,
        walking_s=tuple((b[0].time_s, b[-1].time_s) for b in bouts),
        n_candidates=n_candidates,
        n_order_breaks=breaks,
        qc=_checks(feet, len(events), breaks),
    )


@dataclasses.dataclass(frozen=True)
class Extremum:
    """A candidate for an event: time, foot, kind and prominence."""

    time_s: float
    side: str
    event: str
    prominence: float


def forward_signals(feet: FootTrajectories, p: EventParams) -> tuple[np.ndarray, float]:
    """(T, 4): heel left, heel right, toe left, toe right, forward of the pelvis; and the leg length (same unit)."""
    heel = np.asarray(feet.heel_m, float) - feet.pelvis_m[:, None]
    toe = np.asarray(feet.toe_m, float) - feet.pelvis_m[:, None]
    x = np.concatenate(
        [np.einsum("tsi,ti->ts", heel, feet.forward), np.einsum("tsi,ti->ts", toe, feet.forward)], axis=1
    )
    unsure = np.asarray(feet.confidence) < p.min_confidence  # False for NaN: unknown is not low
    x[np.concatenate([unsure, unsure], axis=1)] = np.nan
    length = np.linalg.norm(heel, axis=2)
    length = length[np.isfinite(length)]
    if not np.any(np.all(np.isfinite(x), axis=1)) or len(length) == 0:
        raise PblError(
            "GAIT_INPUT",
            found="no frame in which pelvis, heading and both feet are known",
            expected="feet and hips in 3D in at least some frames",
            next_step="look at the overlay: is the person in view, are hips and feet found?",
        )
    leg = float(np.percentile(length, 95))
    if leg <= 0:
        raise PblError(
            "GAIT_INPUT",
            found="heel and pelvis at one place",
            expected="a leg length above 0",
            next_step="check the 3D points of hips and heels",
        )
    return x, leg


def _candidates(segment: Segment, leg: float, p: EventParams) -> list[Extremum]:
    """All extrema of one segment that pass the absolute threshold."""
    from scipy.signal import find_peaks  # takes longer to import than most commands run

    window = int(2 * 60 / p.min_cadence_per_min * p.grid_hz) | 1
    found = []
    for s, side in enumerate(SIDES):
        for event, signal in ((FOOT_DOWN, segment.values[:, _HEEL][:, s]), (FOOT_UP, -segment.values[:, _TOE][:, s])):
            at, about = find_peaks(signal, prominence=p.min_excursion_leg * leg, wlen=window)
            for k, i in enumerate(at):
                size = prominence(signal, i, int(about["left_bases"][k]), int(about["right_bases"][k]))
                found.append(Extremum(refine_extremum(segment.time_s, signal, i), side, event, size))
    return found


def prominence(signal: np.ndarray, at: int, left: int, right: int) -> float:
    """The smaller of the drops to both sides, but a drop that the end of the segment cuts short does not count."""
    drops = float(signal[at] - signal[left]), float(signal[at] - signal[right])
    one_is_cut = (left == 0) != (right == len(signal) - 1)
    return max(drops) if one_is_cut else min(drops)


def _thresholds(per_segment: list[list[Extremum]], least: float, p: EventParams) -> dict[tuple[str, str], float]:
    """Per side and event: the larger of the absolute threshold and a fraction of the typical prominence."""
    out = {}
    for side in SIDES:
        for event in (FOOT_DOWN, FOOT_UP):
            seen = [e.prominence for part in per_segment for e in part if (e.side, e.event) == (side, event)]
            typical = float(np.median(seen)) if seen else 0.0
            out[side, event] = max(least, p.min_prominence_ratio * typical)
    return out


def _candidate(e: Extremum, threshold: dict[tuple[str, str], float], confidence: np.ndarray) -> Candidate:
    c = confidence[SIDES.index(e.side)]
    ratio = threshold[e.side, e.event] / e.prominence
    return Candidate(e.time_s, e.side, e.event, float(c / (1 + ratio**2)))


def _mean_known(confidence: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Mean (2,) of the known confidences (T, 2) of each foot; `otherwise` (2,) if the source states none."""
    known = np.isfinite(confidence)
    n = known.sum(axis=0)
    return np.where(n > 0, np.where(known, confidence, 0.0).sum(axis=0) / np.maximum(n, 1), otherwise)


def _walks(run: list[Candidate], segment: Segment, leg: float, p: EventParams) -> bool:
    """Enough steps, of both feet, and the feet pass each other by enough."""
    downs = [c for c in run if c.event == FOOT_DOWN]
    if len(downs) < p.min_foot_downs:
        return False
    inside = (segment.time_s >= run[0].time_s) & (segment.time_s <= run[-1].time_s)
    apart = segment.values[inside, 0] - segment.values[inside, 1]
    return len(apart) > 1 and float(np.ptp(apart)) >= 1.5 * p.min_excursion_leg * leg


def _why_not(swing: float, n_candidates: int, p: EventParams) -> str:
    if swing < 1.5 * p.min_excursion_leg:
        return (
            f"no walking: the feet pass each other by {swing:.2f} leg lengths at most, "
            f"walking needs {1.5 * p.min_excursion_leg:.2f}"
        )
    return (
        f"no walking: {n_candidates} movements of the feet, but not {p.min_foot_downs} steps in the order "
        "left down, right up, right down, left up"
    )


def _checks(feet: FootTrajectories, n_events: int, breaks: int) -> tuple[Check, ...]:
    advice = "an event is missing or out of order: look at the feet in the overlay around the end of each bout"
    order = warn_if(breaks, "event_order_breaks", float(breaks), 0.0, advice)
    return (Check("walking", PASS, float(n_events), None), order, *heading_check(feet.heading_agreement))
