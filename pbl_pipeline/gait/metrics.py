"""All gait measures of a session: events, cycles, spatiotemporal measures, GDI, checks."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.qc import CADENCE, EMPTY, FAIL, OUTCOMES, PASS, Check, in_session, warn_if, worst
from pbl_pipeline.records import plain, record
from pbl_pipeline.results.cycles import Curves, GaitCycle
from pbl_pipeline.results.events import GaitEvents
from pbl_pipeline.results.index import SessionMetrics
from pbl_pipeline.results.measures import OF_VISIT, Z90, minimal_change_of

from ._cycles import check_sides, find_cycles, refused_cadence, with_cadence_accepted
from ._gdi import (
    GDI_METHODS,
    GDI_MODEL,
    GILLETTE_MODEL,
    PAPER_INDEX,
    Gdi,
    GdiParams,
    norm_of,
    params_of,
    score_gdi,
    worth_of_one_more,
)
from .cycle_measures import (
    CADENCE_PER_MIN,
    LENGTHS,
    MEASURES,
    Spatiotemporal,
    far_leg_of,
    spatiotemporal,
    unusual_bound,
)
from .events import METHODS, detect_events
from .laboratory import LabTrial
from .measurement import load_model, measure_error
from .motion import BodyPoses, feet_from_fit, trial_poses
from .normative import NormativeSet
from .tasks import TASK_MEASURES, task_measures, task_motion
from .types import Condition

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: Number of used cycles that measures need, and the one below which they are few.
LEAST_CYCLES, FEW_CYCLES = 1.0, 4.0


@dataclasses.dataclass(frozen=True)
class GaitParams:
    """Method of the events (a row of `events.METHODS`) and parameters of the index together."""

    events: Paramset = dataclasses.field(default_factory=lambda: METHODS.find().paramset)
    gdi: GdiParams = dataclasses.field(default_factory=lambda: GDI_METHODS.find().params)


@dataclasses.dataclass(frozen=True)
class TrialCycles:
    """Cycles of one trial, as a session pools them (`pool_trials`). `reason`: why none is used, empty if one is."""

    name: str
    reason: str
    cycles: tuple[GaitCycle, ...]


@dataclasses.dataclass(frozen=True)
class TrialMetrics(TrialCycles):
    """All results of one trial. `pooled` is false if the session's measures leave it out: no walking, or walking at
    another pace than the method's."""

    status: str
    events: GaitEvents
    spatiotemporal: Spatiotemporal
    gdi: Gdi
    qc: tuple[Check, ...]
    pooled: bool = True

    @classmethod
    def of(
        cls, name: str, events: GaitEvents, cycles: Sequence[GaitCycle], found: Spatiotemporal, gdi: Gdi, pooled: bool
    ) -> TrialMetrics:
        """Return these results of a trial with its status and its checks."""
        reason, checks = events.reason or found.reason, (*events.qc, *cycle_checks(found, cycles), *gdi.qc)
        return cls(name, reason, tuple(cycles), EMPTY if reason else PASS, events, found, gdi, checks, pooled)

    def to_dict(self) -> dict:
        """Return the trial's part of metrics.json, from which `metrics_file.metrics_of` makes it again."""
        events = {k: v for k, v in vars(self.events).items() if k != "events"}
        cycles = [{k: v for k, v in vars(c).items() if k not in ("trial", *Curves._fields)} for c in self.cycles]
        more = plain({"pooled": self.pooled, "events": events, "gait_cycles": cycles})
        return {"name": self.name, **_measures(self), **more}


@record
class GaitMetrics(SessionMetrics):
    """The measures of a session and its trials. `before`: checks of the earlier stages (`with_checks`)."""

    trials: tuple[TrialMetrics, ...]
    before: tuple[Check, ...] = ()

    def with_checks(self, checks: Sequence[Check]) -> GaitMetrics:
        """The same measures, judged together with the checks of keypoints and fit."""
        return dataclasses.replace(self, before=tuple(checks))

    @property
    def cycles(self) -> list[GaitCycle]:
        """The cycles of the pooled trials, including unused ones."""
        return [c for t in self.trials if t.pooled for c in t.cycles]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every check of the session in the order of the chain, each once: `before`, the trials' events, `qc`."""
        events = [c for t in self.trials for c in t.events.qc]
        return tuple(dict.fromkeys([*self.before, *events, *self.qc]))

    @property
    def outcome(self) -> str:
        """The worst of `checks`, as report and tables judge it."""
        return max(map(self.in_session, self.checks), key=OUTCOMES.index, default=PASS)

    def in_session(self, check: Check) -> str:
        """Return the outcome of one of `checks` as it counts for the session (`qc.in_session`)."""
        counted = {t.name for t in self.trials if any(c.used for c in t.cycles)}
        own = {t.name for t in self.trials if check in t.events.qc or check.check.endswith(f" ({t.name})")}
        # Without a counted trial, such as in a folder without cycles, it is not known which recording counts.
        return in_session(check.outcome, self.status == PASS, not (own and counted) or bool(own & counted))

    def to_dict(self) -> dict:
        """The content of metrics.json."""
        judged = {
            "outcome": self.outcome,
            "qc": plain(self.checks),
            "qc_before_gait": len(dict.fromkeys(self.before)),
        }
        session = _measures(self)
        del session["gdi"]["cycles"]  # those of its trials
        return {
            "session": {**session, **judged},
            "trials": [t.to_dict() for t in self.trials],
            "gdi_model": self.gdi.model,
            "params_hash": self.params_hash,
        }

    def table(self) -> str:
        """The session's measures as text for a terminal."""
        lines = [f"{self.status}: {self.reason}"] if self.reason else []
        lines.append(f"{'measure':<24}{'left':>9}{'right':>9}{'mean':>9}{'sd':>8}{'n':>5}{'+- 90 %':>9}")
        for name in MEASURES:
            m = self.spatiotemporal[name]
            if m is None:
                lines.append(f"{name:<24}{'-':>9}{'-':>9}{'-':>9}{'-':>8}{'-':>5}  {self.spatiotemporal.reasons[name]}")
            else:
                error = "" if m.error_sd is None else _cell(Z90 * m.error_sd)
                row = f"{name:<24}{_cell(m.left)}{_cell(m.right)}{_cell(m.mean)}{_cell(m.sd, 8)}{m.n:>5}{error}"
                lines.append(row)
        for trial in self.trials:
            for name, m in trial.spatiotemporal.of_task.items():
                reason = trial.spatiotemporal.reasons.get(name, "")
                cells = f"{'-':>9}{'-':>8}{'-':>5}" if m is None else f"{_cell(m.mean)}{_cell(m.sd, 8)}{m.n:>5}"
                lines.append(f"{name:<24}{'':>18}{cells}  {reason or trial.name}")
        g = self.gdi
        lines.append(f"{_short(g):<24}{_cell(g.left)}{_cell(g.right)}{_cell(g.mean)}{'':>8}{g.n:>5}  {g.reason}")
        if g.interval is not None:
            lines.append(f"its {g.error_words(1)}")
            if more := worth_of_one_more(self.cycles, g):
                lines.append(more)
        if g.profile is not None and g.profile.gps is not None:
            p = g.profile
            lines.append(f"{'GPS (deg)':<24}{_cell(p.gps_left)}{_cell(p.gps_right)}{_cell(p.gps)}")
        lines.append(f"quality checks: {self.outcome}")
        lines += [f"{c.outcome} {c.check}: {c.advice}" for c in self.checks if c.advice]
        return "\n".join(line.rstrip() for line in lines)

    def save(self, path: str | Path) -> None:
        """Write `metrics.json`. Missing values are null with a reason in `reasons`."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def gait_metrics(
    trials: Sequence[TrialFit | LabTrial],
    norm: NormativeSet | str | None = None,
    params: GaitParams | None = None,
    fit_checks: Sequence[Check] = (),
    model: Method[GdiParams] | str | None = None,
    conditions: Sequence[Condition] | None = None,
    accept_cadence: bool = False,
) -> GaitMetrics:
    """Measures of the trials of one session and of the session: events, cycles and measures of each trial, then
    `pool_trials`.

    Trials are fits, or recordings of a laboratory, whose first and last steps in view count. `model` is that of
    `score_gdi`, `conditions` those of `pool_trials`. `accept_cadence`: a person counted the steps of trials whose
    cadence is too high for walking (`find_cycles`).

    A trial without walking has status EMPTY and takes no part in the session. If one of `fit_checks`, the checks of the
    session fit, FAILs, no cycle is used: measures and index are None with that reason. Raises `PblError` NORM_UNKNOWN,
    NORM_INVALID, GAIT_INPUT (no finite frame in a trial).
    """
    if not trials:
        raise PblError(
            "GAIT_INPUT", found="no trial", expected="at least one fitted trial", next_step="pass fit.npz files"
        )
    basis = norm_of(norm, params.gdi if params else GDI_METHODS.find(model).params)
    params = params or GaitParams(gdi=params_of(basis, model))
    index = {"norm": basis, "params": params.gdi, "model": model}
    given = [Condition()] * len(trials) if conditions is None else conditions
    done = tuple(
        _trial(t, params.events, index, fit_checks, c, accept_cadence) for t, c in zip(trials, given, strict=True)
    )
    return GaitMetrics(**vars(pool_trials(done, basis, params, model, conditions=given)), trials=done)


def pool_trials(
    trials: Sequence[TrialCycles],
    norm: NormativeSet,
    params: GaitParams,
    model: Method[GdiParams] | str | None = None,
    conditions: Sequence[Condition] | None = None,
) -> SessionMetrics:
    """Measures and index of a session over all used cycles of its pooled trials.

    Returns EMPTY, with a reason, if no pooled trial has a used cycle. Raises `PblError` as `score_gdi`.

    Parameters
    ----------
    trials
        Cycles of each trial; two trials may have one name.
    norm, params, model
        Norm and method of the index (`score_gdi`); `params.events` only enters `params_hash`.
    conditions
        Activity and pace of each trial (None: unknown): walking at the pace of `params.gdi` is pooled.
    """
    given = [Condition()] * len(trials) if conditions is None else conditions
    pooled = [t for t, c in zip(trials, given, strict=True) if c.pooled(params.gdi.pace)]
    cycles = [c for t in pooled for c in t.cycles]
    # Two trials may have one name, by which their cycles are distinguished.
    names = Counter(t.name for t in pooled)
    distinct = [
        dataclasses.replace(c, trial=t.name if names[t.name] == 1 else f"{t.name} ({i + 1})")
        for i, t in enumerate(pooled)
        for c in t.cycles
    ]
    measures = with_errors(spatiotemporal(distinct), cycles, params.events)
    gdi = score_gdi(distinct, norm, params.gdi, model)
    status = PASS if measures.status == PASS else EMPTY
    reason = "" if status == PASS else "; ".join(dict.fromkeys(f"{t.name}: {t.reason}" for t in pooled))
    if not pooled:
        there = "; ".join(dict.fromkeys(map(str, given)))
        reason = f"no trial of walking at the pace {params.gdi.pace!r} (there are: {there})"
        measures = dataclasses.replace(measures, reason=reason, reasons=dict.fromkeys(measures.reasons, reason))
        gdi = dataclasses.replace(gdi, reason=reason)
    return SessionMetrics(
        status=status,
        reason=reason,
        spatiotemporal=measures,
        gdi=gdi,
        qc=(*cycle_checks(measures, cycles), *gdi.qc),
        params_hash=Paramset.of("gait", "gait-metrics", 1, params).hash,
    )


def with_errors(measures: Spatiotemporal, cycles: Sequence[GaitCycle], events: Paramset) -> Spatiotemporal:
    """Return the measures of a session with the error of each, if one was measured for all its used cycles (fit and
    event method; lengths in metres that the detector assumes)."""
    used = [c for c in cycles if c.used]
    names = {c.error_model for c in used}
    if len(names) != 1 or "" in names or (model := load_model(names.pop())).events != events.hash:
        return measures
    metric = any(c.lengths.metric for c in used)
    found = dict(measures.measures)
    for name, m in found.items():
        # One mean of each side is known, so n - 2 degrees of freedom.
        error = None if m is None else measure_error(model, name, m.n, m.variability, m.n - 2)
        if m is None or error is None or (metric and name in LENGTHS):
            continue
        found[name] = dataclasses.replace(
            m, **dict(zip(OF_VISIT, (error[0], minimal_change_of(error[1])), strict=True))
        )
    return dataclasses.replace(measures, measures=found)


def _trial(
    trial: TrialFit | LabTrial,
    event_method: Paramset,
    index: dict[str, Any],
    fit_checks: Sequence[Check],
    condition: Condition,
    accept_cadence: bool,
) -> TrialMetrics:
    task: tuple[dict[str, Any], dict[str, str]] = {}, {}
    if isinstance(trial, LabTrial):
        events = trial.events
        about = {"trial": trial.name, "series": trial.series, "feet": trial.feet, "no_width": trial.no_width}
        cycles = find_cycles(events, **about, keep_ends=True)
        check_sides(cycles, trial.name)
    else:
        poses, events = _events(trial, event_method)
        cycles = find_cycles(events, trial, poses=poses, fit_checks=fit_checks)
        if accept_cadence:
            cycles = with_cadence_accepted(cycles)
        if condition.activity in TASK_MEASURES:
            task = task_measures(task_motion(trial, poses), condition.activity, fit_checks)
    measures, gdi = spatiotemporal(cycles).with_task(*task), score_gdi(cycles, **index)
    return TrialMetrics.of(trial.name, events, cycles, measures, gdi, condition.pooled(index["params"].pace))


def _events(trial: TrialFit, method: Paramset) -> tuple[BodyPoses, GaitEvents]:
    """Poses and events of a fit. An error names the trial: a session has several."""
    try:
        poses = trial_poses(trial)
        return poses, detect_events(feet_from_fit(trial, poses), method)
    except PblError as error:
        raise error.about(trial.name) from error.__cause__


def cycle_checks(measures: Spatiotemporal, cycles: Sequence[GaitCycle]) -> tuple[Check, ...]:
    """Checks of the cycles that `measures` were made of: `cycles_used`, `cycles_of_odd_length`,
    `cycles_of_odd_curves`, `legs_seen_alike`, `cadence_plausible`, `lengths_scale`."""
    odd = sum(c.odd_length for c in cycles)
    lengths = warn_if(odd, "cycles_of_odd_length", float(odd), 0.0, _odd_lengths(cycles))
    unlike = sum(c.odd_curves for c in cycles)
    far_off = "their angles are far from those of the other cycles: left out of the measures, see the overlay"
    curves = warn_if(unlike, "cycles_of_odd_curves", float(unlike), 0.0, far_off)
    cadence = _cadence_check(measures, cycles)
    if measures.status == EMPTY:
        return (Check("cycles_used", EMPTY, 0.0, LEAST_CYCLES, measures.reason), *((lengths,) if odd else ()), *cadence)
    n = measures.n_cycles_used
    few = "few cycles: film a longer stretch, or several passes"
    checks = [warn_if(n < FEW_CYCLES, "cycles_used", float(n), FEW_CYCLES, few), lengths, curves]
    if any(c.used for c in cycles):
        checks.append(legs_check(cycles))
    checks += cadence
    if measures["stride_length_m"] is not None:
        guessed = any(c.used and c.lengths.stride_length_m is not None and not c.lengths.metric for c in cycles)
        advice = (
            "lengths and speed are scaled by an assumed body size (one camera sees no scale): state the measured "
            "body height (--height-m), or compare visits of one person, not people"
        )
        checks.append(warn_if(guessed, "lengths_scale", None, None, advice))
    return tuple(checks)


def legs_check(cycles: Sequence[GaitCycle]) -> Check:
    """Check that one camera saw both legs alike in the used cycles: else left and right are not compared."""
    far = far_leg_of(cycles)
    near = "left" if far == "right" else "right"
    advice = (
        f"the {far} leg was behind the {near} one: its curves and measures are less certain, and the sides are "
        "not to be compared. Film a pass in each direction"
    )
    return warn_if(far, "legs_seen_alike", None, None, advice)


def _cadence_check(measures: Spatiotemporal, cycles: Sequence[GaitCycle]) -> tuple[Check, ...]:
    """Return the check `CADENCE` as a tuple: FAIL if cycles are left out for it, empty if no cadence is known."""
    if (refused := refused_cadence(cycles)) is not None:
        advice = (
            "unusual for walking, so that measures and index are withheld: count the steps in the overlay; where they "
            "are right, accept it with a reason"
        )
        return (Check(CADENCE, FAIL, refused, unusual_bound(refused), advice),)
    cadence = measures["cadence_steps_per_min"]
    if cadence is None:
        return ()
    bound = unusual_bound(cadence.mean)
    advice = "unusual for walking: count the steps in the overlay"
    return (warn_if(bound, CADENCE, round(cadence.mean, 2), bound or CADENCE_PER_MIN[1], advice),)


def _odd_lengths(cycles: Sequence[GaitCycle]) -> str:
    if any(c.exclusion.length_unproven for c in cycles):
        return (
            "a step was missed, or the person slowed down or paused; no feet show which: left out of the measures, "
            "which have no spread for it. Look at the events"
        )
    return "a step was missed or invented: left out of the measures, see the overlay"


def _short(gdi: Gdi) -> str:
    short = {GDI_MODEL: "GDI of three angles", PAPER_INDEX: "GDI, paper's recipe", GILLETTE_MODEL: "GDI of nine angles"}
    return short.get(gdi.model, gdi.model)


def _cell(value: float | None, width: int = 9) -> str:
    return f"{'-' if value is None else format(value, '.2f'):>{width}}"


def _measures(part: TrialMetrics | GaitMetrics) -> dict:
    values = part.spatiotemporal
    reasons = dict(values.reasons)
    if part.gdi.mean is None:
        reasons["gdi"] = part.gdi.reason
    return {
        "status": part.status,
        "reason": part.reason,
        **plain(values.measures, 4),
        "gdi": part.gdi.to_dict(),
        "profile_deg": plain(part.gdi.profile, 3),
        "reasons": reasons,
        "cycles": {"found": values.n_cycles_found, "used": values.n_cycles_used, "steps": values.n_steps_used},
        "outcome": worst(part.qc),
        "qc": plain(part.qc),
    }
