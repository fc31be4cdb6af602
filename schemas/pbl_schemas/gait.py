"""Gait events, cycles and spatiotemporal measures of each fitted trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.temporary import new_folder

from . import fit, keypoints, session, video  # noqa: F401  definitions refer to session
from .datajoint_setup import dj
from .method_rows import method_columns, method_row
from .origin import Origin, computes, origin_columns
from .review import Decision
from .rows import Rows, check_columns, check_row, check_values, number, one, row_of, stored_rows
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline.gait.metrics_file import Curves

schema = dj.Schema()


def measure_columns(prefix: str) -> str:
    """Definition lines of a part table of measures; `measure_rows` returns its rows."""
    return f"""
    -> master
    {prefix}             : varchar(32)         # name, with its unit
    ---
    {prefix}_mean=null   : float64             # in the unit (see {prefix}): both sides
    {prefix}_left=null   : float64             # in the unit (see {prefix})
    {prefix}_right=null  : float64             # in the unit (see {prefix})
    {prefix}_sd=null     : float64             # in the unit (see {prefix}): n - 1, null for one value
    {prefix}_variability=null : float64        # in the unit (see {prefix}): sd within a side, null below two values of a side
    {prefix}_cv=null     : float64             # (percent) variability of the mean
    {prefix}_asymmetry=null   : float64        # (percent) right minus left, of their mean; null where it means nothing
    {prefix}_n           : int16               # values
    {prefix}_missing     : varchar(255)        # why it is null
    """  # noqa: E501


@schema
class GaitEventMethod(dj.Lookup):
    stage = "gait"
    definition = f"""
    # frozen parameters of event detection
    {method_columns("gait")}
    """


@schema
class GaitPlan(dj.Manual):
    definition = """
    # which sessions are searched for gait events by which method
    -> session.Session
    -> GaitEventMethod
    """


@schema
class EventCorrection(dj.Manual):
    definition = """
    # events of a trial by a method as a person set them; the last row of the person who is measured counts, the others are history
    -> video.Video
    -> GaitEventMethod
    correction_no            : int16           # in order of time, from 1
    ---
    correction_withdrawn     : bool            # true: the detected events count again; it has no Event
    correction_changed       : int16           # events that were moved, added or removed
    correction_tracking=null : varchar(48)     # tracking_method in which the measured person has its number, null for markers
    correction_person=null   : int16           # number of the measured person, null for markers
    correction_by            : varchar(64)     # name of who corrected
    correction_at            : datetime        # when, UTC
    """  # noqa: E501

    class Event(dj.Part):
        definition = """
        -> master
        corrected_no       : int16             # in order of time, from 1
        ---
        corrected_time     : float64           # (s) time of the trial
        corrected_side     : enum('left', 'right')
        corrected_kind     : enum('foot_down', 'foot_up')
        corrected_probability=null : float64   # (0..1) of the detection, which found it there; null: set by hand
        """


def correction_of(key: Mapping[str, Any]) -> dict[str, Any] | None:
    """Key of the correction that counts of the events of a trial (key of GaitEvents): the last one of the person who is
    measured in its set; None if there is none or the last one was withdrawn.

    Waits for a decision that is being written, and inside a transaction keeps others waiting until its end, so that
    what is computed from these rows and what is decided about them never cross.
    """
    fit.session_of_set(key)
    # A locking read sees what is committed, whenever this transaction began.
    of_trial = {k: key[k] for k in ("video_id", "gait_method")}
    row = EventCorrection.connection.query(
        f"SELECT correction_no, correction_withdrawn FROM {EventCorrection.full_table_name} WHERE video_id = %s"  # noqa: S608
        " AND gait_method = %s AND correction_tracking <=> %s AND correction_person <=> %s"
        " ORDER BY correction_no DESC LIMIT 1 LOCK IN SHARE MODE",
        args=(*of_trial.values(), *measured_person(key)),
    ).fetchone()
    return None if row is None or row[1] else {**of_trial, "correction_no": int(row[0])}


def accepted_cadence(key: Mapping[str, Any]) -> float | None:
    """Return the cadence (steps/min) of a trial (key of GaitEvents) that a person accepted last; None if no one did.

    `decisions.review_decisions.accept_check` writes it. Call it after `correction_of`, which waits for a decision that
    is being written.
    """
    of_trial = {k: key[k] for k in ("fit_set", "fit_method", "gait_method")}
    found = Decision & {"session_id": fit.session_of_set(key), "decision_what": "check"}
    decided = [r["decision_about"] for r in found.to_dicts(order_by="decision_id DESC")]
    cadences = [about.get("cadence", {}) for about in decided if of_trial.items() <= about.items()]
    return next((float(of[video]) for of in cadences if (video := str(key["video_id"])) in of), None)


def newest_events(key: Mapping[str, Any]) -> dict[str, Any] | None:
    """Key of the events of a fitted trial (key of SessionFit.Trial) that are shown: corrected ones before others, then
    those that were detected last; None if none were detected yet."""
    rows = (GaitEvents.proj("events_computed") & key).to_dicts(order_by="events_computed DESC")
    keys = [{k: row[k] for k in GaitEvents.primary_key} for row in rows]
    return next((k for k in keys if correction_of(k) is not None), keys[0] if keys else None)


def measured_person(key: Mapping[str, Any]) -> tuple[str | None, int | None]:
    """Tracking method and number of the person who is measured in a trial (key of SessionFit.Trial); None for both of
    laboratory markers."""
    trial = {k: key[k] for k in ("fit_set", "video_id")}
    rows = ((fit.FitSet.Video & trial) * keypoints.Keypoints.proj("keypoints_person_id")).to_dicts()
    return (rows[0]["tracking_method"], int(rows[0]["keypoints_person_id"])) if rows else (None, None)


@schema
class GaitEvents(dj.Computed):
    definition = f"""
    # foot down and foot up of both sides; EMPTY: ran well, nobody walks
    -> fit.SessionFit.Trial
    -> GaitEventMethod
    ---
    -> session.Session
    events_status     : enum('PASS', 'EMPTY')
    events_reason     : varchar(1000)          # why EMPTY
    events_detector   : varchar(64)            # name of the method in the library
    events_source     : varchar(64)            # what the feet come from
    walking_bouts     : json                   # (s) start and end of each walking bout
    n_events          : int16
    n_candidates      : int16                  # possible events before their check
    n_order_breaks    : int16                  # bouts that ended because an event was missing or out of order
    {origin_columns("events")}
    index (events_status)
    """

    class Event(dj.Part):
        definition = """
        -> master
        event_no          : int16              # in order of time, from 1
        ---
        event_time        : float64            # (s) time of the trial
        event_side        : enum('left', 'right')
        event_kind        : enum('foot_down', 'foot_up')
        event_probability : float64            # (0..1) that it is real; by coordinates: how clear it is, not calibrated
        event_bout        : int16              # walking bout, from 0
        """

    class Check(dj.Part):
        definition = f"""
        # quality checks of the events
        {check_columns("events")}
        """

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * GaitPlan
        return (fit.SessionFit.Trial.proj() * GaitEventMethod.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        return file_ref(one(fit.SessionFit.Trial & key, "trial_file")), method_row(GaitEventMethod, key)

    @computes
    def make_compute(self, key: dict, ref: dict, method: Mapping[str, Any]) -> tuple[lib.GaitEvents, str]:
        from pbl_pipeline.gait import detect_events, feet_from_fit

        return detect_events(feet_from_fit(fit.load_trial(ref)), methods.stored(**method)), method["sha"]

    def make_insert(self, key: dict, found: lib.GaitEvents, sha: str, origin: Origin) -> None:
        self.insert1(
            {
                **key,
                "session_id": fit.session_of_set(key),
                "events_status": found.status,
                "events_reason": found.reason[:1000],
                "events_detector": found.method,
                "events_source": found.source[:64],
                "walking_bouts": [[float(a), float(b)] for a, b in found.walking_s],
                "n_events": len(found.events),
                "n_candidates": found.n_candidates,
                "n_order_breaks": found.n_order_breaks,
                **origin.row("events", method_hash=sha),
            }
        )
        self.Event.insert(
            {
                **key,
                "event_no": i,
                "event_time": e.time_s,
                "event_side": e.side,
                "event_kind": e.event,
                "event_probability": e.probability,
                "event_bout": e.bout,
            }
            for i, e in enumerate(found.events, 1)
        )
        self.Check.insert({**key, **check_row("events", check)} for check in found.qc)


@schema
class GaitCycle(dj.Computed):
    definition = f"""
    # strides of a trial, foot down to the next foot down of the same side
    -> GaitEvents
    ---
    -> session.Session
    -> [nullable] EventCorrection
    n_cycles        : int16                    # all complete cycles
    n_cycles_used   : int16                    # without first and last steps, odd lengths and odd curves
    curves          : <object@arrays>          # npz: cycle_no (N), names (A), percent (P) of the cycle, curve and curve_sd (N,A,P) deg
    {origin_columns("cycles")}
    """  # noqa: E501

    class Cycle(dj.Part):
        definition = """
        -> master
        cycle_no           : int16             # in order of time, both sides together, from 0
        ---
        cycle_side         : enum('left', 'right')
        cycle_bout         : int16             # walking bout, from 0
        cycle_start        : float64           # (s) foot down
        opposite_foot_up   : float64           # (s)
        opposite_foot_down : float64           # (s)
        cycle_foot_up      : float64           # (s)
        cycle_end          : float64           # (s) next foot down of the same side
        cycle_used         : bool              # false where one of the next six says why
        cycle_first_step   : bool              # touches the first step of its walking bout
        cycle_last_step    : bool              # touches the last step of its walking bout
        cycle_length_ratio=null : float64      # (1) length over the typical stride's, null unless left out for it
        cycle_length_unproven=null : bool      # no feet show whether a step was missed; null: not left out for its length, or not known
        cycle_curve_distance=null : float64    # (deg) from its side's median curves, null unless left out for it
        cycle_curves_n=null : int16            # cycles of that median, null with it
        cycle_failed_checks : json             # names of the checks of the fit that FAIL, such as []
        curves_missing     : varchar(100)      # why it has no curves
        cycle_far_leg=null : enum('left', 'right')  # the leg that one camera saw behind the other, if one
        cycle_stride_length=null : float64     # (m) over the floor
        cycle_step_length=null   : float64     # (m) of the step that ends the cycle
        cycle_step_width=null    : float64     # (m) null unless the metres were measured
        cycle_lengths_metric=null : bool       # false: as large as the detector takes the person to be
        cycle_lengths_missing='' : varchar(150)  # why there are no lengths
        """  # noqa: E501

    def make_fetch(self, key: dict) -> tuple:
        correction = correction_of(key)
        events = events_of(one(GaitEvents & key), correction)
        ref = file_ref(one(fit.SessionFit.Trial & key, "trial_file"))
        return events, ref, fit.fit_checks(key), correction, accepted_cadence(key)

    @computes
    def make_compute(
        self,
        key: dict,
        events: lib.GaitEvents,
        ref: dict,
        checks: Sequence[tuple],
        correction: Mapping[str, Any] | None,
        accepted: float | None,
    ) -> tuple[tuple[lib.GaitCycle, ...], int | None]:
        from pbl_pipeline.gait import find_cycles, refused_cadence, with_cadence_accepted
        from pbl_pipeline.qc import Check

        cycles = find_cycles(events, fit.load_trial(ref), fit_checks=[Check(*check) for check in checks])
        if accepted is not None and refused_cadence(cycles) == accepted:
            cycles = with_cadence_accepted(cycles)
        return cycles, None if correction is None else correction["correction_no"]

    def make_insert(self, key: dict, cycles: Sequence[lib.GaitCycle], correction: int | None, origin: Origin) -> None:
        from pbl_pipeline.gait.metrics_file import save_curves

        with new_folder() as folder:
            save_curves(cycles, folder / "curves.npz")
            self.insert1(
                {
                    **key,
                    "session_id": fit.session_of_set(key),
                    "correction_no": correction,
                    "n_cycles": len(cycles),
                    "n_cycles_used": sum(c.used for c in cycles),
                    "curves": folder / "curves.npz",
                    **origin.row("cycles"),
                }
            )
        self.Cycle.insert({**key, **row_of_cycle(c)} for c in cycles)


@schema
class Spatiotemporal(dj.Computed):
    definition = f"""
    # measures of a trial over its used cycles; null where one cannot be trusted (Measure says why)
    -> GaitCycle
    ---
    -> session.Session
    measures_status          : enum('PASS', 'EMPTY')
    measures_reason          : varchar(1000)   # why EMPTY
    n_steps_used             : int16
    cadence=null             : float64         # (steps/min)
    stride_time=null         : float64         # (s)
    step_time=null           : float64         # (s)
    stance=null              : float64         # (percent) of the cycle
    swing=null               : float64         # (percent) of the cycle
    double_support=null      : float64         # (percent) of the cycle
    double_support_time=null : float64         # (s) both double supports of a cycle
    speed=null               : float64         # (m/s)
    stride_length=null       : float64         # (m)
    step_width=null          : float64         # (m)
    {origin_columns("measures")}
    index (measures_status)
    """

    class Measure(dj.Part):
        definition = f"""
        # every measure with both sides and its spread
        {measure_columns("measure")}
        """

    def make_fetch(self, key: dict) -> tuple:
        name = one(fit.SessionFit.Trial & key, "trial_name")
        rows = (GaitCycle.Cycle & key).to_dicts(order_by="cycle_no")
        activity = video.condition(key["video_id"]).activity
        ref = file_ref(one(fit.SessionFit.Trial & key, "trial_file"))
        return name, [{k: v for k, v in r.items() if k not in key} for r in rows], activity, ref, fit.fit_checks(key)

    @computes
    def make_compute(
        self,
        key: dict,
        name: str,
        rows: Sequence[Mapping[str, Any]],
        activity: str,
        ref: dict,
        checks: Sequence[tuple],
    ) -> tuple[lib.Spatiotemporal]:
        from pbl_pipeline.gait import TASK_MEASURES, spatiotemporal, task_measures, task_motion
        from pbl_pipeline.qc import Check

        found = spatiotemporal([cycle_of_row(r, name) for r in rows])
        if activity in TASK_MEASURES:
            motion = task_motion(fit.load_trial(ref))
            found = found.with_task(*task_measures(motion, activity, [Check(*check) for check in checks]))
        return (found,)

    def make_insert(self, key: dict, result: lib.Spatiotemporal, origin: Origin) -> None:
        self.insert1(
            {
                **key,
                "session_id": fit.session_of_set(key),
                "measures_status": result.status,
                "measures_reason": result.reason[:1000],
                "n_steps_used": result.n_steps_used,
                **{column: mean_of(result.measures[name]) for name, column in MEASURE_COLUMNS.items()},
                **origin.row("measures"),
            }
        )
        self.Measure.insert({**key, **row} for row in measure_rows(result.measures, result.reasons))


#: Name of a measure in metrics.json -> column of Spatiotemporal (the unit is in the column's comment).
MEASURE_COLUMNS = {
    "cadence_steps_per_min": "cadence",
    "stride_time_s": "stride_time",
    "step_time_s": "step_time",
    "stance_percent": "stance",
    "swing_percent": "swing",
    "double_support_percent": "double_support",
    "double_support_time_s": "double_support_time",
    "speed_m_per_s": "speed",
    "stride_length_m": "stride_length",
    "step_width_m": "step_width",
}


#: Column after its prefix -> attribute of the library's `Measure`.
_MEASURE_PARTS = (
    ("mean", "mean"),
    ("left", "left"),
    ("right", "right"),
    ("sd", "sd"),
    ("variability", "variability"),
    ("cv", "cv_percent"),
    ("asymmetry", "asymmetry_percent"),
)


def measure_of_row(row: Mapping[str, Any], prefix: str) -> lib.Measure | None:
    """The library's `Measure` of a row of `measure_columns(prefix)`, None if it is not known."""
    from pbl_pipeline.gait import Measure

    if row[f"{prefix}_mean"] is None:
        return None
    values: dict[str, Any] = {k: number(row[f"{prefix}_{column}"]) for column, k in _MEASURE_PARTS}
    of_visit = {"error": "error_sd", "minimal_change": "minimal_change"}  # columns that measures of a trial lack
    values |= {k: number(row.get(f"{prefix}_{column}")) for column, k in of_visit.items()}
    return Measure(**values, n=int(row[f"{prefix}_n"]))


def mean_of(measure: lib.Measure | None) -> float | None:
    """The mean of a library `Measure`, None if there is none."""
    return None if measure is None else number(measure.mean)


def measure_rows(
    measures: Mapping[str, lib.Measure | None], reasons: Mapping[str, str], prefix: str = "measure"
) -> list[dict]:
    """Rows of a part table with `measure_columns(prefix)`."""
    rows = []
    for name, m in measures.items():
        row: dict[str, Any] = {prefix: name, f"{prefix}_missing": reasons.get(name, "")[:255]}
        row |= {f"{prefix}_{column}": None if m is None else number(getattr(m, k)) for column, k in _MEASURE_PARTS}
        rows.append({**row, f"{prefix}_n": 0 if m is None else m.n})
    return rows


def events_of(
    row: Mapping[str, Any], correction: Mapping[str, Any] | None = None, rows: Rows = stored_rows
) -> lib.GaitEvents:
    """The library's `GaitEvents` of a row of GaitEvents: the detected ones, or those that a correction (key of
    EventCorrection) sets instead."""
    from pbl_pipeline import gait as lib
    from pbl_pipeline.qc import Check, in_order

    key = {k: row[k] for k in GaitEvents.primary_key}
    detected = lib.GaitEvents(
        status=row["events_status"],
        events=tuple(
            lib.GaitEvent(*(e[f"event_{k}"] for k in ("time", "side", "kind", "probability", "bout")))
            for e in rows(GaitEvents.Event, key)
        ),
        reason=row["events_reason"],
        method=row["events_detector"],
        params_hash=row["events_method_hash"],
        source=row["events_source"],
        walking_s=tuple((float(a), float(b)) for a, b in row["walking_bouts"]),
        n_candidates=int(row["n_candidates"]),
        n_order_breaks=int(row["n_order_breaks"]),
        qc=in_order(Check(*check_values("events", check)) for check in rows(GaitEvents.Check, key)),
    )
    if correction is None:
        return detected
    changed = row_of(EventCorrection, correction, rows)["correction_changed"]
    names = ("corrected_time", "corrected_side", "corrected_kind", "corrected_probability")
    found = [[e[name] for name in names] for e in rows(EventCorrection.Event, correction)]
    events = [lib.GaitEvent(float(t), side, kind, 1.0 if p is None else float(p)) for t, side, kind, p in found]
    return lib.apply_correction(detected, events, int(changed))


def load_events(key: Mapping[str, Any], rows: Rows = stored_rows) -> lib.GaitEvents:
    """The library's `GaitEvents` that the row of GaitCycle of this key was made from."""
    row = row_of(GaitEvents, {k: key[k] for k in GaitEvents.primary_key}, rows)
    cycles = row_of(GaitCycle, {k: row[k] for k in GaitEvents.primary_key}, rows)
    names = EventCorrection.primary_key
    return events_of(row, None if cycles["correction_no"] is None else {k: cycles[k] for k in names}, rows)


def row_of_cycle(c: lib.GaitCycle) -> dict[str, Any]:
    """A row of GaitCycle.Cycle, without its key above; its curves are in a file."""
    return {
        "cycle_no": c.number,
        "cycle_side": c.side,
        "cycle_bout": c.bout,
        "cycle_start": c.start_s,
        "opposite_foot_up": c.opposite_foot_up_s,
        "opposite_foot_down": c.opposite_foot_down_s,
        "cycle_foot_up": c.foot_up_s,
        "cycle_end": c.end_s,
        "cycle_used": c.used,
        "cycle_first_step": c.exclusion.first_step,
        "cycle_last_step": c.exclusion.last_step,
        "cycle_length_ratio": number(c.exclusion.length_ratio),
        "cycle_length_unproven": None if c.exclusion.length_ratio is None else c.exclusion.length_unproven,
        "cycle_curve_distance": number(c.exclusion.curve_distance_deg),
        "cycle_curves_n": c.exclusion.n_curves,
        "cycle_failed_checks": list(c.exclusion.failed_checks),
        "curves_missing": c.curves_missing[:100],
        "cycle_far_leg": c.far_leg or None,
        "cycle_stride_length": number(c.lengths.stride_length_m),
        "cycle_step_length": number(c.lengths.step_length_m),
        "cycle_step_width": number(c.lengths.step_width_m),
        "cycle_lengths_metric": c.lengths.metric,
        "cycle_lengths_missing": c.lengths.missing[:150],
    }


def cycle_of_row(row: Mapping[str, Any], trial: str, curves: Curves | None = None) -> lib.GaitCycle:
    from pbl_pipeline import gait as lib

    return lib.GaitCycle(
        trial=trial,
        number=int(row["cycle_no"]),
        bout=int(row["cycle_bout"]),
        side=row["cycle_side"],
        start_s=float(row["cycle_start"]),
        opposite_foot_up_s=float(row["opposite_foot_up"]),
        opposite_foot_down_s=float(row["opposite_foot_down"]),
        foot_up_s=float(row["cycle_foot_up"]),
        end_s=float(row["cycle_end"]),
        exclusion=lib.Exclusion(
            first_step=bool(row["cycle_first_step"]),
            last_step=bool(row["cycle_last_step"]),
            length_ratio=number(row["cycle_length_ratio"]),
            # NULL for cycles older than this column: it is not known, so the spread is withheld
            length_unproven=row["cycle_length_ratio"] is not None and row["cycle_length_unproven"] != 0,
            curve_distance_deg=number(row["cycle_curve_distance"]),
            n_curves=None if row["cycle_curves_n"] is None else int(row["cycle_curves_n"]),
            failed_checks=tuple(row["cycle_failed_checks"]),
        ),
        curves=dict(curves.deg if curves else {}),
        curves_missing=row["curves_missing"],
        curves_sd=dict(curves.sd_deg if curves else {}),
        far_leg=row["cycle_far_leg"] or "",
        error_model=curves.error_model if curves else "",
        lengths=lib.Lengths(
            number(row["cycle_stride_length"]),
            number(row["cycle_step_length"]),
            number(row["cycle_step_width"]),
            row["cycle_lengths_missing"],
            bool(row["cycle_lengths_metric"]),
        ),
    )


def load_cycles(key: Mapping[str, Any], trial: str = "", rows: Rows = stored_rows) -> list[lib.GaitCycle]:
    """Return the library's cycles of one row of GaitCycle, with their curves."""
    return cycles_of_rows(rows(GaitCycle.Cycle, key), file_ref(row_of(GaitCycle, key, rows)["curves"]), trial)


def cycles_of_rows(rows: Sequence[Mapping[str, Any]], ref: Mapping[str, Any], trial: str) -> list[lib.GaitCycle]:
    """Return the library's cycles of rows of GaitCycle.Cycle, with their curves from the file `ref`."""
    from pbl_pipeline.gait.metrics_file import load_curves

    with stored_file(ref) as path:
        curves = load_curves(path)
    return [cycle_of_row(r, trial, curves.get(int(r["cycle_no"]))) for r in rows]
