"""Timed tasks: sit-to-stand, timed up and go and squats, from their own events (docs/measures.md, "Tasks").

The events are times at which the height of the hips, or the heading of the pelvis, has covered 15 % or 85 % of the way
from one level to the next.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from pbl_pipeline import words
from pbl_pipeline.qc import Check, failed
from pbl_pipeline.results.measures import Measure
from pbl_pipeline.sampling import interval_of

from .cycle_measures import MEASURES, measure_of
from .motion import BodyPoses, trial_poses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: Activity (`Condition.activity`) -> its measures in order; the unit is in the name.
TASK_MEASURES: dict[str, tuple[str, ...]] = {
    "sit_to_stand": (
        "five_rises_time_s",
        "rise_count",
        "attempt_count",
        "rise_time_s",
        "sit_time_s",
        "peak_trunk_lean_deg",
    ),
    "tug": (
        "tug_time_s",
        "rise_time_s",
        "walk_out_time_s",
        "turn_time_s",
        "walk_back_time_s",
        "turn_to_sit_time_s",
        "sit_time_s",
        "peak_trunk_lean_deg",
    ),
    "squat": ("squat_count", "squat_time_s", "squat_knee_flexion_deg", "peak_trunk_lean_deg"),
}
#: Every measure of a trial in order.
TRIAL_MEASURES = (*MEASURES, *words.TASKS)
#: Least lowering of the hips of a squat, and least distance between seat and standing (fractions of the leg's length).
LOWERED, APART = 0.25, 0.12
#: Fractions of the way from the seat to standing: between two extremes; least of standing and of an attempt to rise;
#: most of a seat; of one plateau.
TURNED, WHOLE, ATTEMPT, SEATED, NEAR = 0.35, 0.95, 0.4, 0.25, 0.15
#: A rise that is so close to `WHOLE` may be either.
DOUBT = 0.015
#: Fraction of the variance of the hips' height that the knees explain if they are to tell standing.
EXPLAINED = 0.9
#: Fractions of the way between two levels at which a movement begins and ends.
BEGIN, END = 0.15, 0.85
#: Knees that are never straighter do not tell standing from an attempt (deg).
BENT_DEG = 40.0
#: Standard deviation of the Gaussian that smooths height, knees and lean (s).
SMOOTH_S = 0.05
#: The heading is fitted from the rise until this time after sitting down (s), in steps of (s), of at least so many.
SEATED_S, FITTED_S, MIN_FITTED = 1.0, 0.1, 20
#: Angles of a half turn, and largest error of the fitted heading over some tenths of a second (deg).
HALF_TURN_DEG, MISFIT_DEG = (100.0, 280.0), 45.0
#: Cost of a line that is not level, in the error (deg) of one step by each degree between its ends.
LEVEL_COST = 1.0
#: Where 3 x^2 - 2 x^3 is `BEGIN` and `END`.
_SMOOTHSTEP = tuple(0.5 - np.sin(np.arcsin(1 - 2 * part) / 3) for part in (BEGIN, END))
#: Gaps in view up to this time are bridged (s).
BRIDGED_S = 0.25


@dataclasses.dataclass(frozen=True)
class TaskMotion:
    """Signals in which the events of tasks are found; NaN in frames without the person."""

    time_s: Float[np.ndarray, " T"]  # (T,)
    #: (T,) 1 - height of the hips over the lower ankle / length of the leg: about 0 standing, 0.5 sitting.
    lowered: Float[np.ndarray, " T"]
    #: (T,) inclination of the line from the middle of the hips to the middle of the shoulders from the vertical.
    lean_deg: Float[np.ndarray, " T"]
    knee_deg: Float[np.ndarray, " T"]  # (T,) angle between thigh and shank, mean of both: knee flexion
    heading_deg: Float[np.ndarray, " T"]  # (T,) heading of the pelvis on the floor, without jumps of 360

    @classmethod
    def of_points(
        cls,
        time_s: Float[np.ndarray, " T"],
        hip_m: Float[np.ndarray, "T 2 3"],
        knee_m: Float[np.ndarray, "T 2 3"],
        ankle_m: Float[np.ndarray, "T 2 3"],
        shoulder_m: Float[np.ndarray, "T 2 3"],
    ) -> TaskMotion:
        """Return the motion of joint centres [left, right] in a world with z up."""
        left = hip_m[:, 0] - hip_m[:, 1]
        heading = np.full(len(time_s), np.nan)
        seen = np.isfinite(left).all(axis=1)
        heading[seen] = np.degrees(np.unwrap(np.arctan2(-left[seen, 0], left[seen, 1])))
        up = np.array([0.0, 0.0, 1.0])
        thigh, shank = hip_m - knee_m, knee_m - ankle_m
        leg_m = np.nanmedian(np.linalg.norm(thigh, axis=-1) + np.linalg.norm(shank, axis=-1))
        height_m = hip_m[:, :, 2].mean(axis=1) - ankle_m[:, :, 2].min(axis=1)
        return cls(
            np.asarray(time_s, float),
            1.0 - height_m / leg_m,
            _between_deg(shoulder_m.mean(axis=1) - hip_m.mean(axis=1), up),
            _between_deg(thigh, shank).mean(axis=1),
            heading,
        )


@dataclasses.dataclass(frozen=True)
class Move:
    """One movement between two levels: its begin and end (s), and its direction (1 to the higher level)."""

    begin_s: float
    end_s: float
    direction: int


@dataclasses.dataclass(frozen=True)
class Stands:
    """Movements between a seat, or the bottom of a squat, and standing, in order of time."""

    moves: list[Move]  #: risings to standing (direction -1) and goings down from it (1)
    attempts: list[Move]  #: risings that went back to the seat before the person stood; each ends where it is highest
    dips: int  #: times that the hips went down, but not to the seat
    cut: bool  #: the recording begins during a rise
    doubt: float | None  #: fraction of the way up of a rise that may or may not be one to standing


def task_motion(fit: TrialFit, poses: BodyPoses | None = None) -> TaskMotion:
    """Return the motion of a fit; `poses` saves computing them again. Raises `PblError` GAIT_INPUT."""
    poses = poses or trial_poses(fit)
    return TaskMotion.of_points(fit.time_s, *map(poses.of_sides, ("femur", "tibia", "talus", "humerus")))


def task_measures(
    motion: TaskMotion, activity: str, fit_checks: Sequence[Check] = ()
) -> tuple[dict[str, Measure | None], dict[str, str]]:
    """Return the measures of a task by name (`TASK_MEASURES`) and the reasons of those that are None.

    Both are empty for an activity that is not a task. If one of `fit_checks` FAILs, no measure is known.
    """
    names = TASK_MEASURES.get(activity, ())
    measures: dict[str, Measure | None] = dict.fromkeys(names)
    if not names:
        return measures, {}
    if checks := failed(fit_checks):
        return measures, dict.fromkeys(names, f"a check of the fit failed: {', '.join(checks)}")
    reasons: dict[str, str] = {}
    for name, (values, reason) in _TASKS[activity](motion).items():
        if reason or not values:
            reasons[name] = reason
        else:
            measures[name] = task_measure(values)
    return measures, reasons


def stands(motion: TaskMotion, least: float | None = None) -> Stands:
    """Return the movements between seat and standing.

    A seat is a lowest level of the hips that is within `SEATED` of the way of the deepest, or, for squats, at least
    `least` (fraction of the leg) below standing. Between two seats the person stood if the hips came `WHOLE` of the way
    up, and made an attempt if they came `ATTEMPT` of it.
    """
    value = _smooth(motion.time_s, motion.lowered, SMOOTH_S)
    seen = np.flatnonzero(np.isfinite(value))
    time, value = motion.time_s[seen], value[seen]
    if len(seen) < 2 or np.ptp(value) < (least or APART):
        return Stands([], [], 0, cut=False, doubt=None)
    way = float(np.ptp(value))
    lows, tops = (_peaks(v, TURNED * way if least is None else 0.8 * least) for v in (value, -value))
    low, high = _furthest(value[lows], NEAR * way), -_furthest(-value[tops], NEAR * way)
    up = (low - value) / (low - high)
    if least is None:
        up = _by_knees(up, value, _smooth(motion.time_s, motion.knee_deg, SMOOTH_S)[seen], tops, low)
    seat, whole = (low - SEATED * (low - high), WHOLE) if least is None else (high + least, 1.0 - SEATED)
    seats = [int(i) for i in lows if value[i] >= seat]
    last = len(value) - 1
    moves, attempts, doubt = [], [], None
    for a, b in itertools.pairwise([0, *seats, last]):
        top = a + int(np.argmax(up[a : b + 1]))
        if up[top] < ATTEMPT or top in seats:
            continue
        doubt = float(up[top]) if abs(up[top] - whole) < DOUBT else doubt
        # An attempt begins as a rise would.
        level = _level(value, top, NEAR * way) if up[top] >= whole else high
        sat_a, sat_b = ((i, _level(value, i, NEAR * way)) for i in (a, b))
        rise = [_move(time, value, sat_a, (top, level))] if a in seats else []
        sit = [_move(time, value, (top, level), sat_b)] if b in seats else []
        if up[top] >= whole:
            moves += rise + sit
        elif rise and sit:
            attempts += rise
    dips = [i for i in lows if value[i] < seat and i < last]
    return Stands(moves, attempts, sum(i > 0 for i in dips), cut=0 in dips, doubt=doubt)


def _peaks(value: np.ndarray, least: float) -> np.ndarray:
    """Return the maxima from which the values fall by `least` on both sides, or to an end, before they are higher."""
    from scipy.signal import find_peaks  # takes longer to import than most commands run

    return find_peaks(np.pad(value, 1, constant_values=value.min() - least), prominence=least)[0] - 1


def _level(value: np.ndarray, i: int, near: float) -> float:
    """Return the level of the plateau around sample i."""
    away = np.flatnonzero(np.abs(value - value[i]) > near)
    return float(np.median(value[away[away < i].max(initial=-1) + 1 : away[away > i].min(initial=len(value))]))


def _move(time: np.ndarray, value: np.ndarray, begin: tuple[int, float], end: tuple[int, float]) -> Move:
    """Return the movement between two plateaus, each a sample of it and its level."""
    (a, low), (b, high) = begin, end
    done = (value[a : b + 1] - low) / (high - low)
    last = a + int(np.argmax(done >= END)) if (done >= END).any() else b
    first = a + int(np.flatnonzero(done[: last - a + 1] <= BEGIN).max(initial=0))
    return Move(
        _crossing(time, value, first, low + BEGIN * (high - low)),
        _crossing(time, value, max(last - 1, 0), low + END * (high - low)),
        1 if high > low else -1,
    )


def _furthest(values: np.ndarray, near: float) -> float:
    """Return the median of the values that are near the largest one."""
    return float(np.median(values[values >= values.max() - near]))


def _by_knees(up: np.ndarray, value: np.ndarray, knee_deg: np.ndarray, tops: np.ndarray, low: float) -> np.ndarray:
    """Return the fraction of the way up; near standing from the knees, which straighten much where hips rise little.

    Where the knees explain the height of the hips in this recording (r2 of `EXPLAINED`), the height that they mean
    stands for the measured one; `low` is the level of the seat.
    """
    upper = up > ATTEMPT
    if not np.isfinite(knee_deg).all():
        return up
    bent = np.radians(knee_deg)
    terms = np.column_stack([np.ones_like(bent), bent, 1.0 - np.cos(bent / 2)])
    by_knee = terms @ np.linalg.lstsq(terms[upper], value[upper], rcond=None)[0]
    if np.var((value - by_knee)[upper]) > (1 - EXPLAINED) * np.var(value[upper]):
        return up
    high = -_furthest(-by_knee[tops], (1 - WHOLE) * (low - value.min()))
    return np.where(upper, (low - by_knee) / (low - high), up)


def turns(motion: TaskMotion, rise: Move, sit: Move) -> tuple[list[Move], str]:
    """Return the two half turns between a rise and the next sitting down, or none and the reason.

    The heading is fitted by least squares: constant on the seat, a line on each way, which need not be straight, and
    between them ramps 3 x^2 - 2 x^3 (to the first way, to the second, to the seat). A turn is from `BEGIN` to `END` of
    such a ramp. `LEVEL_COST` holds the lines level where the data leave it open.
    """
    known = np.isfinite(motion.heading_deg)
    known &= (motion.time_s >= rise.begin_s) & (motion.time_s <= sit.end_s + SEATED_S)
    every = max(1, round(FITTED_S / interval_of(motion.time_s)))
    n = np.count_nonzero(known) // every
    time, heading = (v[known][: n * every].reshape(n, every).mean(axis=1) for v in (motion.time_s, motion.heading_deg))
    up = time > rise.end_s
    if np.count_nonzero(up) < MIN_FITTED:
        return [], "two half turns are needed, 0 were found"
    half, steps = 0.8, time[up][_steps(heading[up])]
    start = np.diff([time[0], rise.end_s, rise.end_s + half, *(s + d for s in steps for d in (-half, half))])
    least = np.array([0.05, *[0.3, 0.05] * 2, 0.3])
    # The seat is left by the end of the rise or soon after, and the way to the first line is short.
    most = np.array([max(rise.end_s - time[0], 0.0) + half, 3 * half, *[np.inf] * 4])
    level = LEVEL_COST * np.array([[0, -1, 1, 0, 0, 0], [0, 0, 0, -1, 1, 0]])
    wanted = np.append(heading, [0.0, 0.0])

    def solved(spans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        terms = np.concatenate([_ramps(time, time[0] + np.cumsum(spans)), level])
        values = np.linalg.lstsq(terms, wanted, rcond=None)[0]
        return values, terms @ values - wanted

    start = np.clip(start, least + 0.01, most - 0.01)
    spans = least_squares(lambda x: solved(x)[1], start, bounds=(least, most), diff_step=1e-3).x
    values, errors = solved(spans)
    angles, knots = np.diff(values), time[0] + np.cumsum(spans)
    halves = [k for k in (2, 4) if HALF_TURN_DEG[0] <= abs(angles[k]) <= HALF_TURN_DEG[1]]
    if len(halves) < 2:
        return [], f"two half turns are needed, {len(halves)} were found"
    if np.abs(gaussian_filter1d(errors[:n], 0.5 / FITTED_S)).max() > MISFIT_DEG:
        return [], "the person turned more often than twice"
    begin, end = (knots[:-1] + x * np.diff(knots) for x in _SMOOTHSTEP)
    return [Move(float(begin[k]), float(end[k]), int(np.sign(angles[k]))) for k in halves], ""


def _steps(values: np.ndarray) -> list[int]:
    """Return the two samples where three constant levels that fit the values best change."""
    n = len(values)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    i, j = np.triu_indices(n - 1, 1) + np.array(1)
    kept = sums[i] ** 2 / i + (sums[j] - sums[i]) ** 2 / (j - i) + (sums[n] - sums[j]) ** 2 / (n - j)
    best = int(np.argmax(kept))
    return [int(i[best]), int(j[best])]


def _ramps(time: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(T, 6) weights of the values at six knots: ramps from the first of each pair to the second, lines between."""
    at = np.interp(time, knots, np.arange(6.0))
    k = np.minimum(at.astype(int), 4)
    x = np.where(k % 2 == 0, (at - k) ** 2 * (3 - 2 * (at - k)), at - k)[:, None]
    return (1 - x) * np.eye(6)[k] + x * np.eye(6)[k + 1]


_Values = dict[str, tuple[list[float], str]]


def _sit_to_stand(motion: TaskMotion) -> _Values:
    found = stands(motion)
    if found.moves and (bent := float(np.nanmin(_smooth(motion.time_s, motion.knee_deg, SMOOTH_S)))) > BENT_DEG:
        unsure = f"the knees are never straighter than {bent:.0f} degrees: whether the person stood is not known"
        return dict.fromkeys(TASK_MEASURES["sit_to_stand"], ([], unsure))
    rises = [m for m in found.moves if m.direction < 0]
    n, sat_back, five = len(rises), len(found.attempts), []
    unsure = _hidden(motion, [*found.moves, *found.attempts])
    if found.doubt is not None:
        unsure = f"a rise came {100 * found.doubt:.0f} percent of the way up: whether the person stood is not known"
    reason = unsure or ("the recording begins during a rise" if found.cut else "")
    if n < 5 and not reason:
        reason = f"five rises are needed, {n} were found"
        if sat_back or found.dips:
            reason = (
                f"five rises are needed, {n} were found (sat back before standing: {sat_back}, "
                f"rose again before sitting: {found.dips})"
            )
    elif not reason:
        five = [rises[4].end_s - min(m.begin_s for m in (rises[0], *found.attempts))]
    return {
        "five_rises_time_s": (five, reason),
        "rise_count": ([] if unsure else [float(n)], unsure),
        "attempt_count": ([] if unsure else [float(sat_back)], unsure),
        **_rise_and_sit(motion, found.moves),
    }


def _tug(motion: TaskMotion) -> _Values:
    found = stands(motion)
    names = ("tug_time_s", "walk_out_time_s", "turn_time_s", "walk_back_time_s", "turn_to_sit_time_s")
    pairs = [(a, b) for a, b in itertools.pairwise(found.moves) if a.direction < 0 < b.direction]
    if not pairs:
        rises = any(m.direction < 0 for m in found.moves)
        missing = "no sitting down after the rise was found" if rises else "no rising from a seat was found"
        missing = "the recording begins during a rise" if found.cut else missing
        return dict.fromkeys(names, ([], missing)) | _rise_and_sit(motion, found.moves)
    turned = [(rise, sit, *turns(motion, rise, sit)) for rise, sit in pairs]
    # A person who stands up more often walks once.
    rise, sit, half_turns, reason = next((t for t in turned if t[2]), turned[0])
    if gap := _gap(motion, rise.begin_s, sit.end_s):
        return dict.fromkeys(names, ([], gap)) | _rise_and_sit(motion, found.moves)
    before = max((m.end_s for m in found.moves if m.end_s < rise.begin_s), default=-np.inf)
    begin_s = min(m.begin_s for m in (rise, *found.attempts) if m.begin_s > before)
    values: _Values = dict.fromkeys(names, ([], reason))
    if half_turns or len(pairs) == 1:
        values["tug_time_s"] = [sit.end_s - begin_s], ""
    if half_turns:
        edges = [rise.end_s, *(s for turn in half_turns for s in (turn.begin_s, turn.end_s))]
        values |= {name: ([part], "") for name, part in zip(names[1:], np.diff(edges).tolist(), strict=True)}
    return values | _rise_and_sit(motion, [rise, sit])


def _squat(motion: TaskMotion) -> _Values:
    moves = stands(motion, LOWERED).moves
    pairs = [(a, b) for a, b in itertools.pairwise(moves) if a.direction > 0 > b.direction]
    none = "" if pairs else "no squat that lowers the hips by a quarter of the leg was found"
    unsure = _hidden(motion, moves)
    knee, lean = (_smooth(motion.time_s, v, SMOOTH_S) for v in (motion.knee_deg, motion.lean_deg))
    during = [(motion.time_s >= a.begin_s) & (motion.time_s <= b.end_s) for a, b in pairs]
    return {
        "squat_count": ([] if unsure else [float(len(pairs))], unsure),
        "squat_time_s": ([b.end_s - a.begin_s for a, b in pairs], none),
        "squat_knee_flexion_deg": ([float(np.nanmax(knee[d])) for d in during], none),
        "peak_trunk_lean_deg": ([float(np.nanmax(lean[d])) for d in during], none),
    }


_TASKS: dict[str, Callable[[TaskMotion], _Values]] = {"sit_to_stand": _sit_to_stand, "tug": _tug, "squat": _squat}


def _rise_and_sit(motion: TaskMotion, moves: Sequence[Move]) -> _Values:
    """Return times of rising and sitting down, and the trunk's furthest lean around each rise."""
    rises, sits = ([m for m in moves if m.direction == d and not _gap(motion, m.begin_s, m.end_s)] for d in (-1, 1))
    lean = _smooth(motion.time_s, motion.lean_deg, SMOOTH_S)
    # The trunk leans before the hips rise.
    peaks = [lean[(motion.time_s >= m.begin_s - 1.0) & (motion.time_s <= m.end_s)] for m in rises]
    no_rise = "" if rises else "no rising from a seat was found"
    return {
        "rise_time_s": ([m.end_s - m.begin_s for m in rises], no_rise),
        "sit_time_s": ([m.end_s - m.begin_s for m in sits], "" if sits else "no sitting down was found"),
        "peak_trunk_lean_deg": ([float(np.nanmax(p)) for p in peaks], no_rise),
    }


def _crossing(time: np.ndarray, values: np.ndarray, i: int, level: float) -> float:
    """Return the time at which the line from sample i to the next is at the level (s)."""
    j = min(i + 1, len(values) - 1)
    step = values[j] - values[i]
    part = 0.0 if step == 0 else float(np.clip((level - values[i]) / step, 0.0, 1.0))
    return float(time[i] + part * (time[j] - time[i]))


def _smooth(time_s: np.ndarray, values: np.ndarray, sd_s: float) -> np.ndarray:
    """Return the values smoothed; gaps up to `BRIDGED_S` are bridged, longer ones stay NaN."""
    seen = np.flatnonzero(np.isfinite(values))
    if len(seen) < 2:
        return values
    filled = np.interp(time_s, time_s[seen], values[seen])
    smooth = gaussian_filter1d(filled, sd_s / interval_of(time_s), mode="nearest")
    after = np.clip(np.searchsorted(time_s[seen], time_s), 0, len(seen) - 1)
    gap = time_s[seen][after] - time_s[seen][np.maximum(after - 1, 0)]
    inside = (time_s >= time_s[seen[0]]) & (time_s <= time_s[seen[-1]])
    known = inside & (np.isfinite(values) | (gap <= BRIDGED_S))
    return np.where(known, smooth, np.nan)


def _hidden(motion: TaskMotion, moves: Sequence[Move]) -> str:
    """Return the reason why movements cannot be counted; empty if the person was in view from first to last."""
    ends = [s for m in moves for s in (m.begin_s, m.end_s)]
    return _gap(motion, min(ends), max(ends)) if ends else ""


def _gap(motion: TaskMotion, begin_s: float, end_s: float) -> str:
    """Return the reason why a time from begin to end is not known; empty if the person was in view throughout."""
    seen = motion.time_s[np.isfinite(motion.lowered)]
    first = max(int(np.searchsorted(seen, begin_s - BRIDGED_S, side="right")) - 1, 0)
    inside = seen[first : int(np.searchsorted(seen, end_s + BRIDGED_S)) + 1]
    longest = float(np.diff(inside).max()) if len(inside) > 1 else 0.0
    return f"the person is out of view for {longest:.1f} s in between" if longest > 2 * BRIDGED_S else ""


def _between_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def task_measure(values: Sequence[float]) -> Measure:
    """Return the measure of repetitions of a task."""
    return measure_of([("", value) for value in values])
