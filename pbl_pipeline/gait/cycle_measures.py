"""Cadence, stride and step time, stance, swing, support, lengths and speed from cycles; their spread and asymmetry."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pbl_pipeline import words
from pbl_pipeline.results.cycles import GaitCycle
from pbl_pipeline.results.events import LEFT, RIGHT
from pbl_pipeline.results.measures import Measure, Spatiotemporal

from .ground import is_metric
from .motion import BodyPoses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

FRONT, BACK = "front", "back"
#: Fraction of the frames, or of the cycles, that must be seen from one side.
SHARE = 0.7


def camera_side(pelvis_m: np.ndarray, forward: np.ndarray, camera_m: np.ndarray) -> np.ndarray:
    """(T,) "front", "back", "left" or "right": the direction from the person to the camera, in the horizontal plane,
    within 45 deg of the heading, of its opposite, or to that side; empty where either is not known.

    `pelvis_m` and `forward` are (T, 3) in a z-up world, metres and any length; `camera_m` (3,) or (T, 3) in it.
    """
    sight = np.asarray(camera_m, float) - pelvis_m
    known = np.all(np.isfinite(sight), axis=1) & np.all(np.isfinite(forward), axis=1)
    ahead, to_camera = forward[known, :2], sight[known, :2]
    cross = ahead[:, 0] * to_camera[:, 1] - ahead[:, 1] * to_camera[:, 0]
    angle = np.degrees(np.arctan2(cross, np.sum(ahead * to_camera, axis=1)))  # positive: camera to the left
    out = np.full(len(sight), "", dtype="<U5")
    out[known] = np.select([np.abs(angle) <= 45, np.abs(angle) >= 135, angle > 0], [FRONT, BACK, LEFT], RIGHT)
    return out


def far_leg(fit: TrialFit, poses: BodyPoses) -> np.ndarray:
    """(T,) "left" or "right", the leg behind the other as seen by one camera; empty where neither is, in unknown
    frames, and for several cameras or a laboratory's markers."""
    pelvis = poses.index("pelvis")
    at = camera_side(poses.position_m[:, pelvis], poses.rotation[:, pelvis, :, 0], fit.camera_position_m)
    if is_metric(fit):
        return np.full(len(at), "", dtype=at.dtype)
    return np.select([at == LEFT, at == RIGHT], [RIGHT, LEFT], "")


def mostly(names: np.ndarray) -> str:
    """The name that at least `SHARE` of them have; empty if there is none."""
    found, counts = np.unique(names, return_counts=True)
    return str(found[np.argmax(counts)]) if len(found) and counts.max() >= SHARE * len(names) else ""


#: Usual standard deviation between the cycles of a side, in the unit of the measure: what nine of ten recorded people
#: do not exceed (`python -m research.corpus.spread`; single support as swing, which it is of the other foot). They are
#: healthy: of times and percentages twice that.
CYCLE_SPREAD = {
    "cadence_steps_per_min": 3.8,
    "stride_time_s": 0.029,
    "step_time_s": 0.034,
    "stance_time_s": 0.019,
    "swing_time_s": 0.021,
    "stance_percent": 1.2,
    "swing_percent": 1.2,
    "single_support_percent": 1.2,
    "double_support_percent": 1.5,
    "double_support_time_s": 0.018,
    "speed_m_per_s": 0.055,
    "stride_length_m": 0.034,
    "step_length_m": 0.047,
}
#: As many degrees of freedom the usual spread counts for where a person's own is larger: of smaller numbers, three
#: cycles of a person with twice the usual spread would have a larger error than two, whose spread is not known.
USUAL_FREEDOM = 6
#: Measures in the order of metrics.json; the unit is in the name.
MEASURES = tuple(words.MEASURES)
#: Measures that need the positions of the feet on the floor.
LENGTHS = ("speed_m_per_s", "stride_length_m", "step_length_m", "step_width_m")
#: Measures of one leg, which have an asymmetry.
SIDED = (
    "step_time_s",
    "stance_time_s",
    "swing_time_s",
    "stance_percent",
    "swing_percent",
    "single_support_percent",
    "step_length_m",
)
#: Cadences (steps/min) that are usual for walking.
CADENCE_PER_MIN = (60.0, 150.0)
#: Key in `Spatiotemporal.reasons` of the reason why the measures have no spread.
SPREAD = "spread"
NO_WIDTH = "one camera does not tell it: on synthetic walkers it comes out up to 4 cm too wide"


def sampling_sd(usual: float, n: int, own: float | None = None, freedom: int = 0) -> float:
    """Return the standard deviation of a mean over n cycles by their spread: the `usual` one, or more if that of the
    person (`own`, with `freedom` degrees of freedom) is larger.

    The excess counts by its degrees of freedom (as in a posterior mean with a scaled inverse chi-square prior; Gelman
    et al. 2013, Bayesian Data Analysis, section 2.6). A smaller spread does not count, because by chance a few cycles
    of anyone are alike: so fewer cycles never have a smaller error, up to a spread that is larger than usual.
    """
    excess = 0.0 if own is None else max(own**2 - usual**2, 0.0) * freedom / (USUAL_FREEDOM + freedom)
    return math.sqrt((usual**2 + excess) / n)


def spatiotemporal(cycles: Sequence[GaitCycle]) -> Spatiotemporal:
    """Measures over the used cycles of one or several trials (formulas and sources in docs/measures.md).

    For a cycle with initial contact D, opposite toe-off U', opposite initial contact D', toe-off U, next initial
    contact E: stride time E - D; stance U - D and swing E - U, also in percent of the stride; single support 100 (D' -
    U') / (E - D); double support time (U' - D) + (U - D'), also in percent; cadence 120 / (E - D). Step time is between
    successive initial contacts and belongs to the side that lands: D' - D is a step of the other side, E - D' one of
    this side; a step that is part of two cycles counts once. Lengths are those of `cycle_lengths`, speed is stride
    length by stride time.

    With a cycle of odd length that may be a true stride (`Exclusion.length_unproven`) no measure has sd, variability or
    CV, as without it the spread would be too small.

    Status EMPTY with a reason if no cycle is used.
    """
    used = [c for c in cycles if c.used]
    reasons: dict[str, str] = {}
    measures: dict[str, Measure | None] = dict.fromkeys(MEASURES)
    if not used:
        reason = _none_used(cycles)
        return Spatiotemporal("EMPTY", reason, measures, dict.fromkeys(MEASURES, reason), len(cycles), 0, 0)
    by_cycle: dict[str, list[tuple[str, float]]] = {name: [] for name in MEASURES}
    steps: dict[tuple[str, str, float], float] = {}
    for c in used:
        for name, value in cycle_measures(c).items():
            by_cycle[name].append(("" if name == "cadence_steps_per_min" else c.side, value))
        other = RIGHT if c.side == LEFT else LEFT
        steps[c.trial, other, c.opposite_foot_down_s] = c.opposite_foot_down_s - c.start_s
        steps[c.trial, c.side, c.end_s] = c.end_s - c.opposite_foot_down_s
    by_cycle["step_time_s"] = [(side, value) for (_, side, _), value in steps.items()]
    alike = not far_leg_of(used)
    measures.update({n: measure_of(values, alike and n in SIDED) for n, values in by_cycle.items() if values})
    for name in LENGTHS:
        if measures[name] is None:
            reasons[name] = _no_length(name, used)
    if unproven := sum(c.exclusion.length_unproven for c in cycles):
        reasons[SPREAD] = (
            f"{unproven} cycles of odd length were left out, and no feet show whether they are slow strides or hold a "
            "missed step"
        )
        none = {"sd": None, "variability": None, "cv_percent": None}
        measures = {name: m and dataclasses.replace(m, **none) for name, m in measures.items()}
    return Spatiotemporal("PASS", "", measures, reasons, len(cycles), len(used), len(steps))


def far_leg_of(cycles: Sequence[GaitCycle]) -> str:
    """The leg that was behind the other in most of the used cycles; empty if both were seen alike."""
    return mostly(np.array([c.far_leg for c in cycles if c.used]))


def unusual_bound(cadence_per_min: float) -> float | None:
    """Return the bound of `CADENCE_PER_MIN` that a cadence is beyond; None if it is usual for walking."""
    low, high = CADENCE_PER_MIN
    return low if cadence_per_min < low else high if cadence_per_min > high else None


def cycle_measures(c: GaitCycle) -> dict[str, float]:
    """The measures of one cycle by name (`MEASURES`) except its step times, which belong to two cycles; unknown ones
    are left out."""
    stride, stance = c.stride_time_s, c.foot_up_s - c.start_s
    both = (c.opposite_foot_up_s - c.start_s) + (c.foot_up_s - c.opposite_foot_down_s)
    alone = c.opposite_foot_down_s - c.opposite_foot_up_s
    values = {
        "cadence_steps_per_min": 120.0 / stride,
        "stride_time_s": stride,
        "stance_time_s": stance,
        "swing_time_s": stride - stance,
        "stance_percent": 100.0 * stance / stride,
        "swing_percent": 100.0 - 100.0 * stance / stride,
        "single_support_percent": 100.0 * alone / stride,
        "double_support_percent": 100.0 * both / stride,
        "double_support_time_s": both,
    }
    if c.lengths.stride_length_m is not None:
        values["speed_m_per_s"] = c.lengths.stride_length_m / stride
    for name in LENGTHS[1:]:
        if (length := getattr(c.lengths, name)) is not None:
            values[name] = length
    return values


def _none_used(cycles: Sequence[GaitCycle]) -> str:
    if not cycles:
        return "no complete gait cycle"
    if failed := next((c.excluded for c in cycles if c.check_failed), ""):
        return failed
    found = "only one gait cycle" if len(cycles) == 1 else f"{len(cycles)} gait cycles"
    odd = ", and so are strides of odd length" if any(c.odd_length for c in cycles) else ""
    return f"{found}, and the first and last steps of a walk are excluded{odd}"


def _no_length(name: str, used: Sequence[GaitCycle]) -> str:
    missing = "; ".join(sorted({c.lengths.missing for c in used if c.lengths.missing}))
    if not missing and name == "step_width_m" and any(c.lengths.stride_length_m is not None for c in used):
        return NO_WIDTH
    return missing or "not known"


def measure_of(values: Sequence[tuple[str, float]], compared: bool = False) -> Measure:
    """Return the measure of values with their sides ("" for a measure without); `compared`: with its asymmetry."""
    numbers = np.array([v for _, v in values])
    by_side = {side: [v for s, v in values if s == side] for side in (LEFT, RIGHT)}
    left, right = (float(np.mean(by_side[s])) if by_side[s] else None for s in (LEFT, RIGHT))
    mean = float(numbers.mean())
    sd = float(np.std(numbers, ddof=1)) if len(numbers) > 1 else None
    # A measure without sides (cadence, tasks) has one group.
    groups = list(by_side.values()) if left is not None or right is not None else [list(numbers)]
    enough = all(len(g) > 1 for g in groups)
    within = float(np.sqrt(np.mean([np.var(g, ddof=1) for g in groups]))) if enough else None
    fraction = None if within is None or mean == 0 else 100.0 * within / abs(mean)
    asymmetry = None
    if compared and left is not None and right is not None and left + right != 0:
        asymmetry = 100.0 * (right - left) / (0.5 * (right + left))
    return Measure(left, right, mean, sd, len(numbers), within, fraction, asymmetry)
