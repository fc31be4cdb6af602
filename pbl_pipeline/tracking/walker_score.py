"""Choice of the person to measure by a score, with a reason in words.

The score of a person is a weighted mean of five parts from 0 to 1:

- *in view*: fraction of the video's time in which she is tracked;
- *walks*: time in which she moves over the ground, upright, at a walking speed, over a time that suffices to measure;
- *size*: her median height in the picture over that of the tallest candidate, or over a height that suffices;
- *upright*: fraction of her frames with the body axis within 30 degrees of the vertical;
- *central*: 1 in the middle of the picture, 0 at its edge (median over her frames).

Walking is judged without a camera calibration: a person of height h px at (x, y) px stands, in units of her own
height, at (x, y, f) / h from the camera, f being the focal length in px. Only the ratio of f to the picture size
enters, and only for walking towards or away from the camera, so a usual value serves. The direction of walking is
stated in the reason; it does not enter the score, as a walk is filmed from every side.

The usual second person is a therapist beside the patient: nearer, larger, walking as far. So of two people who both
walk, size does not decide; the other parts (time in view, position) often differ too little, and a person chooses.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results import PersonTrack, SubjectChoice

from .associate import measure
from .types import Detection, Tracking

#: Largest number of people who are described if they are too similar to choose between, the best first.
MOST_LISTED = 6


@dataclasses.dataclass(frozen=True)
class SubjectParams:
    """Weights of the parts of the score (they are normalised), and limits of the automatic choice."""

    weight_in_view: float = 0.25
    weight_walks: float = 0.35
    weight_size: float = 0.20
    weight_upright: float = 0.10
    weight_central: float = 0.10
    margin: float = 0.10  # least lead of the best person over every other; otherwise a person has to choose
    walk_enough_s: float = 4.0  # longer walking does not raise the score
    size_enough: float = 0.35  # nor does a greater height, as a fraction of the picture's
    # Size is ignored between two people if the walking time and the height of one are at least this fraction of the
    # other's.
    beside: float = 0.5
    min_time_s: float = 1.0  # people in view for less are candidates only if all are
    # Movement is judged over these times, the longer one for slow people and those who walk towards or away from the
    # camera.
    walk_windows_s: tuple[float, ...] = (2.0, 5.0)
    walk_distance: float = 0.4  # least movement within a window, in body heights: more than one step
    walk_steadiness: float = 0.85  # least variance of the position explained by steady movement (one sudden step: 0.75)
    walk_speed_max: float = 1.8  # body heights per second, the speed of a runner
    # Natural logarithm of a change of apparent size that is not taken for approach: bending, sitting and raising the
    # arms change the size by a third.
    size_slack: float = 0.3
    max_lean_rad: float = 0.52
    focal_share: float = 0.72  # focal length over the longer side of the picture (of the median phone)


@dataclasses.dataclass(frozen=True)
class _Person:
    person_id: int
    time_s: float
    in_view: float
    walk_s: float
    walks: float
    direction: str
    appearances: int
    height_px: float
    upright: float
    central: float


def choose_walker(tracking: Tracking, params: SubjectParams, override: int | None = None) -> SubjectChoice:
    """Choose the person who walks, is tall, upright, central and long in view, by a weighted score. `override` is the
    person's number chosen by hand, which takes precedence (status MANUAL).

    Raises `PblError` SUBJECT_UNKNOWN_PERSON if the override is not among the persons.
    """
    people = [_describe(p, tracking, params) for p in tracking.persons]
    scores = _scores(people, tracking, params)
    if override is not None:
        if override not in scores:
            raise PblError(
                "SUBJECT_UNKNOWN_PERSON",
                found=said("person {n}", n=override),
                expected=f"one of the tracked persons: {', '.join(map(str, scores)) or 'none was found'}",
                next_step="look at the numbers in the list of persons and choose one of them",
                key=override,
            )
        others = {k: v for k, v in scores.items() if k != override}
        second = max(others, key=others.__getitem__, default=None)
        second_score = others[second] if second is not None else float("nan")
        reason = f"Person {override} was chosen by hand."
        return SubjectChoice("MANUAL", override, scores[override], second, second_score, scores, reason)
    if not people:
        reason = "No person was found in the video."
        return SubjectChoice("NO_PERSON", None, float("nan"), None, float("nan"), {}, reason)
    by_id = {p.person_id: p for p in people}
    long_enough = [p.person_id for p in people if p.time_s >= params.min_time_s]
    candidates = sorted(long_enough or scores, key=lambda k: -scores[k])
    best = candidates[0]
    words = _words(by_id[best], tracking)
    if len(candidates) == 1:
        others = f" in view for {params.min_time_s:g} s or more" if len(people) > 1 else " found"
        reason = f"Person {best} {words}, and is the only person{others}."
        return SubjectChoice("CHOSEN", best, scores[best], None, float("nan"), scores, reason)
    second = candidates[1]
    tallest = max(p.height_px for p in people)

    def lead(other: int) -> float:
        """Lead of the best over another; without that by size between two who walk beside each other."""
        a, b = by_id[best], by_id[other]
        walk, tall = sorted((a.walks, b.walks)), sorted((a.height_px, b.height_px))
        beside = walk[0] > 0 and walk[0] >= params.beside * walk[1] and tall[0] >= params.beside * tall[1]
        unfair = _size_part(a, tracking, tallest, params) - _size_part(b, tracking, tallest, params) if beside else 0.0
        return scores[best] - scores[other] - max(unfair, 0.0)

    if min(lead(k) for k in candidates[1:]) < params.margin:
        close = [k for k in candidates if k == best or lead(k) < params.margin]
        shown = close[:MOST_LISTED]
        listed = "; ".join(f"person {k} {_words(by_id[k], tracking)} (score {scores[k]:.2f})" for k in shown)
        listed += f"; and {len(close) - len(shown)} others" if len(close) > len(shown) else ""
        reason = f"{len(close)} people are too alike to choose between: {listed}. A person has to choose."
        return SubjectChoice("NEEDS_CHOICE", None, scores[best], second, scores[second], scores, reason)
    reason = (
        f"Person {best} {words} (score {scores[best]:.2f}); the next, person {second}, "
        f"{_words(by_id[second], tracking)} (score {scores[second]:.2f})."
    )
    return SubjectChoice("CHOSEN", best, scores[best], second, scores[second], scores, reason)


def time_in_view_s(track: PersonTrack, time_s: np.ndarray) -> float:
    """Seconds in which the person has a box: the number of her frames times the mean frame interval."""
    return float(np.isfinite(track.box_px[:, 0]).sum()) * step_s(time_s)


def step_s(time_s: np.ndarray) -> float:
    """Return the mean time (s) between frames; 0 for a single one."""
    return float(time_s[-1] - time_s[0]) / (len(time_s) - 1) if len(time_s) > 1 else 0.0


def _describe(track: PersonTrack, tracking: Tracking, params: SubjectParams) -> _Person:
    rows = np.flatnonzero(np.isfinite(track.box_px[:, 0]))
    width, height = tracking.image_size_px
    state = np.array([measure(Detection(track.box_px[r], 1.0, track.roi_px[r])) for r in rows])
    time = tracking.time_s[rows]
    total = step_s(tracking.time_s) * len(tracking.time_s)
    in_view = time_in_view_s(track, tracking.time_s)
    lean = np.abs(np.nan_to_num(track.roi_px[rows, 3]))
    upright = lean <= params.max_lean_rad
    walking, towards = _walking(state, time, upright, max(width, height) * params.focal_share, params)
    walk_s = float(walking.mean()) * in_view
    enough = min(params.walk_enough_s, total)
    offset = np.hypot(state[:, 0] / width - 0.5, state[:, 1] / height - 0.5)
    return _Person(
        person_id=track.person_id,
        time_s=in_view,
        in_view=in_view / total if total > 0 else 1.0,
        walk_s=walk_s,
        walks=min(walk_s / enough, 1.0) if enough > 0 else 0.0,
        direction=_direction(towards[walking]),
        appearances=1 + int((np.diff(rows) > 1).sum()),
        height_px=float(np.exp(np.median(state[:, 2]))),
        upright=float(upright.mean()),
        central=float(np.clip(1.0 - 2.0 * np.median(offset), 0.0, 1.0)),
    )


def _walking(
    state: np.ndarray, time: np.ndarray, upright: np.ndarray, focal: float, params: SubjectParams
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: frames around which the person moves steadily over the ground, upright, at a walking speed; and (n,)
    the fraction of that movement towards the camera (1 straight to it, -1 straight away, 0 across the picture).

    In each window a straight line is fitted to the position in body heights: a step in place, a jump or a jitter of the
    box has no lasting slope.
    """
    size = np.exp(state[:, 2])
    unit = np.median(size)
    # Ten frames a second are judged, and the others as the nearest of them.
    step = max(round(0.1 / step_s(time)), 1) if len(time) > 1 else 1
    walking, towards = np.zeros(len(time), bool), np.zeros(len(time))
    for window in params.walk_windows_s:
        # Near the ends of the track the window moves inwards, so that it keeps its length.
        middle = np.clip(time, time[0] + window / 2, max(time[-1] - window / 2, time[0] + window / 2))
        for i in range(0, len(time), step):
            first, last = np.searchsorted(time, middle[i] + np.array([-1, 1]) * (window / 2 + 1e-9))
            if last - first < 3:
                continue
            near, around = slice(first, last), slice(max(i - step // 2, 0), i + step - step // 2)
            span = time[last - 1] - time[first]
            tau = time[near] - time[near].mean()
            across, up, log_size = (tau @ state[near] / (tau @ tau)) * span
            depth = focal / np.median(size[near]) * max(abs(log_size) - params.size_slack, 0.0)
            moved = float(np.hypot(across / unit, depth))
            # The larger part of the movement must be steady.
            part = state[near, 0] if abs(across / unit) >= depth else state[near, 2]
            steady = np.corrcoef(tau, part)[0, 1] ** 2 >= params.walk_steadiness if np.ptp(part) > 0 else False
            # A person who jumps off a wall also moves sideways, but more up or down than a walker on any slope.
            climbs = abs(up / unit) > 0.5 * moved
            at_speed = params.walk_distance <= moved <= params.walk_speed_max * span
            if at_speed and steady and not climbs and upright[near].mean() > 0.5:
                walking[around] = True
                towards[around] = np.sign(log_size) * depth / moved
    return walking, towards


def _direction(towards: np.ndarray) -> str:
    """Direction of most of the walking, in words."""
    if not len(towards):
        return ""
    to, away = float((towards > 0.7).mean()), float((towards < -0.7).mean())
    if to + away <= 0.5:
        return " across the picture"
    if min(to, away) > 0.25 * max(to, away):
        return " to and from the camera"
    return " towards the camera" if to > away else " away from the camera"


def _size(person: _Person, tracking: Tracking, tallest_px: float, params: SubjectParams) -> float:
    return min(person.height_px / min(tallest_px, params.size_enough * tracking.image_size_px[1]), 1.0)


def _size_part(person: _Person, tracking: Tracking, tallest_px: float, params: SubjectParams) -> float:
    return params.weight_size * _size(person, tracking, tallest_px, params) / _weights(params).sum()


def _weights(p: SubjectParams) -> np.ndarray:
    return np.array([p.weight_in_view, p.weight_walks, p.weight_size, p.weight_upright, p.weight_central])


def _scores(people: list[_Person], tracking: Tracking, params: SubjectParams) -> dict[int, float]:
    tallest = max((p.height_px for p in people), default=1.0)
    weight = _weights(params) / _weights(params).sum()
    shares = {
        p.person_id: [p.in_view, p.walks, _size(p, tracking, tallest, params), p.upright, p.central] for p in people
    }
    return {k: float(np.clip(weight @ np.array(v), 0.0, 1.0)) for k, v in shares.items()}


def _words(person: _Person, tracking: Tracking) -> str:
    fraction = person.walk_s / person.time_s if person.time_s > 0 else 0.0
    walks = "walks" if fraction > 0.5 else "walks part of the time" if fraction > 0.2 else "stays in place"
    way = person.direction if fraction > 0.2 else ""
    posture = "" if person.upright > 0.5 else ", mostly not upright"
    tall = person.height_px / tracking.image_size_px[1]
    times = f" ({person.appearances} times)" if person.appearances > 1 else ""
    seconds = f"is in view for {person.time_s:.1f} s{times}"
    return f"{seconds}, {walks}{way}{posture}, and takes {tall:.0%} of the picture's height"
