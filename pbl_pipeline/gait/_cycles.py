"""Gait cycles between initial contacts of one side, their joint-angle curves, and the exclusion of unlike cycles."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.qc import CADENCE, Check, failed
from pbl_pipeline.results.cycles import BODY_ANGLES, NO_POSITIONS, Exclusion, GaitCycle, Lengths
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, LEFT, RIGHT, GaitEvent, GaitEvents

from ._angles import AngleSeries, angle_series
from .cycle_measures import far_leg, mostly, unusual_bound
from .ground import cycle_lengths, is_metric, where_feet_stand, why_no_lengths
from .measurement import model_of_fit
from .motion import BodyPoses, FootTrajectories, feet_from_fit, trial_poses
from .normative import THREE_ANGLES

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: A stride longer than this times the typical one may hold a missed step, one shorter than its inverse a false event:
#: the feet decide. Strides of one walk vary by a few percent, in ataxia ten.
STRIDE_RATIO = 1.35
#: The feet pass each other this often in a stride; in one that hides a missed pair of steps twice as often.
_PASSES = 2
#: A pass counts where the feet come this far beyond the middle of their range, in fractions of the range.
_BEYOND = 0.2
#: Fraction of a cycle's frames in which both feet must be seen to count passes.
_SEEN = 0.8
#: Fewest cycles of a bout for a separate typical stride; shorter bouts are compared with the whole trial.
_OWN_MEDIAN = 5

#: Angles whose curves are compared: those that move most and that every source of curves has.
CURVE_ANGLES = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion")
#: Fewest cycles of a side with curves that define what is usual.
MIN_CURVES = 5
#: A cycle is unlike the others where its curves are further from the median curves than this many robust standard
#: deviations above the usual distance, and at least this far. Both, so that neither a very regular walk nor a very
#: irregular one loses cycles that are only its own variability: a leg exchanged or a person mistaken is 20 deg off.
CURVE_SD, CURVE_MIN_DEG = 6.0, 8.0


def without_missed_steps(cycles: Sequence[GaitCycle], feet: FootTrajectories | None = None) -> list[GaitCycle]:
    """Return the cycles, those of an odd length that are not one stride marked as not used.

    A cycle beyond `STRIDE_RATIO` times the typical stride (the median of its bout, or of the trial if the bout is
    short) still is one stride if the feet pass each other as often as in one (`foot_passes`): it is used, and its
    length counts in every spread. If the feet are not known, the cycle is left out as `length_unproven`, and
    `spatiotemporal` returns no spread.
    """
    out = []
    for c in cycles:
        own = [o.stride_time_s for o in cycles if o.bout == c.bout]
        typical = np.median(own if len(own) >= _OWN_MEDIAN else [o.stride_time_s for o in cycles])
        ratio = float(c.stride_time_s / typical)
        if not 1 / STRIDE_RATIO <= ratio <= STRIDE_RATIO:
            passes = None if feet is None else foot_passes(feet, c.start_s, c.end_s)
            if passes != _PASSES:
                c = not_used(c, length_ratio=ratio, length_unproven=passes is None)
        out.append(c)
    return out


def foot_passes(feet: FootTrajectories, start_s: float, end_s: float) -> int | None:
    """Return how often the feet pass each other from `start_s` to `end_s`; None if they are hardly seen.

    Counted about the middle of the range of the heels' distance along the heading, so that a foot that is always
    placed behind the other one passes it as well.
    """
    inside = (feet.time_s >= start_s) & (feet.time_s <= end_s)
    apart = np.sum((feet.heel_m[inside, 0] - feet.heel_m[inside, 1]) * feet.forward[inside], axis=1)
    seen = apart[np.isfinite(apart)]
    if len(seen) < max(4, _SEEN * len(apart)):
        return None
    low, high = np.percentile(seen, [5, 95])
    side = np.sign(np.where(np.abs(seen - 0.5 * (low + high)) > _BEYOND * (high - low), seen - 0.5 * (low + high), 0.0))
    return int(np.count_nonzero(np.diff(side[side != 0])))


def without_odd_curves(cycles: Sequence[GaitCycle]) -> list[GaitCycle]:
    """The cycles, those whose curves are far from the median of their side marked as not used with the reason.

    Distance: root mean square over `CURVE_ANGLES` and the cycle, in degrees, to the pointwise median of the used cycles
    of the side. The threshold is the median of these distances plus `CURVE_SD` times 1.4826 of their median absolute
    deviation, and at least `CURVE_MIN_DEG`. With fewer than `MIN_CURVES` cycles of a side none is marked.
    """
    out = list(cycles)
    for side in sorted({c.side for c in cycles}):
        own = [i for i, c in enumerate(out) if c.side == side and c.used]
        names = [n for n in CURVE_ANGLES if any(n in out[i].curves for i in own)]
        chosen = [i for i in own if names and all(n in out[i].curves for n in names)]
        if len(chosen) < MIN_CURVES:
            continue
        curves = np.array([[out[i].curves[n] for n in names] for i in chosen])
        away = np.sqrt(np.mean((curves - np.median(curves, axis=0)) ** 2, axis=(1, 2)))
        usual = np.median(away)
        limit = max(CURVE_MIN_DEG, float(usual + CURVE_SD * 1.4826 * np.median(np.abs(away - usual))))
        for i, distance in zip(chosen, away, strict=True):
            if distance > limit:
                out[i] = not_used(out[i], curve_distance_deg=float(distance), n_curves=len(chosen))
    return out


def without_unusual_cadence(cycles: Sequence[GaitCycle]) -> list[GaitCycle]:
    """Return the cycles of a recording, none of them used if their mean cadence is too high for walking: steps counted
    twice, or sides exchanged at each step, make every measure wrong. A low cadence is that of many patients."""
    own = [120.0 / c.stride_time_s for c in cycles if c.used]
    mean = float(np.mean(own)) if own else 0.0
    bound = unusual_bound(mean)
    if bound is None or mean < bound:
        return list(cycles)
    return [not_used(c, failed_checks=(CADENCE,)) for c in cycles]


def refused_cadence(cycles: Sequence[GaitCycle]) -> float | None:
    """Return the mean cadence (steps/min, to 0.01) of the cycles that `without_unusual_cadence` left out; None if it
    left out none."""
    own = [120.0 / c.stride_time_s for c in cycles if c.exclusion == Exclusion(failed_checks=(CADENCE,))]
    return round(float(np.mean(own)), 2) if own else None


def with_cadence_accepted(cycles: Sequence[GaitCycle]) -> tuple[GaitCycle, ...]:
    """Return the cycles, using those again that only `without_unusual_cadence` left out: a person counted the steps."""
    return tuple(not_used(c, failed_checks=()) if CADENCE in c.exclusion.failed_checks else c for c in cycles)


def not_used(cycle: GaitCycle, **reasons: Any) -> GaitCycle:
    """The cycle, not used, with further reasons (fields of `Exclusion`)."""
    return dataclasses.replace(cycle, exclusion=dataclasses.replace(cycle.exclusion, **reasons))


#: Phases of the curves in percent of the cycle, both ends included.
REPORT_PERCENT = np.linspace(0.0, 100.0, 51)
#: Frames further apart than this inside a cycle leave it without curves.
MAX_CURVE_GAP_S = 0.15


def find_cycles(
    events: GaitEvents | Sequence[GaitEvent],
    fit: TrialFit | None = None,
    trial: str = "",
    poses: BodyPoses | None = None,
    fit_checks: Sequence[Check] = (),
    *,
    series: AngleSeries | None = None,
    feet: FootTrajectories | None = None,
    keep_ends: bool = False,
    no_width: str = "",
) -> tuple[GaitCycle, ...]:
    """All cycles whose inner events are complete and in order, with curves and lengths if a fit is given.

    First and last step of each bout are left out of the measures (Cotton et al.: "first and last step of a trial are
    discarded"). A step is the time from one initial contact to the next initial contact of the other foot. So of a bout
    with n initial contacts, which has n - 1 steps and n - 2 cycles, the cycle that starts with the first initial
    contact and the cycle that ends with the last one are not used: n - 4 cycles remain, made of exactly the n - 3 inner
    steps. Eight steps (nine initial contacts) in view leave 5 cycles. Cycles that are not used stay in the result with
    `used` False, so that both counts can be shown.

    With `keep_ends` they are used: for a recording that begins and ends while the person walks, such as a laboratory's,
    where the first step in view is not the first step of the walk.

    A cycle longer than 1.35 times the median stride of its bout, or shorter than its inverse, is not used either
    unless the feet pass each other in it as in one stride: a pair of steps that was not detected would pass as a slow
    stride, and a slow stride belongs to the spread. Nor is one whose curves are far from the others'.

    `series` and `feet` replace the fit's angles and feet if there is no fit (a laboratory's recording; positions in
    metres in a fixed world). `no_width`: the reason if these do not tell the step width.

    If one of `fit_checks`, the checks of the session fit, FAILs, no cycle is used (`pbl_pipeline.qc.failed`). Nor is
    one of a fit whose cadence is too high for walking (`with_cadence_accepted` takes that back).
    """
    found = events.events if isinstance(events, GaitEvents) else tuple(events)
    name = trial or (fit.name if fit is not None else "")
    no_lengths, metric, stated, far = "" if feet is not None else NO_POSITIONS, True, False, None
    errors, time_s = "", np.empty(0)
    if fit is not None:
        time_s = fit.time_s
        poses = poses or trial_poses(fit)
        series, feet = angle_series(fit, poses), feet_from_fit(fit, poses)
        no_lengths, metric, far = why_no_lengths(fit), is_metric(fit), far_leg(fit, poses)
        stated = fit.sized
        errors = "" if metric else model_of_fit(fit.params_hash, fit.confidence_curve)
    cycles, slides = [], []
    for bout in sorted({e.bout for e in found}):
        inside = sorted((e for e in found if e.bout == bout), key=lambda e: e.time_s)
        downs = [e for e in inside if e.event == FOOT_DOWN]
        for k, start in enumerate(downs):
            end = next((e for e in downs[k + 1 :] if e.side == start.side), None)
            if end is None:
                continue
            inner = [e for e in inside if start.time_s < e.time_s < end.time_s]
            other = RIGHT if start.side == LEFT else LEFT
            wanted = [(other, FOOT_UP), (other, FOOT_DOWN), (start.side, FOOT_UP)]
            if [(e.side, e.event) for e in inner] != wanted:
                continue
            curves, missing, curves_sd = {}, "no fit", {}
            if series is not None:
                curves, missing = cycle_curves(series, start.side, start.time_s, end.time_s)
                curves_sd = _curves_sd(series, start, end) if curves else {}
                absent = [angle.replace("_", " ") for angle in THREE_ANGLES if angle not in curves]
                missing = missing or ", ".join(f"no {angle}" for angle in absent)
            lengths, slide = Lengths(missing=no_lengths), None
            if feet is not None and not no_lengths:
                times, width = (start.time_s, inner[1].time_s, end.time_s), metric and not no_width
                lengths, slide = cycle_lengths(feet, start.side, *times, metric=metric or stated, width=width)
                if no_width and not lengths.missing:
                    lengths = dataclasses.replace(lengths, missing=no_width)
            cycle = GaitCycle(
                trial=name,
                number=0,
                bout=bout,
                side=start.side,
                start_s=start.time_s,
                opposite_foot_up_s=inner[0].time_s,
                opposite_foot_down_s=inner[1].time_s,
                foot_up_s=inner[2].time_s,
                end_s=end.time_s,
                exclusion=Exclusion(
                    first_step=start is downs[0] and not keep_ends, last_step=end is downs[-1] and not keep_ends
                ),
                curves=curves,
                curves_missing=missing,
                curves_sd=curves_sd,
                lengths=lengths,
                angle_model=series.angle_model if series is not None else BODY_ANGLES,
                far_leg="" if far is None else mostly(far[(time_s >= start.time_s) & (time_s <= end.time_s)]),
                error_model=errors if curves_sd else "",
            )
            cycles.append(cycle)
            slides.append(slide)
    cycles = without_odd_curves(without_missed_steps(where_feet_stand(cycles, slides), feet))
    if checks := failed(fit_checks):
        cycles = [dataclasses.replace(c, exclusion=Exclusion(failed_checks=checks)) for c in cycles]
    elif fit is not None:
        cycles = without_unusual_cadence(cycles)
    cycles.sort(key=lambda c: c.start_s)
    return tuple(dataclasses.replace(c, number=number) for number, c in enumerate(cycles))


def cycle_curves(series: AngleSeries, side: str, start_s: float, end_s: float) -> tuple[dict[str, np.ndarray], str]:
    """Curves of one side at `REPORT_PERCENT` of the time from `start_s` to `end_s`, in degrees; the reason if some or
    all are missing. An angle without any value is not observed and has none.

    Interpolation is monotone cubic (PCHIP) between the frames' own time stamps. Frames missing for longer than
    `MAX_CURVE_GAP_S` inside the cycle, or at its ends, give no curves.
    """
    table = {name: own for name, own in series.of_side(side).items() if np.isfinite(own).any()}
    absent = [name for name in series.of_side(side) if name not in table]
    if not table:
        return {}, "no angle is observed" if absent else f"no angles of the {side} side"
    values = np.column_stack(list(table.values()))
    seen = np.all(np.isfinite(values), axis=1)
    time, values = series.time_s[seen], values[seen]
    first = np.searchsorted(time, start_s, side="right") - 1
    last = np.searchsorted(time, end_s, side="left")
    if first < 0 or last >= len(time):
        return {}, "the cycle reaches beyond the fitted frames"
    if np.max(np.diff(time[first : last + 1])) > MAX_CURVE_GAP_S:
        return {}, f"frames are missing for more than {MAX_CURVE_GAP_S:g} s"
    part = slice(max(0, first - 2), last + 3)
    at = start_s + REPORT_PERCENT / 100.0 * (end_s - start_s)
    curves = PchipInterpolator(time[part], values[part], axis=0)(at)
    return dict(zip(table, curves.T, strict=True)), f"not observed: {', '.join(absent)}" if absent else ""


#: Fractions of a cycle in which a leg swings and in which it stands, and least difference of the knee's flexion (deg).
_SWINGS, _STANDS, _LESS_DEG = (0.62, 0.88), (0.12, 0.38), 8.0


def check_sides(cycles: Sequence[GaitCycle], name: str) -> None:
    """Check that each knee bends more in swing than in stance. Raises `PblError` GAIT_INPUT."""
    knees = np.array([c.curves["knee_flexion"] for c in cycles if "knee_flexion" in c.curves])
    phase = REPORT_PERCENT / 100.0
    mean = [knees[:, (phase >= a) & (phase <= b)].mean() if len(knees) else 0.0 for a, b in (_SWINGS, _STANDS)]
    if mean[0] < mean[1] - _LESS_DEG:
        raise PblError(
            "GAIT_INPUT",
            found=said(
                "knees bent by {swing:.0f} deg in what the events call swing, by {stance:.0f} deg in stance",
                swing=mean[0],
                stance=mean[1],
            ),
            expected="events and angles of the same leg under the same side",
            next_step="exchange left and right of the events, or of the angles, in the program that wrote them",
            key=name,
        )


def _curves_sd(series: AngleSeries, start: GaitEvent, end: GaitEvent) -> dict[str, np.ndarray]:
    """Standard deviations (deg) at `REPORT_PERCENT` of the angles that have one."""
    at = start.time_s + REPORT_PERCENT / 100.0 * (end.time_s - start.time_s)
    own = {name: (sd, np.isfinite(sd)) for name, sd in series.sd.get(start.side, {}).items()}
    return {name: np.interp(at, series.time_s[seen], sd[seen]) for name, (sd, seen) in own.items() if seen.any()}
