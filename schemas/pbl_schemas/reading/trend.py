"""Visits of a person in time: the index or a measure of each, with its interval and changes."""

from __future__ import annotations

import dataclasses
import datetime
from typing import TYPE_CHECKING, Any

from pbl_pipeline.change import INDEX, Change, Result, change_of, usual_chain, visit_before
from pbl_pipeline.errors import PblError
from pbl_pipeline.words import MEASURES

from .. import session, video
from .shown import shown_visit
from .visit_list import results_of, visits_of

if TYPE_CHECKING:
    from pbl_pipeline.gait import Measure


@dataclasses.dataclass(frozen=True)
class Point:
    """The value of a visit.

    value: None if it is not known, for the reason. bounds: its 90 % interval, of its whole error where error and
    least, its minimal detectable change, are known, else of the spread of its cycles or repetitions alone. before: the
    change since the visit before (`visit_before`); first: since the first one with a value.
    """

    session_id: int
    label: str
    day: datetime.date | None
    role: str
    value: float | None = None
    bounds: tuple[float, float] | None = None
    left: float | None = None
    right: float | None = None
    reason: str = ""
    error: float | None = None
    least: float | None = None
    before: Change | None = None
    first: Change | None = None


@dataclasses.dataclass(frozen=True)
class Trend:
    """The visits of a person, the earliest first, by the chain of methods that most of them have.

    measure: the one that is shown; measures: all that can be, of tasks as "ACTIVITY.MEASURE"; left_out: labels of the
    visits without a result of this chain.
    """

    subject: str
    measure: str
    measures: tuple[str, ...]
    methods: tuple[str, ...]
    points: tuple[Point, ...]
    left_out: tuple[str, ...]


def trend_of(session_id: int, measure: str = INDEX) -> Trend:
    """Return all visits of the person of a visit. Raises `PblError` DB_NOT_FOUND for an unknown visit, USAGE for an
    unknown measure."""
    from pbl_pipeline.gait import TASK_MEASURES

    subject = str(session.registered_visit(session_id)["subject"])
    done = set((video.Video * session.Session & {"subject": subject}).to_arrays("activity"))
    known = (INDEX, *MEASURES, *(f"{a}.{n}" for a, names in TASK_MEASURES.items() if a in done for n in names))
    if measure not in known:
        raise PblError(
            "USAGE",
            found=f"the measure '{measure[:40]}'" if measure else "no measure",
            expected=f"a measure: {', '.join(known)}",
            next_step="choose one on the page",
        )
    rows = visits_of(subject)[::-1]
    results = results_of(v.session_id for v in rows)
    usual = usual_chain(results)
    points: list[Point] = []
    with_value: list[tuple[Measure | None, Result]] = []
    left_out: list[str] = []
    for v in rows:
        at = next((i for i, r in enumerate(results[v.session_id]) if r.chain == usual), None)
        if at is None:
            left_out.append(v.label)
            continue
        result, found, reason = results[v.session_id][at], None, ""
        if measure != INDEX:
            found, reason = shown_visit(v.session_id, at).all_measures.get(measure, (None, ""))
        point = Point(v.session_id, v.label, v.day, v.role, **_value(measure, result, found, reason))
        if point.value is not None:
            if (last := visit_before(result, with_value)) is not None:
                since = [change_of(measure, result, r, found, old) for old, r in (last, with_value[0])]
                point = dataclasses.replace(point, before=since[0], first=since[1])
            with_value.append((found, result))
        points.append(point)
    return Trend(subject, measure, known, usual or (), tuple(points), tuple(left_out))


def _value(measure: str, result: Result, found: Measure | None, reason: str) -> dict[str, Any]:
    from pbl_pipeline.gait import interval_90

    if measure == INDEX:
        return {"value": result.index, "bounds": interval_90(result.index, result.sd), "reason": result.reason}
    if found is None:
        return {"reason": reason}
    sides = {"left": found.left, "right": found.right}
    return {"value": found.mean, "bounds": found.interval, **sides, "error": found.errors[0], "least": found.errors[1]}
