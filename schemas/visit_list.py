"""A list of visits to look through: searched, filtered, a page at a time, each with its index, its trend and its state.

Plain SQL with arguments: what a person types is never part of a statement, and a page of 50,000 visits is one question
for the numbers and a few for the rows that are shown (`python -m tests.benchmarks.visit_list`).
"""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from . import computed_tables, fit, gdi, lab, qc, session, study, tracking, video
from .catalog import quote
from .coded_errors import error_code
from .rows import number
from .status import queue_name

#: Visits of a page.
PAGE = 50
#: What is asked of the state of a visit.
STATES = ("computed", "pending", "waiting", "failed")
#: Outcomes of the checks that can be asked for.
OUTCOMES = ("PASS", "WARN", "EMPTY", "NEEDS_CHOICE", "FAIL")
#: Checks (q) of measures (g).
_SAME_RESULT = " AND ".join(f"q.{k} = g.{k}" for k in ("fit_set", "fit_method", "gait_method", "gdi_method", "norm"))
#: Stands for the day of a visit without one: before all others.
_NO_DAY = "0001-01-01"


@dataclasses.dataclass(frozen=True)
class Filter:
    """What is asked for; empty: everything. search: part of a person's code or of a visit's label. `state`: one of
    `STATES`, `quality`: one of `OUTCOMES`."""

    search: str = ""
    cohort: str = ""
    role: str = ""
    quality: str = ""
    state: str = ""
    first_day: datetime.date | None = None
    last_day: datetime.date | None = None


@dataclasses.dataclass(frozen=True)
class Result:
    """Index and checks of the current set of a visit by one chain of methods.

    sd: of the error of the index; minimal_change: smallest change between two such visits that is no chance (90 %).
    outcome: worst check, empty before the checks are computed; worst: its names.
    """

    kind: str
    methods: tuple[str, str, str, str]
    status: str
    reason: str
    index: float | None
    sd: float | None
    minimal_change: float | None
    outcome: str
    worst: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Trend:
    """The index against the visit before of the same person, by the same chain of methods. sure: the change is at least
    the larger of the two minimal changes; None where these are not known."""

    session_id: int
    day: datetime.date | None
    change: float
    sure: bool | None


@dataclasses.dataclass(frozen=True)
class VisitRow:
    """A visit of the list. state: one of `STATES`; problem: code of the error where it failed. more: further results of
    other chains of methods or kinds of recordings."""

    session_id: int
    subject: str
    label: str
    day: datetime.date | None
    role: str
    videos: int
    state: str
    problem: str
    result: Result | None
    more: int
    trend: Trend | None


@dataclasses.dataclass(frozen=True)
class Page:
    """Visits, newest first. after: where the next page begins, None on the last one. total: visits that the filter lets
    through; counted on the first page only, else None."""

    visits: tuple[VisitRow, ...]
    after: tuple[str, int] | None
    total: int | None


def visit_page(wanted: Filter, after: tuple[str, int] | None = None, size: int = PAGE) -> Page:
    """A page of the visits that `wanted` lets through, newest day first, then highest number.

    Parameters
    ----------
    wanted
        The filter.
    after
        `Page.after` of the page before: a day (ISO) and a number. None: the first page.
    size
        Visits of a page.
    """
    where, args = _where(wanted)
    total = None if after is not None else _count(where, args)
    if after is not None:
        # As two ranges: the day of a visit may be unknown, which compares with nothing.
        where.append("(COALESCE(s.session_date, %s), s.session_id) < (%s, %s)")
        args += [_NO_DAY, after[0], int(after[1])]
    rows = _ask(
        f"SELECT s.session_id, s.subject, s.session_label, s.session_date, COALESCE(v.visit_role, '')"
        f" FROM {_name(session.Session)} s LEFT JOIN {_name(study.Visit)} v USING (session_id)"
        f"{_all(where)} ORDER BY s.session_date DESC, s.session_id DESC LIMIT %s",
        [*args, size + 1],
    )
    shown = rows[:size]
    visits = _visit_rows(shown)
    last = shown[-1] if len(rows) > size else None
    return Page(visits, None if last is None else (str(last[3] or _NO_DAY), int(last[0])), total)


def visits_of(subject: str) -> tuple[VisitRow, ...]:
    """All visits of a person, newest first."""
    rows = _ask(
        f"SELECT s.session_id, s.subject, s.session_label, s.session_date, COALESCE(v.visit_role, '')"
        f" FROM {_name(session.Session)} s LEFT JOIN {_name(study.Visit)} v USING (session_id)"
        " WHERE s.subject = %s ORDER BY s.session_date DESC, s.session_id DESC",
        [subject],
    )
    return _visit_rows(rows)


def choices() -> dict[str, list[str]]:
    """Cohorts and roles that a list can be filtered by."""
    cohorts = _ask(f"SELECT cohort FROM {_name(study.Cohort)} ORDER BY cohort", [])
    roles = _ask(f"SELECT DISTINCT visit_role FROM {_name(study.Visit)}", [])
    by_time = sorted((str(r) for (r,) in roles), key=lambda r: (study.role_days(r) is None, study.role_days(r) or 0, r))
    return {"cohort": [str(c) for (c,) in cohorts], "role": by_time}


def results_of(sessions: Iterable[int]) -> dict[int, list[Result]]:
    """Results of the current sets of visits, by session: videos of one camera first, then the newest methods."""
    ids = [int(s) for s in sessions]
    found: dict[int, list[Result]] = {i: [] for i in ids}
    if not ids:
        return found
    order = {fit.SINGLE: 0, fit.RIG: 1, fit.MARKERS: 2}
    rows = _ask(
        "SELECT f.session_id, f.fit_set_kind, g.fit_method, g.gait_method, g.gdi_method, g.norm, g.session_status,"
        " g.session_reason, g.session_gdi_reason, g.session_gdi, g.session_gdi_sd, g.session_gdi_minimal_change,"
        " COALESCE(q.qc_outcome, ''), COALESCE(q.qc_worst, '')"
        f" FROM {_name(fit.FitSet)} f"
        f" JOIN {_name(fit.FitSelection)} c ON c.fit_set = f.fit_set AND c.fit_current = 1"
        f" JOIN {_name(gdi.SessionGdi)} g ON g.fit_set = c.fit_set AND g.fit_method = c.fit_method"
        f" LEFT JOIN {_name(qc.SessionQc)} q ON {_SAME_RESULT}"
        f" WHERE f.session_id IN ({_places(ids)}) ORDER BY g.session_gdi_computed DESC",
        ids,
    )
    for session_id, kind, fit_method, gait_method, model, norm, status, why, no_index, *values, outcome, worst in rows:
        index, sd, change = (number(v) for v in values)
        methods = (str(fit_method), str(gait_method), str(model), str(norm))
        names = tuple(n for n in str(worst).split(", ") if n)
        reason = str(why or no_index or "")
        found[int(session_id)].append(
            Result(str(kind), methods, str(status), reason, index, sd, change, str(outcome), names)
        )
    return {i: sorted(r, key=lambda one: order.get(one.kind, 9)) for i, r in found.items()}


# --------------------------------------------------------------------------------------------------------- the filter
def _where(wanted: Filter) -> tuple[list[str], list[Any]]:
    where: list[str] = []
    args: list[Any] = []

    def add(condition: str, *values: Any) -> None:
        where.append(condition)
        args.extend(values)

    if wanted.search:
        like = "%" + wanted.search.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%"
        # Codes compare with capitals; who searches need not.
        add("(LOWER(s.subject) LIKE LOWER(%s) OR LOWER(s.session_label) LIKE LOWER(%s))", like, like)
    if wanted.cohort:
        member = f"SELECT m.subject FROM {_name(study.CohortMember)} m WHERE m.cohort = %s AND m.member_included = 1"
        add(f"s.subject IN ({member})", wanted.cohort)
    if wanted.role:
        add("v.visit_role = %s", wanted.role)
    if wanted.first_day:
        add("s.session_date >= %s", wanted.first_day)
    if wanted.last_day:
        add("s.session_date <= %s", wanted.last_day)
    if wanted.quality:
        add(f"s.session_id IN (SELECT f.session_id FROM {_judged()} WHERE q.qc_outcome = %s)", wanted.quality)
    if wanted.state:
        _add_state(wanted.state, add)
    return where, args


def _add_state(state: str, add: Any) -> None:
    waits = f"s.session_id IN ({_waiting()})"
    failed = _failed()
    fails = f"s.session_id IN ({failed})" if failed else "FALSE"
    done = f"s.session_id IN (SELECT f.session_id FROM {_judged()})"
    if state == "waiting":
        add(waits)
    elif state == "failed":
        add(fails)
    elif state == "computed":
        add(f"{done} AND NOT ({waits} OR {fails})")
    else:  # pending
        add(f"NOT ({done} OR {waits} OR {fails})")


def _judged() -> str:
    """Current sets whose checks are computed."""
    return (
        f"{_name(qc.SessionQc)} q JOIN {_name(fit.FitSelection)} c"
        " ON c.fit_set = q.fit_set AND c.fit_method = q.fit_method AND c.fit_current = 1"
        f" JOIN {_name(fit.FitSet)} f ON f.fit_set = c.fit_set"
    )


def _waiting() -> str:
    """Visits with a video that waits for a person's choice."""
    return (
        f"SELECT w.session_id FROM {_name(tracking.SubjectChoice)} t JOIN {_name(video.Video)} w USING (video_id)"
        " WHERE t.choice_status = 'NEEDS_CHOICE'"
    )


def _failed(columns: str = "session_id") -> str:
    """Visits with an error row in any queue. Empty where no queue was ever used."""
    parts = []
    there = _queues()
    for table in computed_tables():
        if queue_name(table) not in there:
            continue
        jobs, names = quote(*queue_name(table)), table.heading.primary_key
        error = ", e.error_message" if columns != "session_id" else ""
        if "fit_set" in names:
            of = f"{_name(fit.FitSet)} o USING (fit_set)"
        else:
            of = f"{_name(video.Video)} o USING (video_id)"
        parts.append(f"SELECT o.session_id{error} FROM {jobs} e JOIN {of} WHERE e.status = 'error'")
    return " UNION ALL ".join(parts)


def _queues() -> set[tuple[str, str]]:
    rows = _ask("SELECT table_schema, table_name FROM information_schema.tables WHERE table_name LIKE '~~%%'", [])
    return {(str(schema), str(name)) for schema, name in rows}


def _count(where: Sequence[str], args: Sequence[Any]) -> int:
    of_role = any("v.visit_role" in w for w in where)
    visit = f" JOIN {_name(study.Visit)} v USING (session_id)" if of_role else ""
    return int(_ask(f"SELECT COUNT(*) FROM {_name(session.Session)} s{visit}{_all(where)}", list(args))[0][0])


# ----------------------------------------------------------------------------------------------------- rows of a page
def _visit_rows(rows: Sequence[Sequence[Any]]) -> tuple[VisitRow, ...]:
    ids = [int(r[0]) for r in rows]
    if not ids:
        return ()
    people = sorted({str(r[1]) for r in rows})
    others = _ask(
        f"SELECT session_id, subject, session_date FROM {_name(session.Session)} WHERE subject IN ({_places(people)})",
        people,
    )
    results = results_of(int(s) for s, _, _ in others)
    of_person: dict[str, list[tuple[datetime.date, int]]] = {}
    for session_id, subject, day in others:
        if day is not None:
            of_person.setdefault(str(subject), []).append((day, int(session_id)))
    listed = _places(ids)
    videos = dict(_ask(f"SELECT session_id, COUNT(*) FROM {_name(video.Video)} WHERE session_id IN ({listed})"
                       " GROUP BY session_id", ids))  # fmt: skip
    waiting = {int(s) for (s,) in _ask(f"{_waiting()} AND w.session_id IN ({listed})", ids)}
    failed: dict[int, str] = {}
    if errors := _failed("with the error"):
        of_page = f"SELECT session_id, error_message FROM ({errors}) x WHERE session_id IN ({listed})"
        failed = {int(s): error_code(message) for s, message in _ask(of_page, ids)}
    out = []
    for session_id, subject, label, day, role in rows:
        i = int(session_id)
        found = results[i]
        computed = any(r.outcome for r in found)
        state = "failed" if i in failed else "waiting" if i in waiting else "computed" if computed else "pending"
        first = found[0] if found else None
        out.append(
            VisitRow(
                session_id=i,
                subject=str(subject),
                label=str(label),
                day=day,
                role=str(role),
                videos=int(videos.get(i, 0)),
                state=state,
                problem=failed.get(i, ""),
                result=first,
                more=max(0, len(found) - 1),
                trend=_trend(first, day, of_person.get(str(subject), []), results),
            )
        )
    return tuple(out)


def _trend(
    result: Result | None,
    day: datetime.date | None,
    of_person: Sequence[tuple[datetime.date, int]],
    results: Mapping[int, Sequence[Result]],
) -> Trend | None:
    if result is None or result.index is None or day is None:
        return None
    for before, session_id in sorted(of_person, reverse=True):
        if before >= day:
            continue
        for other in results[session_id]:
            if (other.kind, other.methods) == (result.kind, result.methods) and other.index is not None:
                change = result.index - other.index
                least = [m for m in (result.minimal_change, other.minimal_change) if m is not None]
                sure = abs(change) >= max(least) if len(least) == 2 else None
                return Trend(session_id, before, change, sure)
    return None


# --------------------------------------------------------------------------------------------------------------- SQL
def _ask(sql: str, args: Sequence[Any]) -> list[tuple[Any, ...]]:
    return list(session.Session.connection.query(sql, args=tuple(args)).fetchall())


def _name(table: Any) -> str:
    return str(table.full_table_name)


def _places(values: Sequence[Any]) -> str:
    return ", ".join(["%s"] * len(values))


def _all(where: Sequence[str]) -> str:
    return f" WHERE {' AND '.join(where)}" if where else ""
