"""List of visits: searched, filtered, a page at a time, each with its index, its trend and its state.

Plain SQL with arguments: user input is never part of a statement, and a page of 50,000 visits is one query for the
numbers and a few for the rows that are shown (`python -m research.benchmarks.visit_list`).
"""

# Names of tables are DataJoint's own, quoted, and every value is an argument.
# ruff: noqa: S608

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterable, Sequence
from typing import Any

from pbl_pipeline.change import Result, change_since, visit_before
from pbl_pipeline.filming import Difference
from pbl_pipeline.qc import OUTCOMES as CHECK_OUTCOMES
from pbl_pipeline.records import names, number
from pbl_pipeline.results.index import WITH_ERROR, Gdi

from .. import computed_tables, fit, gdi, qc, session, study, tracking, video
from ..decisions.review_decisions import accepted_sql, is_accepted
from ..job_errors import error_code
from ..operations.catalog import quote
from ..review import Decision
from ..rows import grouped, inside, parts
from .filming import filming_of
from .status import queue_name, queues

#: Visits of a page.
PAGE = 50
#: States of a visit to filter by. empty: no one was found in its usable videos; unusable: it has no usable video;
#: unrecorded: it has none.
STATES = ("computed", "pending", "waiting", "failed", "empty", "unusable", "unrecorded")
#: State of a visit in a folder without its measures.
INCOMPLETE = "incomplete"
#: Outcomes of the checks that can be asked for.
OUTCOMES = (*CHECK_OUTCOMES, "ACCEPTED")
#: Checks (q) of measures (g).
_WITH_ERROR = names(Gdi, "session_gdi", only=WITH_ERROR)
_RESULT = ("fit_set", "fit_method", "gait_method", "gdi_method", "norm")
_SAME_RESULT = " AND ".join(f"q.{k} = g.{k}" for k in _RESULT)
#: Methods of a set's recordings.
_DETECTION = ("tracking_method", "keypoint_method")
#: Stands for the day of a visit without one: before all others.
_NO_DAY = "0001-01-01"


@dataclasses.dataclass(frozen=True)
class Filter:
    """A request for visits; empty: everything. search: part of a person's code or of a visit's label. `state`: one of
    `STATES`, `quality`: one of `OUTCOMES`."""

    search: str = ""
    cohort: str = ""
    role: str = ""
    quality: str = ""
    state: str = ""
    first_day: datetime.date | None = None
    last_day: datetime.date | None = None


@dataclasses.dataclass(frozen=True)
class Trend:
    """Change of the index against the visit before (`visit_before`); sure, least and differs as in `Change`."""

    session_id: int
    day: datetime.date | None
    label: str
    change: float
    sure: bool | None
    least: float | None = None
    differs: tuple[Difference, ...] = ()


@dataclasses.dataclass(frozen=True)
class VisitRow:
    """A visit of the list.

    state: one of `STATES` or `INCOMPLETE`; problem: code of the error where it, or a part of it, failed; more: further
    results of other chains of methods or kinds of recordings.
    """

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

    `after`: `Page.after` of the page before: a day (ISO) and a number. None: the first page.
    """
    joins, where, args = _asked(wanted)
    if after is not None:
        # The day of a visit may be unknown, which compares with nothing.
        where.append("(COALESCE(s.session_date, %s), s.session_id) < (%s, %s)")
        args += [_NO_DAY, after[0], int(after[1])]
    # Where nothing is joined, to count apart is quicker than to keep all rows for it.
    counted = ", COUNT(*) OVER ()" if joins and after is None else ""
    rows = _ask(
        f"SELECT {_VISIT}{counted} FROM {_visits()} {' '.join(joins)}{_all(where)}"
        " ORDER BY s.session_date DESC, s.session_id DESC LIMIT %s",
        [*args, size + 1],
    )
    shown = rows[:size]
    last = shown[-1] if len(rows) > size else None
    total = None
    if after is None:
        of_all = f"SELECT COUNT(*) FROM {_visits(wanted.role != '')}{_all(where)}"
        total = (int(rows[0][5]) if rows else 0) if joins else int(_ask(of_all, args)[0][0])
    return Page(_visit_rows(shown), None if last is None else (str(last[3] or _NO_DAY), int(last[0])), total)


def visits_of(subject: str) -> tuple[VisitRow, ...]:
    """Return all visits of a person, newest first."""
    newest_first = "ORDER BY s.session_date DESC, s.session_id DESC"
    rows = _ask(f"SELECT {_VISIT} FROM {_visits()} WHERE s.subject = %s {newest_first}", [subject])
    return _visit_rows(rows)


def choices() -> dict[str, list[str]]:
    """Cohorts and roles that a list can be filtered by."""
    cohorts = _ask(f"SELECT cohort FROM {_name(study.Cohort)} ORDER BY cohort", [])
    roles = _ask(f"SELECT DISTINCT visit_role FROM {_name(study.Visit)}", [])
    by_time = sorted((str(r) for (r,) in roles), key=lambda r: (study.role_days(r) is None, study.role_days(r) or 0, r))
    return {"cohort": [str(c) for (c,) in cohorts], "role": by_time}


def earlier_result(session_id: int) -> Result | None:
    """Return the newest result of a part of the recordings that a current set of the visit has; None without one."""
    videos = fit.FitSet.Video & (fit.FitSet & {"session_id": session_id}).proj()
    of_sets = grouped((row["fit_set"], int(row["video_id"])) for row in videos.proj().to_dicts())
    members = {name: set(own) for name, own in of_sets.items()}
    now = [members[name] for name in set((fit.current() & inside("fit_set", members)).to_arrays("fit_set"))]
    older = [name for name, own in members.items() if any(own < every for every in now)]
    return next(iter(results_of([session_id], older)[session_id]), None) if older else None


def results_of(sessions: Iterable[int], sets: Sequence[str] = ()) -> dict[int, list[Result]]:
    """Results of the current sets of visits, or of `sets`, by session: videos of one camera first, then the newest
    methods."""
    ids = dict.fromkeys(int(s) for s in sessions)
    return {i: of for some in parts(ids) for i, of in _results_of(some, sets).items()}


def _results_of(ids: list[int], sets: Sequence[str]) -> dict[int, list[Result]]:
    found: dict[int, list[Result]] = {i: [] for i in ids}
    open_checks, videos = _open_checks(ids), _name(fit.FitSet.Video)
    rows = _ask(
        "SELECT f.session_id, f.fit_set, f.fit_set_kind, g.fit_method, g.gait_method, g.gdi_method, g.norm,"
        f" g.session_status, g.session_reason, g.session_gdi_reason, {', '.join(f'g.{c}' for c in _WITH_ERROR)},"
        " g.session_corrected, COALESCE(q.qc_outcome, ''), COALESCE(q.qc_worst, ''),"
        f" {', '.join(f'(SELECT MIN(v.{k}) FROM {videos} v WHERE v.fit_set = f.fit_set)' for k in _DETECTION)}"
        f" FROM {_name(fit.FitSet)} f"
        f" JOIN {_name(fit.FitSelection)} c ON c.fit_set = f.fit_set"
        f" AND {f'c.fit_set IN ({_places(sets)})' if sets else 'c.fit_current = 1'}"
        f" JOIN {_name(gdi.SessionGdi)} g ON g.fit_set = c.fit_set AND g.fit_method = c.fit_method"
        f" LEFT JOIN {_name(qc.SessionQc)} q ON {_SAME_RESULT}"
        f" WHERE f.session_id IN ({_places(ids)}) ORDER BY g.session_gdi_computed DESC",
        [*sets, *ids],
    )
    of_set = ("session_id", "fit_set", "fit_set_kind", "fit_method", "gait_method", "gdi_method", "norm")
    filmed = filming_of([dict(zip(of_set, row, strict=False)) for row in rows])
    for row, filming in zip(rows, filmed, strict=True):
        session_id, fit_set, kind, *four = row[:7]
        status, why, no_index, index, sd, change, corrected, outcome, worst, people, points = row[7:]
        methods = (str(four[0]), str(four[1]), str(four[2]), str(four[3]))
        checks = tuple(n for n in str(worst).split(", ") if n)
        if outcome == "WARN" and (left := open_checks.get((str(fit_set), *methods))) is not None:
            checks, outcome = tuple(n for n in checks if n in left), "WARN" if left else "ACCEPTED"
        found[int(session_id)].append(
            Result(
                str(kind),
                methods,
                str(status),
                str(why or no_index or ""),
                number(index),
                number(sd),
                number(change),
                str(outcome),
                checks,
                bool(corrected),
                filming,
                (str(people or ""), str(points or "")),
            )
        )
    return {i: sorted(r, key=lambda one: fit.KINDS.index(one.kind)) for i, r in found.items()}


def _open_checks(sessions: Iterable[int]) -> dict[tuple[str, ...], set[str]]:
    """Return the open checks (WARN, not accepted) of the results of these visits of which at least one was accepted
    since they were computed, by the key of the result."""
    decisions = (Decision & inside("session_id", sessions) & {"decision_what": "check"}).to_dicts()
    abouts = (row["decision_about"] for row in decisions)
    accepted = grouped((tuple(str(about[k]) for k in _RESULT), about) for about in abouts)
    checks: dict[tuple[str, ...], list[dict[str, Any]]] = {of: [] for of in accepted}
    asking = qc.SessionQc.Check * qc.SessionQc.proj("qc_computed") & {"qc_check_outcome": "WARN"}
    for row in (asking & inside("fit_set", {of[0] for of in accepted})).to_dicts():
        checks.get(tuple(str(row[k]) for k in _RESULT), []).append(row)
    found: dict[tuple[str, ...], set[str]] = {}
    for of, decided in accepted.items():
        rows = checks[of]
        if any(is_accepted(r, about) for r in rows for about in decided):
            found[of] = {r["qc_check"] for r in rows if not any(is_accepted(r, about) for about in decided)}
    return found


# --------------------------------------------------------------------------------------------------------- the filter
def _asked(wanted: Filter) -> tuple[list[str], list[str], list[Any]]:
    """Joins, conditions and their arguments, in this order.

    A set of visits is joined as a separate table: as a condition the server would look it up for each visit.
    """
    joins: list[str] = []
    where: list[str] = []
    of_joins: list[Any] = []
    of_where: list[Any] = []

    def only(name: str, visits: str, *values: Any) -> None:
        joins.append(f"JOIN ({visits}) {name} ON {name}.session_id = s.session_id")
        of_joins.extend(values)

    def add(condition: str, *values: Any) -> None:
        where.append(condition)
        of_where.extend(values)

    def beside(name: str, *visits: str) -> str:
        joins.append(f"LEFT JOIN ({' UNION '.join(visits)}) {name} ON {name}.session_id = s.session_id")
        return f"{name}.session_id IS NULL"

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
        only("j", f"{_judged()} WHERE q.qc_outcome = %s", "WARN" if wanted.quality == "ACCEPTED" else wanted.quality)
        if wanted.quality == "WARN":
            add(beside("a", _settled()))
        elif wanted.quality == "ACCEPTED":
            only("a", _settled())
    if wanted.state in ("computed", "pending"):
        apart, unfinished = (_waiting(), _empty(), _unusable()), (_unfinished(), _none_current())
        with_set = f"EXISTS (SELECT 1 FROM {_name(fit.FitSet)} p WHERE p.session_id = s.session_id)"
        if wanted.state == "computed":
            add(with_set)
            add(beside("o", *apart, *unfinished, _failed_visits()))
        else:
            add(f"NOT ({with_set} AND {beside('u', *unfinished)})")
            add(f"EXISTS (SELECT 1 FROM {_name(video.Video)} o WHERE o.session_id = s.session_id)")
            add(beside("o", *apart, _failed()))
    elif wanted.state:
        only("x", _STATES[wanted.state]())
    return joins, where, [*of_joins, *of_where]


def _judged() -> str:
    """Visits with a current set whose checks are computed."""
    return (
        f"SELECT DISTINCT f.session_id FROM {_name(qc.SessionQc)} q STRAIGHT_JOIN {_name(fit.FitSelection)} c"
        " ON c.fit_set = q.fit_set AND c.fit_method = q.fit_method AND c.fit_current = 1"
        f" STRAIGHT_JOIN {_name(fit.FitSet)} f ON f.fit_set = c.fit_set"
    )


def _settled() -> str:
    """Visits in which a person accepted every check that asked for attention, of all current results."""
    return (
        f"SELECT f.session_id FROM {_name(Decision)} e JOIN {_name(fit.FitSet)} f ON f.session_id = e.session_id"
        f" JOIN {_name(fit.FitSelection)} c ON c.fit_set = f.fit_set AND c.fit_current = 1"
        f" JOIN {_name(qc.SessionQc)} q ON q.fit_set = c.fit_set AND q.fit_method = c.fit_method"
        f" LEFT JOIN {_name(qc.SessionQc.Check)} k ON {' AND '.join(f'k.{n} = q.{n}' for n in _RESULT)}"
        " AND k.qc_check_outcome = 'WARN' WHERE e.decision_what = 'check' AND q.qc_outcome = 'WARN'"
        f" GROUP BY f.session_id HAVING MIN({accepted_sql('k', 'q', 'f')}) = 1"
    )


def _unfinished() -> str:
    """Visits with a current set whose checks are not computed yet."""
    return (
        f"SELECT DISTINCT f.session_id FROM {_name(fit.FitSelection)} c LEFT JOIN {_name(qc.SessionQc)} q"
        " ON q.fit_set = c.fit_set AND q.fit_method = c.fit_method"
        f" JOIN {_name(fit.FitSet)} f ON f.fit_set = c.fit_set WHERE q.fit_set IS NULL AND c.fit_current = 1"
    )


def _none_current() -> str:
    """Visits with sets of which none is current: one that was marked as not usable held up the others."""
    chosen, sets = _name(fit.FitSelection), _name(fit.FitSet)
    other = f"{sets} g JOIN {chosen} d ON d.fit_set = g.fit_set WHERE g.session_id = f.session_id AND d.fit_current = 1"
    return (
        f"SELECT DISTINCT f.session_id FROM {chosen} c STRAIGHT_JOIN {sets} f ON f.fit_set = c.fit_set"
        f" WHERE c.fit_current = 0 AND NOT EXISTS (SELECT 1 FROM {other})"
    )


def _waiting() -> str:
    """Visits with a video that waits for a person's choice."""
    videos, chosen = _name(video.Video), _name(tracking.SubjectChoice)
    waiting = f"{chosen} t JOIN {videos} o USING (video_id) WHERE t.choice_status = 'NEEDS_CHOICE'"
    return f"SELECT DISTINCT o.session_id FROM {waiting} AND {_is_usable('t')}"


def _empty() -> str:
    """Visits without a person in any of their usable videos."""
    videos, chosen = _name(video.Video), _name(tracking.SubjectChoice)
    without = f"SELECT t.video_id FROM {chosen} t WHERE t.choice_status = 'NO_PERSON' AND {_is_usable('t')}"
    some = f"SELECT b.session_id FROM {videos} b JOIN ({without}) c ON c.video_id = b.video_id"
    return (
        f"SELECT o.session_id FROM {videos} o LEFT JOIN ({without}) n ON n.video_id = o.video_id"
        f" WHERE o.session_id IN ({some}) AND {_is_usable('o')}"
        " GROUP BY o.session_id HAVING SUM(n.video_id IS NULL) = 0"
    )


def _unrecorded() -> str:
    """Visits without a video."""
    recorded = f"SELECT 1 FROM {_name(video.Video)} o WHERE o.session_id = n.session_id"
    return f"SELECT n.session_id FROM {_name(session.Session)} n WHERE NOT EXISTS ({recorded})"


def _failed_visits() -> str:
    """Visits with an error (`_failed`), without those that are computed and have an index of a current set: an error of
    one recording does not make such a visit fail."""
    indexed = (
        f"SELECT f.session_id FROM {_name(gdi.SessionGdi)} g JOIN {_name(fit.FitSelection)} c"
        " ON c.fit_set = g.fit_set AND c.fit_method = g.fit_method AND c.fit_current = 1"
        f" JOIN {_name(fit.FitSet)} f ON f.fit_set = c.fit_set WHERE g.session_gdi IS NOT NULL"
    )
    return (
        f"SELECT e.session_id FROM ({_failed()}) e LEFT JOIN ({indexed}) i ON i.session_id = e.session_id"
        f" LEFT JOIN ({_unfinished()}) u ON u.session_id = e.session_id"
        " WHERE i.session_id IS NULL OR u.session_id IS NOT NULL"
    )


def _unusable() -> str:
    """Visits whose videos are all marked as not usable."""
    videos, marked = _name(video.Video), _name(video.NotUsable)
    some = f"SELECT b.session_id FROM {marked} m JOIN {videos} b ON b.video_id = m.video_id"
    return (
        f"SELECT o.session_id FROM {videos} o LEFT JOIN {marked} n ON n.video_id = o.video_id"
        f" WHERE o.session_id IN ({some}) GROUP BY o.session_id HAVING SUM(n.video_id IS NULL) = 0"
    )


def _is_usable(alias: str) -> str:
    return f"NOT EXISTS (SELECT 1 FROM {_name(video.NotUsable)} u WHERE u.video_id = {alias}.video_id)"


def _failed(column: str = "") -> str:
    """Visits with an error row in any queue, of a usable video or a current set; with that column of it, a row for
    each."""
    parts = []
    there = queues(session.Session.connection)
    for table in computed_tables():
        if queue_name(table) not in there:
            continue
        jobs, names = quote(*queue_name(table)), table.heading.primary_key
        if "fit_set" in names:  # jobs of older sets do not count
            same = "c.fit_set = e.fit_set AND c.fit_method = e.fit_method AND c.fit_current = 1"
            of = f"{_name(fit.FitSet)} o USING (fit_set) JOIN {_name(fit.FitSelection)} c ON {same}"
            failed = f"{jobs} e JOIN {of} WHERE e.status = 'error'"
        else:
            of = f"{_name(video.Video)} o USING (video_id)"
            failed = f"{jobs} e JOIN {of} WHERE e.status = 'error' AND {_is_usable('e')}"
        parts.append(f"SELECT o.session_id{f', e.{column}' if column else ''} FROM {failed}")
    if not parts:
        return f"SELECT session_id{f', NULL AS {column}' if column else ''} FROM {_name(session.Session)} WHERE FALSE"
    return f" {'UNION ALL' if column else 'UNION'} ".join(parts)


_STATES = {
    "waiting": _waiting,
    "failed": _failed,
    "empty": _empty,
    "unusable": _unusable,
    "unrecorded": _unrecorded,
}


# ----------------------------------------------------------------------------------------------------- rows of a page
def _visit_rows(rows: Sequence[Sequence[Any]]) -> tuple[VisitRow, ...]:
    ids = [int(r[0]) for r in rows]
    if not ids:
        return ()
    people = sorted({str(r[1]) for r in rows})
    others = _ask(
        f"SELECT session_id, session_date, session_label, subject FROM {_name(session.Session)}"
        f" WHERE subject IN ({_places(people)}) ORDER BY session_date, session_id",
        people,
    )
    results = results_of(int(s) for s, *_ in others)
    indexed: dict[str, list[tuple[Any, Result]]] = {str(r[1]): [] for r in rows}
    for i, day, label, subject in others:
        indexed[str(subject)] += [((int(i), day, str(label)), r) for r in results[int(i)] if r.index is not None]
    listed = _places(ids)
    counted = f"SELECT session_id, COUNT(*) FROM {_name(video.Video)} WHERE session_id IN ({listed})"
    videos = dict(_ask(f"{counted} GROUP BY session_id", ids))
    waiting = {int(s) for (s,) in _ask(f"{_waiting()} AND o.session_id IN ({listed})", ids)}
    empty, unusable = (
        {int(s) for (s,) in _ask(f"SELECT session_id FROM ({question}) x WHERE session_id IN ({listed})", ids)}
        for question in (_empty(), _unusable())
    )
    open_sets = {int(s) for (s,) in _ask(f"{_unfinished()} AND f.session_id IN ({listed})", ids)}
    errors = f"SELECT session_id, error_message FROM ({_failed('error_message')}) x WHERE session_id IN ({listed})"
    failed = {int(s): error_code(message) for s, message in _ask(errors, ids)}
    sets = {"failed": failed, "waiting": waiting, "empty": empty, "unusable": unusable}
    out = []
    for session_id, subject, label, day, role, *_ in rows:
        i = int(session_id)
        found = results[i]
        computed = bool(found) and i not in open_sets
        of_visit = [name for name, visits in sets.items() if i in visits]
        if computed and any(r.index is not None for r in found):  # as `_failed_visits`
            of_visit = [name for name in of_visit if name != "failed"]
        state = next(iter(of_visit), "computed" if computed else "pending" if videos.get(i) else "unrecorded")
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
                trend=_trend(i, first, indexed[str(subject)]),
            )
        )
    return tuple(out)


def _trend(session_id: int, result: Result | None, indexed: Sequence[tuple[Any, Result]]) -> Trend | None:
    """`indexed`: number, day and label of the person's visits, in their order, with each result that has an index."""
    if result is None or result.index is None:
        return None
    at = next(i for i, (visit, _) in enumerate(indexed) if visit[0] == session_id)
    if (last := visit_before(result, indexed[:at])) is None or (change := change_since(result, last[1])) is None:
        return None
    number, day, label = last[0]
    return Trend(number, day, label, change.by, change.sure, change.least, change.differs)


# --------------------------------------------------------------------------------------------------------------- SQL
#: Columns of a visit (s) and what it is in a study (v).
_VISIT = "s.session_id, s.subject, s.session_label, s.session_date, COALESCE(v.visit_role, '')"


def _visits(with_role: bool = True) -> str:
    role = f" LEFT JOIN {_name(study.Visit)} v ON v.session_id = s.session_id" if with_role else ""
    return f"{_name(session.Session)} s{role}"


def _ask(sql: str, args: Sequence[Any]) -> list[tuple[Any, ...]]:
    return list(session.Session.connection.query(sql, args=tuple(args)).fetchall())


def _name(table: Any) -> str:
    return str(table.full_table_name)


def _places(values: Sequence[Any]) -> str:
    return ", ".join(["%s"] * len(values))


def _all(where: Sequence[str]) -> str:
    return f" WHERE {' AND '.join(where)}" if where else ""
