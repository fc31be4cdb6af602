"""Gait cycles between foot downs of one side, and the joint-angle curves over them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

from pbl_pipeline.qc import Check, failed

from ._angles import AngleSeries, angle_series
from .cycle_measures import far_leg, mostly
from .events import FOOT_DOWN, FOOT_UP, LEFT, RIGHT, GaitEvent, GaitEvents
from .ground import cycle_lengths, is_metric, where_feet_stand, why_no_lengths
from .measurement import model_of_fit
from .motion import BodyPoses, FootTrajectories, feet_from_fit, trial_poses
from .normative import BODY_ANGLES
from .outliers import without_missed_steps, without_odd_curves
from .types import NO_POSITIONS, Exclusion, GaitCycle, Lengths

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

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
) -> tuple[GaitCycle, ...]:
    """All cycles whose four inner events are there in order, with curves and lengths where a fit is given.

    First and last step of each bout are left out of the measures (Cotton et al.: "first and last step of a trial are
    discarded"). A step is the time from one foot down to the next foot down of the other foot. So of a bout with
    n foot downs, which has n - 1 steps and n - 2 cycles, the cycle that starts with the first foot down and the cycle
    that ends with the last one are not used: n - 4 cycles remain, made of exactly the n - 3 inner steps. Eight steps
    (nine foot downs) in view leave 5 cycles. Cycles that are not used stay in the result with `used` False, so that
    both counts can be shown.

    `keep_ends` uses them all the same: for a recording that begins and ends while the person walks, such as a
    laboratory's, where the first step in view is not the first step of the walk.

    A cycle longer than 1.35 times the median stride of its bout, or shorter than its inverse, is not used either
    unless the feet pass each other in it as in one stride: a pair of steps that was not detected would pass as a slow
    stride, and a slow stride belongs to the spread. Nor is one whose curves are far from the others' (`outliers.py`).

    `series` and `feet` stand for the fit's angles and feet where there is none (a laboratory's recording; positions in
    metres in a world that stands still).

    Where one of `fit_checks`, the checks of the session fit, FAILs, no cycle is used (`pbl_pipeline.qc.failed`).
    """
    found = events.events if isinstance(events, GaitEvents) else tuple(events)
    name = trial or (fit.name if fit is not None else "")
    no_lengths, metric, stated, far = "" if feet is not None else NO_POSITIONS, True, False, None
    errors = ""
    if fit is not None:
        poses = poses or trial_poses(fit)
        series, feet = angle_series(fit, poses), feet_from_fit(fit, poses)
        no_lengths, metric, far = why_no_lengths(fit), is_metric(fit), far_leg(fit, poses)
        stated = bool(np.isfinite(fit.height_m))
        errors = "" if metric else model_of_fit(fit.params_hash)
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
            lengths, slide = Lengths(missing=no_lengths), None
            if feet is not None and not no_lengths:
                times = (start.time_s, inner[1].time_s, end.time_s)
                lengths, slide = cycle_lengths(feet, start.side, *times, metric=metric or stated, width=metric)
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
                far_leg="" if fit is None or far is None else mostly(_during(far, fit.time_s, start, end)),
                error_model=errors if curves_sd else "",
            )
            cycles.append(cycle)
            slides.append(slide)
    cycles = without_odd_curves(without_missed_steps(where_feet_stand(cycles, slides), feet))
    if checks := failed(fit_checks):
        cycles = [dataclasses.replace(c, exclusion=Exclusion(failed_checks=checks)) for c in cycles]
    cycles.sort(key=lambda c: c.start_s)
    return tuple(dataclasses.replace(c, number=number) for number, c in enumerate(cycles))


def cycle_curves(
    series: AngleSeries, side: str, start_s: float, end_s: float, percent: np.ndarray = REPORT_PERCENT
) -> tuple[dict[str, np.ndarray], str]:
    """Curves of one side at `percent` of the time from `start_s` to `end_s`, in degrees, and why they are missing.

    Interpolation is monotone cubic (PCHIP) between the frames' own time stamps. Frames missing for longer than
    `MAX_CURVE_GAP_S` inside the cycle, or at its ends, give no curves.
    """
    table = series.of_side(side)
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
    at = start_s + percent / 100.0 * (end_s - start_s)
    curves = PchipInterpolator(time[part], values[part], axis=0)(at)
    return dict(zip(table, curves.T, strict=True)), ""


def _during(values: np.ndarray, time_s: np.ndarray, start: GaitEvent, end: GaitEvent) -> np.ndarray:
    return values[(time_s >= start.time_s) & (time_s <= end.time_s)]


def _curves_sd(series: AngleSeries, start: GaitEvent, end: GaitEvent) -> dict[str, np.ndarray]:
    """Standard deviations (deg) at `REPORT_PERCENT` of the angles that have one."""
    at = start.time_s + REPORT_PERCENT / 100.0 * (end.time_s - start.time_s)
    own = {name: (sd, np.isfinite(sd)) for name, sd in series.sd.get(start.side, {}).items()}
    return {name: np.interp(at, series.time_s[seen], sd[seen]) for name, (sd, seen) in own.items() if seen.any()}
