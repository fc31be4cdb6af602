"""Everything the tables say of one visit, for people to look at: its recordings, measures and checks."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from . import fit, gait, gdi, listing, qc, session
from .usable import Unusable, unusable
from .visit_list import Result, VisitRow, results_of, visits_of
from .why import why

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline.qc import Check


@dataclasses.dataclass(frozen=True)
class RecordingRow:
    """A recording of a visit. problem: where its computation stands, empty where it has a fit; mark: why it is not
    usable, None where nobody said so."""

    video_id: int
    name: str
    activity: str
    pace: str
    fitted: bool
    problem: str
    mark: Unusable | None


@dataclasses.dataclass(frozen=True)
class VisitCheck:
    """A check of a visit; number: its `qc_no`; video_id: of the recording that it is about, None for the visit."""

    number: int
    check: Check
    video_id: int | None


@dataclasses.dataclass(frozen=True)
class MeasureRow:
    """A measure of a visit: its values, or why it is not known."""

    name: str
    value: lib.Measure | None
    missing: str


@dataclasses.dataclass(frozen=True)
class VisitPage:
    """A visit. results: by every chain of methods, `shown` the number of the one whose measures and checks stand here
    (None: there is none); key: that of its row of SessionGdi; computed: when its checks were."""

    visit: VisitRow
    of_person: tuple[VisitRow, ...]
    recordings: tuple[RecordingRow, ...]
    results: tuple[Result, ...]
    shown: int | None
    measures: tuple[MeasureRow, ...]
    checks: tuple[VisitCheck, ...]
    key: dict[str, Any]
    computed: str


def visit_about(session_id: int, shown: int = 0) -> VisitPage:
    """A visit by its number; `shown`: which of its results.

    Raises `PblError` DB_NOT_FOUND for a number that no visit or result has.
    """
    subjects = (session.Session & {"session_id": session_id}).to_arrays("subject")
    if not len(subjects):
        raise session.unknown_visit(session_id)
    of_person = visits_of(str(subjects[0]))
    results = tuple(results_of([session_id])[session_id])
    if not 0 <= shown < max(1, len(results)):
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no result {shown} of session_id {session_id}",
            expected=f"one of its {len(results)} results",
            next_step="open the visit from the list",
        )
    key = key_of(session_id, results[shown]) if results else {}
    return VisitPage(
        visit=next(v for v in of_person if v.session_id == session_id),
        of_person=of_person,
        recordings=_recordings(session_id),
        results=results,
        shown=shown if results else None,
        measures=_measures(key) if key else (),
        checks=checks_of(key) if key else (),
        key=key,
        computed="".join(str(t) for t in (qc.SessionQc & key).to_arrays("qc_computed")) if key else "",
    )


def key_of(session_id: int, result: Result) -> dict[str, Any]:
    """The key of SessionGdi of a result of a visit."""
    names = ("fit_method", "gait_method", "gdi_method", "norm")
    chain = dict(zip(names, result.methods, strict=True))
    # Restricted before it is projected: DataJoint leaves out what names a column that is not there.
    sets = (fit.FitSet & {"session_id": session_id, "fit_set_kind": result.kind}).proj()
    current = fit.current().proj() * sets
    return dict((gdi.SessionGdi.proj() & current.proj() & chain).keys()[0])


def checks_of(key: dict[str, Any]) -> tuple[VisitCheck, ...]:
    """The checks of a result in the order of the chain."""
    from pbl_pipeline.qc import Check

    rows = (qc.SessionQc.Check & key).to_dicts(order_by="qc_no")
    out = []
    for row in rows:
        values = [row[c] for c in qc.COLUMNS]
        video_id = row["qc_video_id"]
        out.append(VisitCheck(int(row["qc_no"]), Check(*values), None if video_id is None else int(video_id)))
    return tuple(out)


def _recordings(session_id: int) -> tuple[RecordingRow, ...]:
    out = []
    rows = listing.videos({"session_id": session_id}).to_dict("records")
    marked = unusable(int(row["video_id"]) for row in rows)
    for row in rows:
        number, fitted = int(row["video_id"]), bool(row["fits"])
        mark = marked.get(number)
        said = "" if fitted or mark else why(number).verdict
        out.append(RecordingRow(number, row["video_name"], row["activity"], row["pace"] or "", fitted, said, mark))
    return tuple(out)


def _measures(key: dict[str, Any]) -> tuple[MeasureRow, ...]:
    from pbl_pipeline.words import MEASURES

    rows = {r["session_measure"]: r for r in (gdi.SessionGdi.Measure & key).to_dicts()}
    return tuple(
        MeasureRow(n, gait.measure_of_row(rows[n], "session_measure"), str(rows[n]["session_measure_missing"]))
        for n in MEASURES
        if n in rows
    )
