"""The kinetics of a visit: from its fits, events and cycles to forces, moments and their measures with intervals."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import SLIDES as PLACE
from pbl_pipeline.body import Body, load_body, stature_m
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitCycle, GaitEvent, far_leg_of, legs_check
from pbl_pipeline.gait.cycle_measures import measure_of, sampling_sd
from pbl_pipeline.gait.ground import FOLLOWS, SLIDES, is_metric, why_no_lengths
from pbl_pipeline.methods import Method
from pbl_pipeline.qc import EMPTY, PASS, Check, in_order, warn_if
from pbl_pipeline.results.forces import CycleKinetics, KineticMeasure, Kinetics, Series, TrialKinetics
from pbl_pipeline.results.measures import Z90
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.shipped import shipped_text
from pbl_pipeline.texts import code_of

from .dynamics import GRAVITY, Dynamics, Motion, inverse_dynamics, smooth_motion
from .ground import GroundReaction, contact_of, ground_reaction, needed_vertical
from .joints import knee_adduction, leg_moments
from .measures import cycle_table, split_table
from .types import MEASURES, KineticsParams, Walk
from .vertical import VerticalModel, dimensionless_speed, load_vertical_model, vertical_force

_ERRORS = list(csv.DictReader(shipped_text("kinetics/measure_errors.csv").splitlines()))


def _column(name: str) -> dict[str, float]:
    return {row["measure"]: float(row[name]) for row in _ERRORS}


#: Error of the method in a measure of one leg (root mean square), from force plates: the tuning children of
#: `python -m research.benchmarks.kinetics`, each with courses that were fitted to the other children. Their motion is
#: known from markers, so it includes errors of such a fit that are constant over all frames.
METHOD_SD = _column("method")
#: By marker set, error of the fit of one camera in a measure that is equal on both sides, beyond the varying error that
#: is drawn (root mean square over recorded walks of the tuning persons, each from three sides:
#: `python -m research.benchmarks.kinetics_phone`). Of another marker set the larger one of 33 points. Of 87 points the
#: peak of loading is of `--walks recorded` and `--walks synthetic` together, and that of push-off of `--walks
#: synthetic`: 0.030 on recorded walks left out sharper push-offs than theirs. The excursion of the centre of mass is of
#: all three kinds of walks together, with `--tilt 1`.
ONE_CAMERA_SD = {marker_set: _column(marker_set) for marker_set in ("blazepose_33", "bml_movi_87")}
#: Standard deviation of a measure between healthy people: the plates' forces of the 11 children of
#: `python -m research.benchmarks.kinetics`, means over two steps.
HEALTHY_SD = _column("healthy")
#: Usual standard deviation between the cycles of a side: that of the median person of `python -m
#: research.corpus.spread`, because the noise of the joint values of those recordings adds to it.
CYCLE_SD = _column("cycle")
#: Half of the range of healthy people in which 95 % of them lie, in their standard deviations.
HEALTHY_RANGE = 1.96
#: Reason for a missing measure whose 90 % interval is wider than that range and cannot show that a person is a patient.
TOO_UNCERTAIN = "its 90 % interval is wider than the range of healthy people"
#: Reasons for missing forces, by code.
REASONS = {
    "NO_CYCLES": "no gait cycle is used",
    "MOVING_CAMERA": FOLLOWS,
    "TREADMILL": SLIDES,
    "VERTICAL_UNKNOWN": "the tilt of the camera is not known: a level one may be off by more than 5 deg",
    "NOT_OBSERVED": "a joint of the legs is not observed",
    "TOO_SHORT": "no stretch of a second without gaps",
    "AID": "a walking aid may carry a part of the weight",
    "UNCERTAIN": "the 90 % interval of every measure is wider than the range of healthy people",
}
#: Root mean square of the residual force beyond which a check warns (body weights).
MAX_RESIDUAL_BW = 0.15
#: An asymmetry that is less certain than this is left out (percent).
MAX_ASYMMETRY_SD = 30.0
#: Words of an aid that carries no weight.
_NO_AID = ("", "none", "unknown")
_SIDED = tuple(n for n in MEASURES if n != "centre_of_mass_excursion_m")


def visit_kinetics(
    fits: Sequence[TrialFit],
    gait: Sequence[Walk],
    method: Method[KineticsParams],
    *,
    mass_kg: float | None = None,
    aid: str = "",
) -> Kinetics:
    """Return the kinetics of a visit's trials; `gait`: the measures of each of `fits`.

    `mass_kg`: the person's mass, stored with the result. `aid`: the stated walking aid; with one that may carry weight
    forces are not computed.
    """
    trials = tuple(trial_kinetics(f, g, method.params, aid=aid) for f, g in zip(fits, gait, strict=True))
    pairs = [(t, g) for t, g in zip(trials, gait, strict=True) if g.pooled and t.series is not None]
    pooled, cycles = [t for t, _ in pairs], [c for _, g in pairs for c in g.cycles]
    cameras = [ONE_CAMERA_SD.get(f.marker_set, ONE_CAMERA_SD["blazepose_33"]) for f in fits if not is_metric(f)]
    of_camera = {name: max((c[name] for c in cameras), default=0.0) for name in MEASURES}
    measures, reasons = _pool(pooled, of_camera, not far_leg_of(cycles))
    first = next((t for t in trials if t.code), None)
    code = "" if measures else (first.code if first else "UNCERTAIN" if pooled else "NO_CYCLES")
    reason = REASONS.get(code, "")
    if not measures:
        reasons = dict.fromkeys(MEASURES, reason)
    return Kinetics(
        status=PASS if measures else EMPTY,
        code=code,
        reason=reason,
        measures=measures,
        reasons=reasons,
        mass_kg=mass_kg,
        residual_bw=_residual(pooled),
        method=method.key,
        params_hash=method.hash,
        trials=tuple(dataclasses.replace(t, samples=None) for t in trials),
        qc=_checks(pooled, measures, fits, cycles),
    )


def trial_kinetics(fit: TrialFit, gait: Walk, params: KineticsParams, *, aid: str = "") -> TrialKinetics:
    """Return the kinetics of one trial; EMPTY with a code of `REASONS` where there can be none."""
    used = [c for c in gait.cycles if c.used]
    code = _code_against(fit, gait, aid)
    if code:
        return TrialKinetics(fit.name, EMPTY, code, REASONS[code])
    body = load_body()
    qpos = np.asarray(fit.qpos, float)
    series = trial_series(body, fit, qpos, gait.events.events, params)
    if series is None:
        return TrialKinetics(fit.name, EMPTY, "TOO_SHORT", REASONS["TOO_SHORT"])
    table = cycle_table(series, gait.cycles)
    rng = np.random.default_rng(40)
    drawn = [
        cycle_table(s, gait.cycles)
        for noise in _noise(fit, params)
        if (s := trial_series(body, fit, qpos + noise, gait.events.events, params, rng)) is not None
    ]
    samples = np.array(drawn) if drawn else None
    sd = np.full_like(table, np.nan) if samples is None else samples.std(axis=0, ddof=1)
    cycles = []
    for c, row, row_sd in zip(gait.cycles, table, sd, strict=True):
        curves, measures = split_table(row)
        missing = "" if measures else "contact or motion is not known over the whole stance"
        cycles.append(CycleKinetics(c.number, c.side, c.used, curves, split_table(row_sd)[0], measures, missing))
    if not used or not any(c.measures for c in cycles if c.used):
        return TrialKinetics(fit.name, EMPTY, "NO_CYCLES", REASONS["NO_CYCLES"], tuple(cycles), series)
    n = len(MEASURES)
    return TrialKinetics(fit.name, PASS, "", "", tuple(cycles), series, None if samples is None else samples[:, :, -n:])


def _code_against(fit: TrialFit, gait: Walk, aid: str) -> str:
    if code_of("aid", aid).strip().lower() not in _NO_AID:
        return "AID"
    if why_no_lengths(fit):
        return "MOVING_CAMERA"
    if any(c.lengths.missing == SLIDES for c in gait.cycles):
        return "TREADMILL"
    if fit.orientation_source == "assumed: level":
        return "VERTICAL_UNKNOWN"
    if any(n.startswith(("hip_flexion", "knee", "ankle")) for n in fit.not_observed):
        return "NOT_OBSERVED"
    return "" if any(c.used for c in gait.cycles) else "NO_CYCLES"


def trial_series(
    body: Body,
    fit: TrialFit,
    qpos: np.ndarray,
    events: Sequence[GaitEvent],
    params: KineticsParams,
    rng: np.random.Generator | None = None,
) -> Series | None:
    """Return forces and moments over time of a trial's motion `qpos` (T, Q); None if no stretch is long enough. With
    `rng` the vertical force is drawn from its posterior, else it is the mean."""
    parts = []
    for motion in smooth_motion(fit.time_s, qpos, params.cutoff_hz):
        d = inverse_dynamics(body, fit.scale, motion)
        contact = contact_of(motion.time_s, events)
        vertical = _vertical(body, fit, d, contact, load_vertical_model(params.vertical_model), rng)
        parts.append(series_of(body, motion, d, ground_reaction(body, fit.scale, d, contact, vertical)))
    if not parts:
        return None
    names = [f.name for f in dataclasses.fields(Series)]
    return Series(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _vertical(
    body: Body, fit: TrialFit, d: Dynamics, contact: np.ndarray, model: VerticalModel, rng: np.random.Generator | None
) -> np.ndarray:
    """Return the vertical force (N/kg) of both feet: of one camera whose set of points `model` knows weighed against
    it, else as the motion needs it. A fit that states no error cannot be weighed."""
    stands = (contact == 1) & np.all(np.isfinite(contact), axis=1, keepdims=True)
    needed = needed_vertical(d, stands)
    noise = model.noise.get(fit.marker_set)
    if noise is None or is_metric(fit) or not np.isfinite(fit.qpos_sd).any():
        return needed
    speed = dimensionless_speed(d.centre_m, stature_m(body, fit.scale))
    force = vertical_force(needed / GRAVITY, stands, speed, model, noise)
    return GRAVITY * (force.mean if rng is None else force.draw(rng))


def series_of(body: Body, motion: Motion, d: Dynamics, ground: GroundReaction) -> Series:
    """Return forces and moments over time of a motion on this ground reaction."""
    moment, power = leg_moments(body, d, ground, motion)
    ahead = d.xmat[:, body.body_names.index("pelvis"), :2, 0]
    return Series(
        time_s=motion.time_s,
        force_bw=ground.force_n / GRAVITY,
        centre_m=ground.centre_m,
        moment_nm_per_kg=moment,
        power_w_per_kg=power,
        residual_bw=ground.residual_n / GRAVITY,
        residual_nm_per_kg=ground.residual_nm,
        centre_of_mass_m=d.centre_m,
        ahead=ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9),
        knee_adduction_nm_per_kg=knee_adduction(body, d, ground),
    )


def _noise(fit: TrialFit, params: KineticsParams) -> list[np.ndarray]:
    """Return `samples` errors of the joint values, as large as the fit states; none where it states none.

    Only the part is drawn that varies over a walk: a Gaussian process with a memory, for turns and for slides a small
    fraction of the stated variance. The rest stays the same in all frames, where no draw of one joint value at a time
    is like it (the points of a body that a camera sees hold the errors of its joints together); what it does to a
    measure is in `METHOD_SD` and `ONE_CAMERA_SD`.
    """
    sd = np.asarray(fit.qpos_sd, float)
    if not np.isfinite(sd).any():
        return []
    slides = np.isin(fit.joint_names, PLACE)
    sd = np.nan_to_num(sd) * np.sqrt(np.where(slides, params.varying_slides, params.varying_turns))
    rng = np.random.default_rng(39)
    width = params.memory_s / max(interval_of(fit.time_s), 1e-3)
    gain = np.sqrt(2.0 * np.sqrt(np.pi) * width)
    drawn = (rng.standard_normal(sd.shape) for _ in range(params.samples))
    return [gain * sd * gaussian_filter1d(white, width, axis=0, mode="wrap") for white in drawn]


def _pool(
    trials: Sequence[TrialKinetics], of_camera: Mapping[str, float], alike: bool
) -> tuple[dict[str, KineticMeasure], dict[str, str]]:
    """Return the measures over all used cycles, and why others are absent; asymmetries if both legs were seen
    `alike`."""
    measures: dict[str, KineticMeasure] = {}
    reasons: dict[str, str] = {}
    for j, name in enumerate(MEASURES):
        values: list[tuple[str, float]] = []
        drawn: dict[str, list[np.ndarray]] = {"left": [], "right": []}
        for trial in trials:
            for i, cycle in enumerate(trial.cycles):
                if cycle.used and name in cycle.measures:
                    values.append((cycle.side, cycle.measures[name]))
                    if trial.samples is not None:
                        drawn[cycle.side].append(trial.samples[:, i, j])
        if not values:
            reasons[name] = "no used cycle whose stance is known as a whole"
            continue
        found = _measure(name, values, drawn, of_camera[name], alike and name in _SIDED)
        n_sides = len({side for side, _ in values})
        sd = np.hypot(METHOD_SD[name] / np.sqrt(n_sides), of_camera[name]) if found.sd is None else found.sd
        if too_uncertain(name, float(sd)):
            reasons[name] = TOO_UNCERTAIN
        else:
            measures[name] = found
    return measures, reasons


def too_uncertain(name: str, sd: float) -> bool:
    """Return whether the 90 % interval of a measure is wider than the range of healthy people."""
    return Z90 * sd > HEALTHY_RANGE * HEALTHY_SD[name]


def _measure(
    name: str,
    values: Sequence[tuple[str, float]],
    drawn: Mapping[str, list[np.ndarray]],
    of_camera: float,
    compared: bool,
) -> KineticMeasure:
    """Return means and standard deviations of values with their sides; `compared`: with the asymmetry. The method errs
    on each side by itself, and a mean also errs by the spread of its cycles. One camera counts as erring alike on both
    sides in their mean, by itself on each in their difference: its errors of left and right correlate by -0.5 to 0.9
    (`python -m research.benchmarks.kinetics_phone`)."""
    own = measure_of(values)
    mean = {s: m for s, m in (("left", own.left), ("right", own.right)) if m is not None}
    n = {s: sum(side == s for side, _ in values) for s in ("left", "right")}
    known = sum(map(len, drawn.values())) == own.n
    varies = {s: np.nanmean(drawn[s], axis=0) for s in mean} if known else {}
    chance = {s: sampling_sd(CYCLE_SD[name], max(k, 1), own.variability, own.n - 2) for s, k in n.items()}

    def sd(weights: Mapping[str, float], least_chance: float = 0.0) -> float | None:
        if not known:
            return None
        each, squares = weights.items(), sum(w**2 for w in weights.values())
        fit = np.var(np.sum([w * varies[s] for s, w in each], axis=0), ddof=1)
        camera = of_camera**2 * max(sum(weights.values()) ** 2, squares)
        walk = max(sum((w * chance[s]) ** 2 for s, w in each), least_chance**2)
        return float(np.sqrt(fit + METHOD_SD[name] ** 2 * squares + camera + walk))

    middle = float(np.mean(list(mean.values())))
    asymmetry = asymmetry_sd = None
    if compared and len(mean) == 2 and abs(middle) > 1e-9:
        of_difference = sd({"right": 1.0, "left": -1.0})
        if of_difference is None or 100.0 * of_difference / abs(middle) <= MAX_ASYMMETRY_SD:
            asymmetry = 100.0 * (mean["right"] - mean["left"]) / abs(middle)
            asymmetry_sd = None if of_difference is None else 100.0 * of_difference / abs(middle)
    return KineticMeasure(
        left=own.left,
        right=own.right,
        mean=middle,
        sd_left=sd({"left": 1.0}) if "left" in mean else None,
        sd_right=sd({"right": 1.0}) if "right" in mean else None,
        # A side that is missing counts like one of one cycle.
        sd=sd(dict.fromkeys(mean, 1.0 / len(mean)), 0.5 * math.hypot(*chance.values())),
        n=own.n,
        asymmetry_percent=asymmetry,
        asymmetry_sd=asymmetry_sd,
    )


def _residual(trials: Sequence[TrialKinetics]) -> float | None:
    """Return the root mean square of the force that no foot carries, in body weights."""
    squares = [np.sum(t.series.residual_bw**2, axis=1) for t in trials if t.series is not None]
    known = np.concatenate(squares) if squares else np.empty(0)
    known = known[np.isfinite(known)]
    return float(np.sqrt(known.mean())) if len(known) else None


def _checks(
    trials: Sequence[TrialKinetics],
    measures: Mapping[str, KineticMeasure],
    fits: Sequence[TrialFit],
    cycles: Sequence[GaitCycle],
) -> tuple[Check, ...]:
    if not measures:
        return ()
    residual = _residual(trials) or 0.0
    unexplained = "much of the force that the motion needs is carried by no foot: look at the events and at the fit"
    sized = all(is_metric(f) or f.sized for f in fits)
    assumed = "accelerations are scaled by an assumed body size: state the measured height"
    return in_order(
        (
            warn_if(residual > MAX_RESIDUAL_BW, "kinetics_residual", round(residual, 4), MAX_RESIDUAL_BW, unexplained),
            warn_if(not sized, "kinetics_scale", None, None, assumed),
            legs_check(cycles),
        )
    )
