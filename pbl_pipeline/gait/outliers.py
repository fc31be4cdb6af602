"""Cycles that are not one stride, or whose curves are far from the others'."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._exclusion import CADENCE, Exclusion
from .cycle_measures import unusual_bound
from .motion import FootTrajectories
from .types import GaitCycle

#: A stride longer than this times the typical one may hold a step that was missed, one shorter than its inverse an
#: event that is none: the feet decide. Strides of one walk vary by a few percent, in ataxia ten.
STRIDE_RATIO = 1.35
#: The feet pass each other this often in a stride; in one that hides a missed pair of steps twice as often.
_PASSES = 2
#: A pass counts where the feet come this far beyond the middle of their range, in fractions of the range.
_BEYOND = 0.2
#: Fraction of a cycle's frames in which both feet must be seen to count passes.
_SEEN = 0.8
#: Fewest cycles of a bout for a typical stride of its own; shorter bouts are compared with the whole trial.
_OWN_MEDIAN = 5

#: Angles whose curves are compared: those that move most and that every source of curves knows.
CURVE_ANGLES = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion")
#: Fewest cycles of a side with curves that say what is usual.
MIN_CURVES = 5
#: A cycle is unlike the others where its curves are further from the median curves than this many robust standard
#: deviations above the usual distance, and at least this far. Both, so that neither a very regular walk nor a very
#: irregular one loses cycles that are only its own variability: a leg exchanged or a person mistaken is 20 deg off.
CURVE_SD, CURVE_MIN_DEG = 6.0, 8.0


def without_missed_steps(cycles: Sequence[GaitCycle], feet: FootTrajectories | None = None) -> list[GaitCycle]:
    """Return the cycles, those of an odd length that are not one stride marked as not used.

    A cycle beyond `STRIDE_RATIO` times the typical stride (the median of its bout, or of the trial where the bout is
    short) is a stride all the same if the feet pass each other as often as in one (`foot_passes`): it is used, and
    its length counts in every spread. Where the feet are not known the cycle is left out as `length_unproven`, and
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
    """Return how often the feet pass each other from `start_s` to `end_s`; None where they are hardly seen.

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
        chosen = [
            i for i, c in enumerate(out) if c.side == side and c.used and all(n in c.curves for n in CURVE_ANGLES)
        ]
        if len(chosen) < MIN_CURVES:
            continue
        curves = np.array([[out[i].curves[n] for n in CURVE_ANGLES] for i in chosen])
        away = np.sqrt(np.mean((curves - np.median(curves, axis=0)) ** 2, axis=(1, 2)))
        usual = np.median(away)
        limit = max(CURVE_MIN_DEG, float(usual + CURVE_SD * 1.4826 * np.median(np.abs(away - usual))))
        for i, distance in zip(chosen, away, strict=True):
            if distance > limit:
                out[i] = not_used(out[i], curve_distance_deg=float(distance), n_curves=len(chosen))
    return out


def without_unusual_cadence(cycles: Sequence[GaitCycle]) -> list[GaitCycle]:
    """Return the cycles of a recording, none used where their mean cadence is unusual for walking: steps counted twice
    or missed, or left and right that the detector exchanged at each step, make every measure another one."""
    own = [120.0 / c.stride_time_s for c in cycles if c.used]
    if not own or unusual_bound(float(np.mean(own))) is None:
        return list(cycles)
    return [not_used(c, failed_checks=(CADENCE,)) for c in cycles]


def refused_cadence(cycles: Sequence[GaitCycle]) -> float | None:
    """Return the mean cadence (steps/min, to 0.01) of the cycles that `without_unusual_cadence` left out; None where it
    left out none."""
    own = [120.0 / c.stride_time_s for c in cycles if c.exclusion == Exclusion(failed_checks=(CADENCE,))]
    return round(float(np.mean(own)), 2) if own else None


def with_cadence_accepted(cycles: Sequence[GaitCycle]) -> tuple[GaitCycle, ...]:
    """Return the cycles, those used again that only `without_unusual_cadence` left out: a person counted the steps."""
    return tuple(not_used(c, failed_checks=()) if CADENCE in c.exclusion.failed_checks else c for c in cycles)


def not_used(cycle: GaitCycle, **reasons: Any) -> GaitCycle:
    """The cycle, not used, with further reasons (fields of `Exclusion`)."""
    return dataclasses.replace(cycle, exclusion=dataclasses.replace(cycle.exclusion, **reasons))
