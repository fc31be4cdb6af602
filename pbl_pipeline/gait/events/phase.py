"""The event model as a method: joints of both legs -> phases -> walking -> smoothed phases -> events."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import later
from pbl_pipeline.qc import PASS, WARN, Check, warn_if
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, GaitEvent, GaitEvents

from ._preconditions import check_preconditions, input_error
from .network.predict import GRID_HZ, check_model, load, predict
from .order import PLACE, comes_next
from .phase_filter import FilterParams, SmoothPhases, crossings, smooth_phases
from .types import heading_check, no_events
from .walking import WalkingParams, reach_leg, swing_leg, turns, walking_stretches

#: Order of the model's phases.
PHASE_ORDER = tuple(PLACE)


@dataclasses.dataclass(frozen=True)
class PhaseParams:
    """Parameters of the event model.

    model, model_sha256
        Name and checksum of the weights (`data/<model>.npz`).
    walking, filter
        Parameters of the stretches of walking, and of the filter.
    min_seen_s
        Shortest time in view that is searched.
    min_leg_share
        Least fraction of a stretch in which a leg is seen below the hip.
    min_foot_downs
        Fewest initial contacts of a walking bout.
    min_probability
        Events that are less likely real than this are left out, and end a bout.
    event_delay_s
        Added to every event of all four kinds alike, so that it changes neither step times nor supports: half of
        the 15 ms by which the model is early against the force plates of 11 children, because against the eye, on the
        one adult on video whose contacts were read, it is 10 ms late without any (docs/events.md).
    mirrored
        The mirror image of a walk has the mirrored events: the network's outputs for both are averaged, and the filter
        takes all four phases alike. False up to version 2.
    """

    model: str
    model_sha256: str
    walking: WalkingParams = dataclasses.field(default_factory=WalkingParams)
    filter: FilterParams = dataclasses.field(default_factory=FilterParams)
    min_seen_s: float = 1.0
    min_leg_share: float = 0.5
    min_foot_downs: int = 2
    min_probability: float = 0.2
    event_delay_s: float = 0.008
    mirrored: bool = later(False)


def detect_by_phase(feet: FootTrajectories, method: Method[PhaseParams]) -> GaitEvents:
    """Events of both feet where the phases of the event model wrap. See `detect_events`.

    Raises `PblError` GAIT_INPUT: joints upside down or mirrored, no joints at all; ASSET_MISSING: no weights.
    """
    p = method.params
    check_model(p.model, p.model_sha256)
    if feet.legs_m is None:
        raise input_error("feet without the joints of the legs", "hips and knees, ankles, heels or toes in 3D")
    grid, reason, advice = check_preconditions(feet, p.min_seen_s)
    if grid is None or reason:
        return no_events(method.name, method.hash, feet.source, reason, advice)
    time = np.asarray(feet.time_s, float)
    phases = predict(grid, p.model, p.mirrored)
    curve = load(p.model)[1]["probability"]
    stretches, half_seen = candidates(grid, phases, p)
    events: list[GaitEvent] = []
    bouts: list[tuple[float, float]] = []
    for stretch in stretches:
        judged = [c.judged(curve, p.event_delay_s) for c in stretch]
        # The delay may carry an event out of the recording.
        for bout in _bouts([e for e in judged if e.time_s <= time[-1]], p):
            events += [dataclasses.replace(e, bout=len(bouts)) for e in bout]
            bouts.append((bout[0].time_s, bout[-1].time_s))
    if not bouts:
        reason, advice = _why_not(grid, phases, len(stretches), half_seen, p)
        return no_events(method.name, method.hash, feet.source, reason, advice)
    turning = float(np.mean(turns(grid, phases, p.walking)))
    return GaitEvents(
        status=PASS,
        events=tuple(sorted(events, key=lambda e: (e.time_s, e.bout))),
        reason="",
        method=method.name,
        params_hash=method.hash,
        source=feet.source,
        walking_s=tuple(bouts),
        n_candidates=sum(len(stretch) for stretch in stretches),
        n_order_breaks=_breaks(events),
        qc=_checks(feet, events, half_seen, turning),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """A wrap of a phase, and its evidence (`event_evidence`)."""

    time_s: float
    side: str
    event: str
    evidence: np.ndarray

    def judged(self, curve: dict[str, Any], delay_s: float) -> GaitEvent:
        """The event, with its probability by the logistic curve that was fitted to held-out synthetic people."""
        score = curve["intercept"] + float(np.dot(curve["slope"], self.evidence))
        probability = float(1 / (1 + math.exp(-np.clip(score, -30, 30))))
        return GaitEvent(self.time_s + delay_s, self.side, self.event, probability)


def candidates(grid: Any, phases: Any, p: PhaseParams) -> tuple[list[list[Candidate]], int]:
    """The wraps of all four phases in each stretch of walking, in order of time, before any is judged; and the number
    of stretches that were left out because a leg is hardly seen."""
    out, half_seen = [], 0
    for first, last in walking_stretches(grid, phases, p.walking):
        cut = slice(first, last + 1)
        below: np.ndarray = np.logical_or.reduce(grid.known[cut, 2:], axis=1)
        if np.any(below.mean(axis=0) < p.min_leg_share):
            half_seen += 1
            continue
        z = np.where(np.logical_or.reduce(below, axis=1)[:, None], phases.z[cut], 0)
        smooth = smooth_phases(z, 1 / GRID_HZ, p.filter, p.mirrored)
        time_s, own = grid.time_s[cut], []
        for k, (side, event) in enumerate(PHASE_ORDER):
            for at in crossings(smooth.phase_rad[:, k], time_s):
                i = int(np.clip(np.searchsorted(time_s, at), 0, len(time_s) - 1))
                values = event_evidence(smooth, phases.z[cut], phases.walking[cut], k, i)
                own.append(Candidate(float(at), side, event, values))
        out.append(sorted(own, key=lambda c: c.time_s))
    return out, half_seen


def event_evidence(smooth: SmoothPhases, z: np.ndarray, walking: np.ndarray, k: int, i: int) -> np.ndarray:
    """Evidence for an event of kind `k` at frame `i`: the logit of walking there, the log variance of the model's
    phase, its distance from the smoothed one (rad), and the time to the end of the stretch (25 frames, at most 1)."""
    near = slice(max(i - 4, 0), i + 5)
    odds = float(np.mean(np.clip(walking[near], 1e-4, 1 - 1e-4)))
    length = float(np.clip(np.mean(np.abs(z[near, k])), 0.02, 0.9999))
    turned = z[near, k] * np.exp(-1j * smooth.phase_rad[near, k])
    off = abs(float(np.angle(turned.sum()))) if np.any(turned) else np.pi
    edge = min(i, len(z) - 1 - i) / 25.0
    return np.array([math.log(odds / (1 - odds)), math.log(-2 * math.log(length)), off, min(edge, 1.0)])


def _bouts(events: list[GaitEvent], p: PhaseParams) -> list[list[GaitEvent]]:
    """Runs of events that are likely enough, with enough initial contacts of both sides."""
    runs: list[list[GaitEvent]] = [[]]
    for e in events:
        if e.probability >= p.min_probability:
            runs[-1].append(e)
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if len(_downs(run)) >= p.min_foot_downs and len({e.side for e in run}) == 2]


def _downs(run: list[GaitEvent]) -> list[GaitEvent]:
    return [e for e in run if e.event == FOOT_DOWN]


def double_support_s(events: list[GaitEvent]) -> np.ndarray:
    """Time (s) from each initial contact to the nearest toe-off of the other foot in its bout; negative if that came
    before, with the body in the air."""
    out = []
    for down in _downs(events):
        ups = [e.time_s for e in events if e.event == FOOT_UP and e.side != down.side and e.bout == down.bout]
        if ups:
            out.append(min((u - down.time_s for u in ups), key=abs))
    return np.array(out)


def _why_not(grid: Any, phases: Any, stretches: int, half_seen: int, p: PhaseParams) -> tuple[str, str]:
    if half_seen:
        return "the person walks, but one leg is hardly seen", "film from where both legs are in view"
    if stretches:
        return f"walking, but not {p.min_foot_downs} initial contacts", "film a longer stretch"
    reach = reach_leg(swing_leg(grid))
    likely = float(phases.walking.max()) if len(phases.walking) else 0.0
    said = f"the feet pass each other by {reach:.2f} leg lengths, the event model's probability of walking is"
    if reach < p.walking.min_swing_leg:
        return f"no walking: {said} {likely:.2f} at most", "nothing to do where the person does not walk"
    return (
        f"no walking: the legs do not move as in walking forwards ({said} {likely:.2f} at most)",
        "walking backwards, sideways and on the spot has no events; else look at the legs in the overlay",
    )


def _checks(feet: FootTrajectories, events: list[GaitEvent], half_seen: int, turning: float) -> tuple[Check, ...]:
    support = double_support_s(events)
    runs = len(support) > 2 and float(np.median(support)) < 0
    breaks = _breaks(events)
    checks = [
        Check("walking", PASS, float(len(events)), None, ""),
        warn_if(
            runs,
            "double_support_present",
            round(float(np.median(support)), 3) if len(support) else None,
            0.0,
            "running: no double support; measures of walking do not apply",
        ),
    ]
    if breaks and not runs:
        advice = "two events are out of the order of walking: look at the feet in the overlay"
        checks.append(Check("event_order_breaks", WARN, float(breaks), 0.0, advice))
    if half_seen:
        advice = "a leg is hardly seen for a while: no events there"
        checks.append(Check("legs_seen", WARN, float(half_seen), 0.0, advice))
    if turning > 0:
        checks.append(Check("turning", PASS, round(turning, 3), None, "no events where the person turns"))
    return (*checks, *heading_check(feet.heading_agreement))


def _breaks(events: list[GaitEvent]) -> int:
    """Number of events that do not follow the previous one in the order of walking."""
    return sum(not comes_next(a, b) for a, b in itertools.pairwise(events) if a.bout == b.bout)
