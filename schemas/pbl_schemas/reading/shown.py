"""Visits and recordings as pages show them: the library's `Visit` or `Recording` with the decisions about it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import settings
from pbl_pipeline.change import Result
from pbl_pipeline.errors import PblError, as_said, said
from pbl_pipeline.words import NOT_COMPUTED

from .. import fit, gait, gdi, qc, session, video
from ..decisions.not_usable import Unusable, unusable
from ..decisions.review_decisions import may_be_accepted
from ..rows import ReadAhead
from . import registered
from .objects import load_kinetics, load_solution, pooled_cycles
from .visit_list import VisitRow, earlier_result, results_of, visits_of
from .visits import load_recording, load_visit
from .why import Step, whys

if TYPE_CHECKING:
    import numpy as np

    from pbl_pipeline.gait import GaitCycle, Measure
    from pbl_pipeline.kinetics import Kinetics
    from pbl_pipeline.qc import Check
    from pbl_pipeline.visit import Recording, Visit


@dataclasses.dataclass(frozen=True)
class ShownCheck:
    """A check of a visit."""

    number: int  # of its row (`qc_no`), by which it is accepted
    check: Check
    recording: int | None  # number of the recording that it is about; None: the visit

    @property
    def may_be_accepted(self) -> bool:
        """True if a person can accept it (`review_decisions.may_be_accepted`)."""
        return may_be_accepted(self.check.check, self.check.outcome)


@dataclasses.dataclass(frozen=True)
class Pooled:
    """What is drawn of a result: its cycles, the body's scale and forces."""

    cycles: Sequence[GaitCycle]
    scale: np.ndarray | None
    kinetics: Kinetics | None


@dataclasses.dataclass(frozen=True)
class ShownVisit:
    """A visit, the result that is shown of it and the others that there are."""

    row: VisitRow  # its line in the list of visits
    recordings: tuple[Recording, ...]  # all of the visit, without their arrays; of any kind and result
    load_visit: Callable[[], Visit] | None = None  # loads `visit`; None if nothing is computed yet
    load_pooled: Callable[[], Pooled | None] = lambda: None  # what is drawn of it, in less time than `visit`
    results: tuple[Result, ...] = ()  # by every chain of methods
    shown: int | None = None  # number of the shown one among `results`
    key: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # in the tables that of the shown result
    measures: Mapping[str, tuple[Measure | None, str]] = dataclasses.field(default_factory=dict)  # or why not known
    #: By recording.
    tasks: Mapping[str, Mapping[str, tuple[Measure | None, str]]] = dataclasses.field(default_factory=dict)
    checks: tuple[ShownCheck, ...] = ()  # of the shown result, in the order of the chain
    lacks: tuple[str, ...] = ()  # what its files lack
    of_person: tuple[VisitRow, ...] = ()  # all visits of the person
    stopped: Mapping[int, Step] = dataclasses.field(default_factory=dict)  # recordings that failed or wait for a choice
    marks: Mapping[int, Unusable] = dataclasses.field(default_factory=dict)  # recordings marked as not usable
    computed: str = ""  # when the checks were computed
    earlier: Result | None = None  # without a result: the last one of a part of the recordings

    @property
    def result(self) -> Result | None:
        """The shown result in one line."""
        return None if self.shown is None else self.results[self.shown]

    @functools.cached_property
    def all_measures(self) -> dict[str, tuple[Measure | None, str]]:
        """`measures`, and those of tasks by "ACTIVITY.MEASURE": the mean over the recordings where they are several."""
        of_tasks: dict[str, list[tuple[Measure | None, str]]] = {}
        for r in self.recordings:
            for name, found in self.tasks.get(r.name, {}).items():
                of_tasks.setdefault(f"{r.condition.activity}.{name}", []).append(found)
        return {**self.measures, **{name: _mean_of(found) for name, found in of_tasks.items()}}

    @functools.cached_property
    def visit(self) -> Visit | None:
        """The visit with all of the shown result, which the page itself does not need. Raises as `load_visit`."""
        return None if self.load_visit is None else self.load_visit()


@dataclasses.dataclass(frozen=True)
class ShownRecording:
    """A recording and the visit that it is of."""

    recording: Recording
    number: int
    session_id: int
    subject: str
    label: str
    pictures: bool  # whether it was filmed; markers of a laboratory have no pictures
    duration_s: float | None = None  # with the next three None before the recording is probed, and without pictures
    n_frames: int | None = None
    width_px: int | None = None
    height_px: int | None = None
    hidden_heads: str = ""  # how heads are hidden in what is shown; empty for the original
    stopped: Step | None = None  # the step that failed or waits for a choice
    lead: int | None = None  # the recording with the fit, where several cameras filmed the trial and this is another

    def fitted(self) -> Recording:
        """Return the recording, which has a fit. Raises `PblError` DB_NOT_FOUND if it has none."""
        if self.recording.fitted:
            return self.recording
        raise PblError(
            "DB_NOT_FOUND",
            found=said("no fit of recording {n}: {why}", n=self.number, why=as_said(self.recording.problem)),
            expected="a recording to which a body is fitted",
            next_step="`pbl populate`; `pbl why` says what stops it",
        )


def _mean_of(found: Sequence[tuple[Measure | None, str]]) -> tuple[Measure | None, str]:
    """Return the measure of one recording, the mean of several, or why none has it."""
    from pbl_pipeline.gait import task_measure

    known = [(m, reason) for m, reason in found if m is not None]
    if len(known) < 2:
        return known[0] if known else found[0]
    return task_measure([m.mean for m, _ in known]), ""


def _problems(videos: Iterable[int]) -> dict[int, tuple[str, Step | None]]:
    """Return why recordings have no fit, without the state of the queues where one only waits to be computed, and the
    step that failed or waits for a choice."""
    return {v: (NOT_COMPUTED if found.waits else found.verdict, found.stopped) for v, found in whys(videos).items()}


def shown_visit(session_id: int, shown: int = 0) -> ShownVisit:
    """Return a visit by its number; `shown`: which of its results. Raises `PblError` DB_NOT_FOUND for an unknown visit
    or result."""
    of_person = visits_of(str(session.registered_visit(session_id)["subject"]))
    results = tuple(results_of([session_id])[session_id])
    if not 0 <= shown < max(1, len(results)):
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no result {shown} of session_id {session_id}",
            expected=f"one of its {len(results)} results",
            next_step="open the visit from the list",
        )
    recordings, stopped = _recordings(session_id)
    about = ShownVisit(
        row=next(v for v in of_person if v.session_id == session_id),
        recordings=recordings,
        of_person=of_person,
        stopped=stopped,
        marks=unusable([r.number for r in recordings if r.number is not None]),
    )
    if not results:
        return dataclasses.replace(about, earlier=earlier_result(session_id))
    names = ("fit_method", "gait_method", "gdi_method", "norm")
    chain = dict(zip(names, results[shown].methods, strict=True))
    # Restricted before it is projected: DataJoint leaves out conditions on columns that are not there.
    sets = (fit.FitSet & {"session_id": session_id, "fit_set_kind": results[shown].kind}).proj()
    key = dict((gdi.SessionGdi.proj() & (fit.current().proj() * sets).proj() & chain).keys()[0])
    of_result = {"session_id": session_id, **key, "fit_set_kind": results[shown].kind}
    return dataclasses.replace(
        about,
        load_visit=functools.partial(load_visit, of_result),
        load_pooled=functools.partial(_pooled, key, [int(r.number or 0) for r in recordings]),
        results=results,
        shown=shown,
        key=key,
        measures=_measures_of(key),
        tasks=_tasks_of(key, recordings),
        checks=_checks_of(key),
        computed="".join(str(t) for t in (qc.SessionQc & key).to_arrays("qc_computed")),
    )


def _pooled(key: Mapping[str, Any], videos: Sequence[int]) -> Pooled:
    """What is drawn of a result of these recordings, by its key. Raises as `load_visit`."""
    rows = ReadAhead([key], videos)
    return Pooled(pooled_cycles(key, rows), load_solution(key, rows).scale, load_kinetics(key, rows))


def computed_visit(session_id: int, shown: int) -> ShownVisit:
    """Return `shown_visit` of a visit that has a result. Raises also `PblError` DB_NOT_FOUND if it has none."""
    about = shown_visit(session_id, shown)
    if about.load_visit is None:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no result of session_id {session_id}",
            expected="a visit that was computed",
            next_step="`pbl populate`; `pbl status` says what stops it",
        )
    return about


def shown_recording(video_id: int) -> ShownRecording:
    """Return a recording by its number, without opening its arrays. Raises `PblError` DB_NOT_FOUND for an unknown
    number."""
    recording = load_recording(video_id)
    visits = video.Video.proj("session_id") * session.Session.proj("subject", "session_label")
    named = (visits & {"video_id": video_id}).fetch1()
    lead = fit.trial_of(video_id)
    stopped = None
    if not recording.fitted:
        problem, stopped = _problems([video_id])[video_id]
        recording = dataclasses.replace(recording, problem=problem)
    return ShownRecording(
        recording=recording,
        number=video_id,
        session_id=int(named["session_id"]),
        subject=named["subject"],
        label=named["session_label"],
        pictures=recording.path is not None,
        **video_facts(recording),
        hidden_heads=settings.deidentify_how() if recording.path is not None else "",
        stopped=stopped,
        lead=lead if lead != video_id else None,
    )


def video_facts(recording: Recording) -> dict[str, Any]:
    """Return duration (s), number of frames, width and height (px) of a recording's video; empty if not known."""
    info = recording.video
    names = ("duration_s", "n_frames", "width_px", "height_px")
    return {} if info is None else {name: getattr(info, name) for name in names}


def computations(video_id: int) -> tuple[Any, ...]:
    """Return the identity of the computations of the shown fit of a recording, its events and its cycles. Raises as
    `ShownRecording.fitted`."""
    key = fit.trial_key(video_id)
    if key is None:
        shown_recording(video_id).fitted()
        return ()
    found = gait.newest_events(key)
    made = [("fit", fit.SessionFit & key)]
    made += [] if found is None else [("events", gait.GaitEvents & found), ("cycles", gait.GaitCycle & found)]
    # The seconds differ where a row was made anew within the same second of the clock.
    when = [str(row) for name, rows in made for row in rows.proj(f"{name}_computed", f"{name}_seconds").to_dicts()]
    correction = None if found is None else gait.correction_of(found)
    return (*key.values(), *when, str(correction))


def _measures_of(key: Mapping[str, Any]) -> dict[str, tuple[Measure | None, str]]:
    """Return each measure of a result by its name, with the reason where it is not known."""
    from pbl_pipeline.words import MEASURES

    measures, reasons = gdi.SessionGdi.Measure.measures(key)
    return {n: (measures[n], reasons.get(n, "")) for n in MEASURES if n in measures}


def _tasks_of(
    key: Mapping[str, Any], recordings: Sequence[Recording]
) -> dict[str, dict[str, tuple[Measure | None, str]]]:
    """Return the measures of tasks of a result by the recording's name, as `_measures_of`."""
    from pbl_pipeline.words import TASKS

    of_result = {k: v for k, v in key.items() if k in gait.GaitEvents.primary_key}
    rows = (gait.Spatiotemporal.Measure & of_result & [{"measure": n} for n in TASKS]).to_dicts()
    found = {(int(r["video_id"]), r["measure"]): r for r in rows}
    values = {k: (gait.Spatiotemporal.Measure.measure(r), str(r["measure_missing"])) for k, r in found.items()}
    named = [(r.name, r.number) for r in recordings if r.number is not None]
    of_task = {name: {n: values[v, n] for n in TASKS if (v, n) in values} for name, v in named}
    return {name: measures for name, measures in of_task.items() if measures}


def _checks_of(key: Mapping[str, Any]) -> tuple[ShownCheck, ...]:
    from pbl_pipeline.qc import Check

    out = []
    for row in (qc.SessionQc.Check & key).to_dicts(order_by="qc_no"):
        about = row["qc_video_id"]
        check = Check(*(row[c] for c in qc.COLUMNS))
        out.append(ShownCheck(int(row["qc_no"]), check, None if about is None else int(about)))
    return tuple(out)


def _recordings(session_id: int) -> tuple[tuple[Recording, ...], dict[int, Step]]:
    """Return the recordings of a visit, with why one has no fit, and the step at which one stopped."""
    from pbl_pipeline.gait import Condition
    from pbl_pipeline.visit import Recording

    rows = registered.videos({"session_id": session_id}).to_dict("records")
    marked = unusable(int(row["video_id"]) for row in rows)
    problems = _problems(n for row in rows if not row["fits"] and (n := int(row["video_id"])) not in marked)
    out = []
    for row in rows:
        number = int(row["video_id"])
        condition = Condition(row["activity"], row["pace"] or "")
        problem = problems.get(number, ("", None))[0]
        out.append(Recording(row["video_name"], condition=condition, problem=problem, number=number))
    return tuple(out), {v: step for v, (_, step) in problems.items() if step is not None}
