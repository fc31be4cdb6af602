"""Gait events, cycles and spatiotemporal measures of each fitted trial."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.qc import in_order
from pbl_pipeline.records import definition, from_row, number, to_row
from pbl_pipeline.results.cycles import GaitCycle as Cycle
from pbl_pipeline.results.events import GaitEvent, SetEvent
from pbl_pipeline.results.events import GaitEvents as Events
from pbl_pipeline.results.measures import COUNTS, Measure
from pbl_pipeline.results.measures import Spatiotemporal as Measures
from pbl_pipeline.temporary import new_folder

from . import fit, keypoints, session, video  # noqa: F401  definitions refer to session
from .datajoint_setup import dj
from .method_rows import method_row, method_table
from .origin import Origin, computes, origin_columns
from .record_parts import measures_of, part_of
from .review import Decision
from .rows import Rows, one, row_of, stored_rows
from .stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline.results.cycles import Curves

schema = dj.Schema()


#: Measures whose mean has a column in the row of the result -> that column, its comment.
MEASURE_COLUMNS = {
    "cadence_steps_per_min": ("cadence", "(steps/min)"),
    "stride_time_s": ("stride_time", "(s)"),
    "step_time_s": ("step_time", "(s)"),
    "stance_percent": ("stance", "(percent) of the cycle"),
    "swing_percent": ("swing", "(percent) of the cycle"),
    "double_support_percent": ("double_support", "(percent) of the cycle"),
    "double_support_time_s": ("double_support_time", "(s) both double supports of a cycle"),
    "speed_m_per_s": ("speed", "(m/s)"),
    "stride_length_m": ("stride_length", "(m)"),
    "step_width_m": ("step_width", "(m)"),
}


def mean_columns(names: Iterable[str], prefix: str = "") -> str:
    """Definition lines of the means of these measures; `mean_row` returns their values."""
    columns = (MEASURE_COLUMNS[name] for name in names)
    return "\n".join(f"{prefix}{column}=null : float64  # {comment}" for column, comment in columns)


def mean_row(measures: Mapping[str, Measure | None], names: Iterable[str], prefix: str = "") -> dict[str, float | None]:
    """Values of `mean_columns(names, prefix)`."""
    return {f"{prefix}{MEASURE_COLUMNS[n][0]}": None if (m := measures[n]) is None else number(m.mean) for n in names}


GaitEventMethod = schema(method_table("GaitEventMethod", "gait", "gait", "event detection"))


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

    Event = part_of("Event", SetEvent, key="corrected_no : int16  # in order of time, from 1")


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
    {definition(Events)}
    {origin_columns("events")}
    index (events_status)
    """

    Event = part_of("Event", GaitEvent, key="event_no : int16  # in order of time, from 1")

    Check = part_of("Check", Quality, "events", "quality checks of the events")

    @property
    def key_source(self) -> Any:
        planned = fit.FitSet.proj("session_id") * GaitPlan
        return (fit.SessionFit.Trial.proj() * GaitEventMethod.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        return file_ref(one(fit.SessionFit.Trial & key, "trial_file")), method_row(GaitEventMethod, key)

    @computes
    def make_compute(self, key: dict, ref: dict, method: Mapping[str, Any]) -> tuple[Events, str]:
        from pbl_pipeline.gait import detect_events, feet_from_fit

        return detect_events(feet_from_fit(fit.load_trial(ref)), methods.stored(**method)), method["sha"]

    def make_insert(self, key: dict, found: Events, sha: str, origin: Origin) -> None:
        self.insert1({**fit.of_session(key), **to_row(found), **origin.row("events", method_hash=sha)})
        self.Event.insert_records(key, found.events)
        self.Check.insert_records(key, found.qc)


@schema
class GaitCycle(dj.Computed):
    definition = f"""
    # strides of a trial, foot down to the next foot down of the same side
    -> GaitEvents
    ---
    -> session.Session
    -> [nullable] EventCorrection
    {definition(Measures, only=COUNTS)}
    curves          : <object@arrays>          # cycles.npz
    {origin_columns("cycles")}
    """

    Cycle = part_of("Cycle", Cycle)

    def make_fetch(self, key: dict) -> tuple:
        correction = correction_of(key)
        events = events_of(one(GaitEvents & key), correction)
        ref = file_ref(one(fit.SessionFit.Trial & key, "trial_file"))
        return events, ref, fit.fit_checks(key), correction, accepted_cadence(key)

    @computes
    def make_compute(
        self,
        key: dict,
        events: Events,
        ref: dict,
        checks: Sequence[Quality],
        correction: Mapping[str, Any] | None,
        accepted: float | None,
    ) -> tuple[tuple[Cycle, ...], int | None]:
        from pbl_pipeline.gait import find_cycles, refused_cadence, with_cadence_accepted

        cycles = find_cycles(events, fit.load_trial(ref), fit_checks=checks)
        if accepted is not None and refused_cadence(cycles) == accepted:
            cycles = with_cadence_accepted(cycles)
        return cycles, None if correction is None else correction["correction_no"]

    def make_insert(self, key: dict, cycles: Sequence[Cycle], correction: int | None, origin: Origin) -> None:
        from pbl_pipeline.gait.metrics_file import save_curves

        with new_folder() as folder:
            save_curves(cycles, folder / "curves.npz")
            counts = {"n_cycles": len(cycles), "n_cycles_used": sum(c.used for c in cycles)}
            row = {"correction_no": correction, **counts, "curves": folder / "curves.npz", **origin.row("cycles")}
            self.insert1({**fit.of_session(key), **row})
        self.Cycle.insert({**key, **row_of_cycle(c)} for c in cycles)


@schema
class Spatiotemporal(dj.Computed):
    definition = f"""
    # measures of a trial over its used cycles; null where one cannot be trusted (Measure says why)
    -> GaitCycle
    ---
    -> session.Session
    {definition(Measures, without=COUNTS)}
    {mean_columns(MEASURE_COLUMNS)}
    {origin_columns("measures")}
    index (measures_status)
    """

    Measure = measures_of(Measure, "measure", "every measure with both sides and its spread", "measure : varchar(32)")

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
        checks: Sequence[Quality],
    ) -> tuple[Measures]:
        from pbl_pipeline.gait import TASK_MEASURES, spatiotemporal, task_measures, task_motion

        found = spatiotemporal([cycle_of_row(r, name) for r in rows])
        if activity in TASK_MEASURES:
            motion = task_motion(fit.load_trial(ref))
            found = found.with_task(*task_measures(motion, activity, checks))
        return (found,)

    def make_insert(self, key: dict, result: Measures, origin: Origin) -> None:
        row = {**to_row(result, without=COUNTS), **mean_row(result.measures, MEASURE_COLUMNS)}
        self.insert1({**fit.of_session(key), **row, **origin.row("measures")})
        self.Measure.insert_measures(key, result.measures, result.reasons)


def events_of(row: Mapping[str, Any], correction: Mapping[str, Any] | None = None, rows: Rows = stored_rows) -> Events:
    """The library's `GaitEvents` of a row of GaitEvents: the detected ones, or those that a correction (key of
    EventCorrection) sets instead."""
    key = {k: row[k] for k in GaitEvents.primary_key}
    detected = from_row(
        Events,
        row,
        events=tuple(GaitEvents.Event.records(key, rows)),
        params_hash=row["events_method_hash"],
        qc=in_order(GaitEvents.Check.records(key, rows)),
    )
    if correction is None:
        return detected
    from pbl_pipeline import gait as lib

    changed = row_of(EventCorrection, correction, rows)["correction_changed"]
    found = map(dataclasses.astuple, EventCorrection.Event.records(correction, rows))
    events = [GaitEvent(t, side, kind, 1.0 if p is None else p) for t, side, kind, p in found]
    return lib.apply_correction(detected, events, int(changed))


def load_events(key: Mapping[str, Any], rows: Rows = stored_rows) -> Events:
    """The library's `GaitEvents` that the row of GaitCycle of this key was made from."""
    row = row_of(GaitEvents, {k: key[k] for k in GaitEvents.primary_key}, rows)
    cycles = row_of(GaitCycle, {k: row[k] for k in GaitEvents.primary_key}, rows)
    names = EventCorrection.primary_key
    return events_of(row, None if cycles["correction_no"] is None else {k: cycles[k] for k in names}, rows)


def row_of_cycle(c: Cycle) -> dict[str, Any]:
    """A row of GaitCycle.Cycle, without its key above; its curves are in a file."""
    left_out = c.exclusion.length_ratio is not None
    return to_row(c) | ({} if left_out else {"cycle_length_unproven": None})


def cycle_of_row(row: Mapping[str, Any], trial: str, curves: Curves | None = None) -> Cycle:
    """The library's cycle of a row of GaitCycle.Cycle."""
    if row["cycle_length_ratio"] is not None and row["cycle_length_unproven"] is None:
        row = {**row, "cycle_length_unproven": True}  # older than the column: not known, so the spread is withheld
    return from_row(Cycle, row, trial=trial, **({} if curves is None else curves._asdict()))


def load_cycles(key: Mapping[str, Any], trial: str = "", rows: Rows = stored_rows) -> list[Cycle]:
    """Return the library's cycles of one row of GaitCycle, with their curves."""
    return cycles_of_rows(rows(GaitCycle.Cycle, key), file_ref(row_of(GaitCycle, key, rows)["curves"]), trial)


def cycles_of_rows(rows: Sequence[Mapping[str, Any]], ref: Mapping[str, Any], trial: str) -> list[Cycle]:
    """Return the library's cycles of rows of GaitCycle.Cycle, with their curves from the file `ref`."""
    from pbl_pipeline.gait.metrics_file import load_curves

    curves = read_stored(ref, load_curves)
    return [cycle_of_row(r, trial, curves.get(int(r["cycle_no"]))) for r in rows]
