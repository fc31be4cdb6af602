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

from pbl_pipeline import words
from pbl_pipeline.qc import Check, failed
from pbl_pipeline.sampling import interval_of

from .cycle_measures import MEASURES, Measure, measure_of
from .motion import BodyPoses, trial_poses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: Activity (`Condition.activity`) -> its measures in order; the unit is in the name.
TASK_MEASURES: dict[str, tuple[str, ...]] = {
    "sit_to_stand": ("five_rises_time_s", "rise_count", "rise_time_s", "sit_time_s", "peak_trunk_lean_deg"),
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
#: Lowering of the hips that separates sitting from standing, and least distance of the levels of the two, both as
#: fractions of the leg's length.
LOWERED, APART = 0.25, 0.2
#: Fractions of the way between two levels at which a movement begins and ends.
BEGIN, END = 0.15, 0.85
#: Standard deviation of the Gaussian that smooths height and lean, and the heading, which sways with each step (s).
SMOOTH_S, HEADING_SMOOTH_S = 0.05, 0.2
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


def sitting_moves(motion: TaskMotion) -> list[Move]:
    """Return the risings (direction -1) and sittings down (1) in order of time."""
    return _moves(motion.time_s, _smooth(motion.time_s, motion.lowered, SMOOTH_S), LOWERED, APART)


def turns(motion: TaskMotion) -> list[Move]:
    """Return the turns by about half a circle, in order of time."""
    heading = _smooth(motion.time_s, motion.heading_deg, HEADING_SMOOTH_S)
    seen = np.flatnonzero(np.isfinite(heading))
    if not len(seen):
        return []
    # Half circles from the first direction: a turn goes over the middle between two of them, either way round.
    from_start = (heading - np.median(heading[seen[: max(1, len(seen) // 20)]])) / 180.0
    found = []
    for k in np.unique(np.floor(from_start[seen]).astype(int)):
        found += _moves(motion.time_s, from_start, k + 0.5, 0.5, near=0.5)
    return sorted(found, key=lambda m: m.begin_s)


_Values = dict[str, tuple[list[float], str]]


def _sit_to_stand(motion: TaskMotion) -> _Values:
    moves = sitting_moves(motion)
    rises = [m for m in moves if m.direction < 0]
    five, reason = [], ""
    if len(rises) < 5:
        reason = f"five rises are needed, {len(rises)} were found"
    elif gap := _gap(motion, rises[0].begin_s, rises[4].end_s):
        reason = gap
    else:
        five = [rises[4].end_s - rises[0].begin_s]
    return {
        "five_rises_time_s": (five, reason),
        "rise_count": ([float(len(rises))], ""),
        **_rise_and_sit(motion, moves),
    }


def _tug(motion: TaskMotion) -> _Values:
    moves = sitting_moves(motion)
    rise = next((m for m in moves if m.direction < 0), None)
    sit = next((m for m in moves if m.direction > 0 and rise is not None and m.begin_s > rise.end_s), None)
    names = ("tug_time_s", "walk_out_time_s", "turn_time_s", "walk_back_time_s", "turn_to_sit_time_s")
    if rise is None or sit is None:
        missing = "no rising from a seat was found" if rise is None else "no sitting down after the rise was found"
        return dict.fromkeys(names, ([], missing)) | _rise_and_sit(motion, moves)
    if gap := _gap(motion, rise.begin_s, sit.end_s):
        return dict.fromkeys(names, ([], gap)) | _rise_and_sit(motion, moves)
    values: _Values = {"tug_time_s": ([sit.end_s - rise.begin_s], "")}
    turned = [t for t in turns(motion) if rise.begin_s < t.begin_s < sit.end_s]
    if len(turned) == 2:
        out, back = turned
        parts = (
            out.begin_s - rise.end_s,
            out.end_s - out.begin_s,
            back.begin_s - out.end_s,
            back.end_s - back.begin_s,
        )
        values |= {name: ([part], "") for name, part in zip(names[1:], parts, strict=True)}
    else:
        values |= dict.fromkeys(names[1:], ([], f"two half turns are needed, {len(turned)} were found"))
    return values | _rise_and_sit(motion, [rise, sit])


def _squat(motion: TaskMotion) -> _Values:
    moves = sitting_moves(motion)
    pairs = [(a, b) for a, b in itertools.pairwise(moves) if a.direction > 0 > b.direction]
    none = "" if pairs else "no squat that lowers the hips by a quarter of the leg was found"
    knee, lean = (_smooth(motion.time_s, v, SMOOTH_S) for v in (motion.knee_deg, motion.lean_deg))
    during = [(motion.time_s >= a.begin_s) & (motion.time_s <= b.end_s) for a, b in pairs]
    return {
        "squat_count": ([float(len(pairs))], ""),
        "squat_time_s": ([b.end_s - a.begin_s for a, b in pairs], none),
        "squat_knee_flexion_deg": ([float(np.nanmax(knee[d])) for d in during], none),
        "peak_trunk_lean_deg": ([float(np.nanmax(lean[d])) for d in during], none),
    }


_TASKS: dict[str, Callable[[TaskMotion], _Values]] = {"sit_to_stand": _sit_to_stand, "tug": _tug, "squat": _squat}


def _rise_and_sit(motion: TaskMotion, moves: Sequence[Move]) -> _Values:
    """Return times of rising and sitting down, and the trunk's furthest lean around each rise."""
    rises, sits = ([m for m in moves if m.direction == d] for d in (-1, 1))
    lean = _smooth(motion.time_s, motion.lean_deg, SMOOTH_S)
    # The trunk leans before the hips rise.
    peaks = [lean[(motion.time_s >= m.begin_s - 1.0) & (motion.time_s <= m.end_s)] for m in rises]
    no_rise = "" if rises else "no rising from a seat was found"
    return {
        "rise_time_s": ([m.end_s - m.begin_s for m in rises], no_rise),
        "sit_time_s": ([m.end_s - m.begin_s for m in sits], "" if sits else "no sitting down was found"),
        "peak_trunk_lean_deg": ([float(np.nanmax(p)) for p in peaks], no_rise),
    }


def _moves(time_s: np.ndarray, values: np.ndarray, middle: float, apart: float, near: float = np.inf) -> list[Move]:
    """Return the movements of a signal over a level `middle` between plateaus that are at least `apart`.

    A plateau's level is the furthest value from the middle, up to `near`, between two crossings. A movement without
    a frame where it begins or ends (`BEGIN`, `END`) is left out, such as one that the recording cuts.
    """
    seen = np.flatnonzero(np.isfinite(values))
    time, above = time_s[seen], values[seen] - middle
    if not len(seen):
        return []
    sign = np.where(above > 0, 1, -1)
    edges = [0, *(int(i) + 1 for i in np.flatnonzero(np.diff(sign))), len(seen)]
    kept: list[tuple[int, int, float]] = []
    for a, b in itertools.pairwise(edges):
        level = float(sign[a]) * min(near, float(np.abs(above[a:b]).max()))
        shallow = abs(level) < 0.2 * apart  # over the middle and back: no plateau
        if kept and (shallow or level * kept[-1][2] > 0):
            kept[-1] = (kept[-1][0], b, kept[-1][2] if shallow else max(kept[-1][2], level, key=abs))
        elif not shallow:
            kept.append((a, b, level))
    found = []
    for (a, b, low), (_, d, high) in itertools.pairwise(kept):
        if abs(high - low) < apart:
            continue
        direction = 1 if high > low else -1
        begin = _last_before(time, above, a, b, low + BEGIN * (high - low), direction)
        end = _first_after(time, above, b, d, low + END * (high - low), direction)
        if begin is not None and end is not None:
            found.append(Move(begin, end, direction))
    return found


def _last_before(time: np.ndarray, values: np.ndarray, a: int, b: int, level: float, direction: int) -> float | None:
    """Return the last time at which values[a:b] is at the level; None if it never is beyond it."""
    beyond = np.flatnonzero(direction * (values[a:b] - level) <= 0)
    return None if not len(beyond) else _crossing(time, values, a + int(beyond[-1]), level)


def _first_after(time: np.ndarray, values: np.ndarray, a: int, b: int, level: float, direction: int) -> float | None:
    """Return the first time at which values[a:b] is at the level; None if it never is."""
    beyond = np.flatnonzero(direction * (values[a:b] - level) >= 0)
    return None if not len(beyond) else _crossing(time, values, max(a + int(beyond[0]) - 1, 0), level)


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


def _gap(motion: TaskMotion, begin_s: float, end_s: float) -> str:
    """Return the reason why a time from begin to end is not known; empty if the person was in view throughout."""
    seen = motion.time_s[np.isfinite(motion.lowered)]
    inside = seen[(seen >= begin_s - BRIDGED_S) & (seen <= end_s + BRIDGED_S)]
    longest = float(np.diff(inside).max()) if len(inside) > 1 else 0.0
    return f"the person is out of view for {longest:.1f} s in between" if longest > 2 * BRIDGED_S else ""


def _between_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def task_measure(values: Sequence[float]) -> Measure:
    """Return the measure of repetitions of a task."""
    return measure_of([("", value) for value in values])
