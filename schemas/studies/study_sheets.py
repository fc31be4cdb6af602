"""Visits, scores, cohorts and trials of a study from sheets: what `pbl study import` does (docs/files.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from .. import lab, session, study, video
from ..codes import check_subject, day_of, folded
from ..intake.conditions import set_condition
from ..intake.sheets import Row, Sheet, date_of, needed, number_of, read_sheets, refused
from ..rows import inside, utc_now
from ..transactions import in_transaction, next_id

#: Column of a sheet -> column of `study.Visit`.
VISIT_COLUMNS = {
    "role": "visit_role",
    "days": "visit_days",
    "age": "visit_age",
    "intervention": "intervention",
    "intervention_date": "intervention_date",
    "assistive_device": "assistive_device",
    "orthosis": "orthosis",
    "note": "visit_note",
}
MEMBER_COLUMNS = {"group": "member_group", "included": "member_included", "reason": "member_reason"}
_DATED = ("date", "birth_date")
COLUMNS = ("subject", "visit", *_DATED, *VISIT_COLUMNS, "population", "record", "cohort", *MEMBER_COLUMNS)
SCORE_COLUMNS = ("subject", "visit", "instrument", "value")
TRIAL_COLUMNS = ("video", "subject", "visit", "activity", "pace")
#: A cell that removes what is stored; an empty one leaves it.
CLEAR = "-"
_LONGEST = {"note": 1000, "reason": 255, "intervention": 64, "assistive_device": 64, "orthosis": 64}
_YES, _NO = ("yes", "true", "1", "in"), ("no", "false", "0", "out")


@dataclasses.dataclass
class Line:
    """A row of a sheet: what it changes, in words (nothing: it is stored already), or why it is refused."""

    where: str
    changes: list[str] = dataclasses.field(default_factory=list)
    errors: list[PblError] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True)
class Imported:
    """Every row of the sheets. done: whether the changes were made, which is when no row is refused."""

    lines: list[Line]
    done: bool

    @property
    def errors(self) -> list[PblError]:
        """Why rows are refused."""
        return [e for line in self.lines for e in line.errors]


def import_sheets(paths: Sequence[Path], dry_run: bool = False, distinct_codes: bool = False) -> Imported:
    """Bring the tables to what sheets say, all of them in one transaction: nothing is changed where a row is refused.

    Empty cells leave what is stored, "-" removes it. Rows that are stored as they stand change nothing.

    Parameters
    ----------
    dry_run
        Change nothing; return what would be done.
    distinct_codes
        Codes that differ only in case, zeros or hyphens are different people.

    Raises
    ------
    PblError
        FILE_MISSING, SHEET_FORMAT for a sheet that cannot be read. What is wrong with a row is in the result.
    """
    sheets = [sheet for path in paths for sheet in read_sheets(path)]
    return in_transaction(lambda: import_rows(sheets, dry_run, distinct_codes))


def import_rows(sheets: Sequence[Sheet], dry_run: bool = False, distinct_codes: bool = False) -> Imported:
    """As `import_sheets`, of sheets that were read, inside a transaction of the caller."""
    plan = _Plan(sheets, distinct_codes)
    lines = list(plan.lines.values())
    done = not dry_run and not any(line.errors for line in lines)
    if done:
        plan.apply()
    return Imported(lines, done)


@dataclasses.dataclass
class _Stated:
    """What the sheets say of a visit, score, ...: the values, and the first row that says it."""

    row: Row
    values: dict[str, Any]


class _Plan:
    """What sheets state, compared with the tables."""

    def __init__(self, sheets: Sequence[Sheet], distinct_codes: bool) -> None:
        self.lines: dict[str, Line] = {}
        self.people: dict[str, _Stated] = {}
        self.sessions: dict[tuple[str, str], _Stated] = {}
        self.visits: dict[tuple[str, str], _Stated] = {}
        self.members: dict[tuple[str, str], _Stated] = {}
        self.scores: dict[tuple[str, str, str], _Stated] = {}
        self.trials: list[_Stated] = []
        self.instruments = {r["instrument"]: r for r in study.ClinicalInstrument().to_dicts()}
        self.births: dict[str, tuple[str, datetime.date]] = {}
        self.records: dict[str, str] = {}
        for sheet in sheets:
            self._read(sheet)
        self._load()
        self._check_codes(distinct_codes)
        self._check_times()
        self._compare()

    # ------------------------------------------------------------------------------------------------------- reading
    @contextlib.contextmanager
    def _row(self, row: Row) -> Iterator[Line]:
        """An error in the block is one of the row."""
        line = self.lines.setdefault(row.where, Line(row.where))
        try:
            yield line
        except PblError as error:
            line.errors.append(_about(error, row.where))

    def _read(self, sheet: Sheet) -> None:
        names = {c.lower().replace(" ", "_"): c for c in sheet.columns}
        kind = TRIAL_COLUMNS if "video" in names else SCORE_COLUMNS if "instrument" in names else COLUMNS
        known = {names[c]: c for c in kind if c in names}
        wide = [c for c in sheet.columns if c in self.instruments and kind is COLUMNS]
        unknown = [c for c in sheet.columns if c not in known and c not in wide]
        if unknown:
            scores = f"; or a clinical score: {', '.join(self.instruments)}" if kind is COLUMNS else ""
            raise refused(
                sheet.name,
                f"unknown column {', '.join(map(repr, unknown[:5]))}",
                f"columns of {', '.join(kind)}{scores}",
                "rename or remove it; a score of your own is a row of ClinicalInstrument first",
            )
        read = {TRIAL_COLUMNS: self._trial, SCORE_COLUMNS: self._long_score, COLUMNS: self._visit}[kind]
        for row in sheet.rows:
            cells = {known.get(c, c): v for c, v in row.cells.items()}
            with self._row(row):
                read(Row(row.where, cells))

    def _person(self, row: Row) -> str:
        code = needed(row, "subject")
        check_subject(code, "write the code of the person")
        stated = self.people.setdefault(code, _Stated(row, {}))
        if population := row.cells.get("population"):
            check_label("population", population, 32)
            _same(stated.values.setdefault("population", population), population, "population", code)
        return code

    def _session(self, row: Row, code: str) -> tuple[str, str]:
        label = needed(row, "visit")
        check_label("visit", label, 64, 1)
        stated = self.sessions.setdefault((code, label), _Stated(row, {}))
        day = day_of(label)
        if "date" in row.cells:
            date = date_of(row, "date")
            _same(day or date, date, "date of the visit", f"{code}, {label}")
            _same(stated.values.setdefault("session_date", date), date, "date of the visit", f"{code}, {label}")
        return code, label

    def _visit(self, row: Row) -> None:
        cells = row.cells
        code = self._person(row)
        self._identity(row, code)
        if "cohort" in cells or {*MEMBER_COLUMNS} & {*cells}:
            self._member(row, code)
        scores = [c for c in cells if c in self.instruments]
        stated = {c for c in VISIT_COLUMNS if c in cells}
        if not scores and not stated and not ({"visit", "date"} & {*cells}):
            return
        key = self._session(row, code)
        if stated:
            if key in self.visits:
                raise _conflict(
                    f"visit {key[1]} of {code} also in {self.visits[key].row.where}",
                    "one row for each visit of a person",
                    "remove one, or correct its label",
                )
            self.visits[key] = _Stated(row, {VISIT_COLUMNS[c]: _visit_value(row, c) for c in stated})
        for name in scores:
            self._score(row, key, name, cells[name])

    def _identity(self, row: Row, code: str) -> None:
        """Compare what identifies a person, and store none of it."""
        if record := row.cells.get("record"):
            _one_person(self.records.setdefault(record, code), code, f"record {record}")
            mine = [r for r, c in self.records.items() if c == code]
            if len(mine) > 1:
                raise _conflict(f"{len(mine)} records of {code}", "one record for a person", "correct code or record")
        if "birth_date" in row.cells:
            text = row.cells["birth_date"]
            day = (
                datetime.date(int(text), 7, 1) if re.fullmatch(r"(18|19|20)\d\d", text) else date_of(row, "birth_date")
            )
            _same(self.births.setdefault(code, (text, day))[0], text, "birth date", code)

    def _member(self, row: Row, code: str) -> None:
        cohort = needed(row, "cohort")
        check_label("cohort", cohort, 32, 1)
        stated = self.members.setdefault((cohort, code), _Stated(row, {}))
        for column, name in MEMBER_COLUMNS.items():
            if column not in row.cells:
                continue
            value: Any = row.cells[column]
            if column == "included":
                value = _flag(row, column)
            else:
                check_label(column, value, _LONGEST.get(column, 32))
            _same(stated.values.setdefault(name, value), value, f"{column} in {cohort}", code)

    def _long_score(self, row: Row) -> None:
        key = self._session(row, self._person(row))
        self._score(row, key, needed(row, "instrument"), needed(row, "value"))

    def _score(self, row: Row, key: tuple[str, str], name: str, text: str) -> None:
        if name not in self.instruments:
            raise refused(
                row.where,
                f"instrument {name!r}",
                f"one of {', '.join(self.instruments)}",
                "correct the name, or insert your own into ClinicalInstrument first",
            )
        value = None if text == CLEAR else number_of(row, name, text)
        if value is not None:
            study.check_score(value, self.instruments[name], row.where)
        if (other := self.scores.get((*key, name))) is not None:
            raise _conflict(
                f"{name} of {key[0]}, {key[1]} also in {other.row.where}",
                "each score of a visit once",
                "remove one, or correct the label of its visit",
            )
        self.scores[(*key, name)] = _Stated(row, {"score_value": value})

    def _trial(self, row: Row) -> None:
        values = {k: row.cells[k] for k in ("activity", "pace") if k in row.cells}
        for name, text in values.items():
            check_label(name, text, 32)
        self.trials.append(_Stated(row, {**values, "video_id": _video(row)}))

    # ------------------------------------------------------------------------------------------------------- the tables
    def _load(self) -> None:
        codes = {*self.people, *(c for _, c in self.members)}
        of_people = inside("subject", codes)
        self.known = {r["subject"]: r for r in lab.Subject.proj("population").to_dicts()}
        rows = (session.Session & of_people).to_dicts()
        self.registered = {(r["subject"], r["session_label"]): r for r in rows}
        ids = session.Session & of_people
        labels = {int(r["session_id"]): key for key, r in self.registered.items()}
        self.stored_visits = {labels[int(r["session_id"])]: r for r in (study.Visit & ids.proj()).to_dicts()}
        self.stored_scores = {
            (*labels[int(r["session_id"])], r["instrument"]): r["score_value"]
            for r in (study.ClinicalScore & ids.proj()).to_dicts()
        }
        members = (study.CohortMember & of_people).to_dicts()
        self.stored_members = {
            (r["cohort"], r["subject"]): {**r, "member_included": bool(r["member_included"])} for r in members
        }
        self.cohorts = set(study.Cohort().to_arrays("cohort"))

    def _check_codes(self, distinct: bool) -> None:
        if distinct:
            return
        alike: dict[str, set[str]] = defaultdict(set)
        for code in {*self.known, *self.people}:
            alike[folded(code)].add(code)
        for code, stated in self.people.items():
            others = sorted(alike[folded(code)] - {code})
            if others and (code not in self.known or any(o not in self.known for o in others)):
                with self._row(stated.row):
                    raise _conflict(
                        f"the codes {code} and {', '.join(others)}",
                        "one code for one person",
                        "write the same code; if they are different people, repeat with --distinct-codes",
                    )

    def _day(self, key: tuple[str, str]) -> datetime.date | None:
        stated = self.sessions[key].values.get("session_date") if key in self.sessions else None
        return stated or day_of(key[1]) or self.registered.get(key, {}).get("session_date")

    def _check_times(self) -> None:
        """Ages and days that follow from dates; refuse what cannot be in time."""
        by_person: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)
        for (code, label), row in self.stored_visits.items():
            by_person[code][label] = dict(row)
        for (code, label), stated in self.visits.items():
            before = by_person[code].get(label, {})
            by_person[code][label] = {**before, **{k: v for k, v in stated.values.items() if v != CLEAR}}
        for key, stated in self.sessions.items():
            with self._row(stated.row):
                self._age(key)
        for key, stated in self.visits.items():
            with self._row(stated.row):
                visits = by_person[key[0]]
                self._days(key, stated, visits[key[1]])
                self._order(key, visits)

    def _age(self, key: tuple[str, str]) -> None:
        day, visit = self._day(key), self.visits.get(key)
        if key[0] not in self.births or day is None:
            return
        text, birth = self.births[key[0]]
        only_year = len(text) == 4
        if (day.year < birth.year) if only_year else (day < birth):
            raise _conflict(f"a visit on {day}, before the birth ({text})", "a visit after it", "correct one of them")
        age = float(day.year - birth.year) if only_year else math.floor((day - birth).days / 36.525) / 10
        if visit is None:
            return
        given = visit.values.setdefault("visit_age", age)
        if given != CLEAR and abs(given - age) > 1.5:
            raise _conflict(f"age {given:g} and birth {text}", f"an age of {age:g} on {day}", "correct one of them")

    def _days(self, key: tuple[str, str], stated: _Stated, merged: Mapping[str, Any]) -> None:
        day, event = self._day(key), merged.get("intervention_date")
        role = merged.get("visit_role")
        if not role:
            raise refused(
                stated.row.where,
                "no role of the visit",
                "a role, such as baseline, pre, 6_weeks",
                "write it into the column role",
            )
        if day is None or not isinstance(event, datetime.date):
            return
        days = (day - event).days
        given = stated.values.get("visit_days", merged.get("visit_days") if "visit_days" not in stated.values else None)
        if isinstance(given, int) and given != days:
            raise _conflict(
                f"{given} days, {day} and an intervention on {event}", f"{days} days", "correct one of the three"
            )
        if "visit_days" not in stated.values and merged.get("visit_days") is None:
            stated.values["visit_days"] = days
        after = study.role_days(role)
        if after is not None and (days > 0 if after < 0 else days < 0):
            raise _conflict(
                f"role {role} on {day}, intervention on {event}",
                "baseline and pre before the intervention, the others after it",
                "correct role or date",
            )

    def _order(self, key: tuple[str, str], visits: Mapping[str, Mapping[str, Any]]) -> None:
        """The roles of a person are in the order of their dates, where both are known."""
        mine, day = study.role_days(visits[key[1]]["visit_role"]), self._day(key)
        if mine is None or day is None:
            return
        for label, row in visits.items():
            other, its = study.role_days(row.get("visit_role") or ""), self._day((key[0], label))
            if other is None or its is None or other == mine or its == day or (other < mine) == (its < day):
                continue
            raise _conflict(
                f"role {visits[key[1]]['visit_role']} on {day}, role {row['visit_role']} on {its}",
                "roles in the order of their dates",
                "correct role or date",
            )

    # ------------------------------------------------------------------------------------------------------ comparison
    def _compare(self) -> None:
        """Say for each row what it changes, and keep only that."""
        for code, stated in list(self.people.items()):
            population = stated.values.get("population")
            if code not in self.known:
                self._say(stated, f"new person {code}")
            elif population is None or population == self.known[code]["population"]:
                del self.people[code]
            else:
                self._say(stated, f"population {self.known[code]['population']} -> {population}")
        for key, stated in list(self.sessions.items()):
            known = self.registered.get(key)
            date = self._day(key)
            if known is None:
                self._say(stated, f"new session {key[1]} of {key[0]}")
                stated.values["session_date"] = date
            elif "session_date" not in stated.values or known["session_date"] == date:
                del self.sessions[key]
            else:
                self._say(stated, f"date {_shown(known['session_date'])} -> {date}")
        self._differences(self.visits, self.stored_visits, "visit", lambda k: f"{k[1]} of {k[0]}")
        self._differences(self.members, self.stored_members, "member", lambda k: f"{k[1]} of cohort {k[0]}")
        for key, stated in list(self.scores.items()):
            old, new = self.stored_scores.get(key), stated.values["score_value"]
            if old == new:
                del self.scores[key]
            else:
                self._say(
                    stated, f"{key[2]} {_shown(old)} -> {_shown(new)}" if old is not None else f"{key[2]} {new:g}"
                )
        numbers = [t.values["video_id"] for t in self.trials]
        now = video.conditions(inside("video_id", numbers)) if numbers else {}
        for stated in list(self.trials):
            number = stated.values["video_id"]
            if numbers.count(number) > 1:
                with self._row(stated.row):
                    raise _conflict(f"video_id {number} in several rows", "each video once", "remove all but one")
                continue
            with self._row(stated.row):
                changes = _new_condition(now[number], stated.values)
                if not changes:
                    self.trials.remove(stated)
                for text in changes:
                    self._say(stated, text)

    def _say(self, stated: _Stated, text: str) -> None:
        self.lines[stated.row.where].changes.append(text)

    def _differences(self, stated: dict, stored: Mapping, what: str, name: Any) -> None:
        for key, one in list(stated.items()):
            values = {k: _default(k) if v == CLEAR else v for k, v in one.values.items()}
            old = stored.get(key)
            if old is None:
                self._say(one, f"new {what} {name(key)}" + (f" ({v})" if (v := values.get("visit_role")) else ""))
                one.values = values
                continue
            one.values = {k: v for k, v in values.items() if old[k] != v}
            if not one.values:
                del stated[key]
            for k, v in one.values.items():
                self._say(one, f"{k.removeprefix('visit_').removeprefix('member_')} {_shown(old[k])} -> {_shown(v)}")

    # -------------------------------------------------------------------------------------------------------- applying
    def apply(self) -> None:
        """Write what `_compare` has left. Inside a transaction."""
        now = utc_now()
        named = {p for s in self.people.values() if (p := s.values.get("population"))}
        lab.Population.insert(({"population": p, "population_description": ""} for p in named), skip_duplicates=True)
        new, old = _split(self.people, self.known)
        lab.Subject.insert(
            {"subject": c, "population": s.values.get("population", "unknown"), "subject_created": now}
            for c, s in new.items()
        )
        for code, stated in old.items():
            lab.Subject.update1({"subject": code, "population": stated.values["population"]})
        numbers = {key: int(r["session_id"]) for key, r in self.registered.items()}
        new, old = _split(self.sessions, self.registered)
        if new:
            first = next_id(session.Session, "session_id", len(new))
            numbers |= {key: first + i for i, key in enumerate(new)}
        session.Session.insert(
            {
                "session_id": numbers[key],
                "subject": key[0],
                "session_label": key[1],
                "session_date": stated.values["session_date"],
                "session_created": now,
            }
            for key, stated in new.items()
        )
        for key, stated in old.items():
            session.Session.update1({"session_id": numbers[key], "session_date": stated.values["session_date"]})
        new, old = _split(self.visits, self.stored_visits)
        blank = {column: _default(column) for column in VISIT_COLUMNS.values()}
        study.Visit.insert({"session_id": numbers[k], **blank, **s.values} for k, s in new.items())
        for key, stated in old.items():
            study.Visit.update1({"session_id": numbers[key], **stated.values})
        cohorts = {c for c, _ in self.members} - self.cohorts
        study.Cohort.insert({"cohort": c} for c in sorted(cohorts))
        new, old = _split(self.members, self.stored_members)
        blank = {"member_included": True, "member_group": "", "member_reason": ""}
        study.CohortMember.insert({"cohort": k[0], "subject": k[1], **blank, **s.values} for k, s in new.items())
        for (cohort, code), stated in old.items():
            study.CohortMember.update1({"cohort": cohort, "subject": code, **stated.values})
        scores = [{"session_id": numbers[k[:2]], "instrument": k[2], **s.values} for k, s in self.scores.items()]
        gone = [{k: r[k] for k in ("session_id", "instrument")} for r in scores if r["score_value"] is None]
        if gone:
            (study.ClinicalScore & gone).delete_quick()
        study.ClinicalScore.insert([r for r in scores if r["score_value"] is not None], replace=True)
        for stated in self.trials:
            set_condition(stated.values["video_id"], stated.values.get("activity"), stated.values.get("pace"))


def _split(stated: Mapping[Any, _Stated], known: Mapping[Any, Any]) -> tuple[dict[Any, _Stated], dict[Any, _Stated]]:
    """Those that are new, and those that are changed."""
    return {k: s for k, s in stated.items() if k not in known}, {k: s for k, s in stated.items() if k in known}


def _default(column: str) -> Any:
    return None if column in ("visit_days", "visit_age", "intervention_date") else ""


def _flag(row: Row, column: str) -> bool:
    text = row.cells[column].lower()
    if text not in (*_YES, *_NO):
        raise refused(row.where, f"{column} {text!r}", "yes or no", "write one of them")
    return text in _YES


def _visit_value(row: Row, column: str) -> Any:
    text = row.cells[column]
    if column == "role":
        if not study.is_role(text):
            raise refused(
                row.where,
                f"role {text!r}",
                "baseline, pre, 6_weeks, 3_months, 6_months, or a word of small letters, digits and _",
                "write it so",
            )
        return text
    if text == CLEAR:
        return CLEAR
    if column == "intervention_date":
        return date_of(row, column)
    if column in ("days", "age"):
        number = number_of(row, column, text)
        if (column == "age" and not 0 <= number <= 130) or (
            column == "days" and not (number.is_integer() and abs(number) < 1e5)
        ):
            expected = "an age of 0 to 130 years" if column == "age" else "whole days"
            raise refused(row.where, f"{column} {text}", expected, "correct it")
        return int(number) if column == "days" else number
    check_label(column, text, _LONGEST[column])
    return text


def _video(row: Row) -> int:
    name = needed(row, "video")
    where = {k: v for k, v in (("subject", row.cells.get("subject")), ("session_label", row.cells.get("visit"))) if v}
    of = {"video_id": int(name)} if re.fullmatch(r"\d{1,9}", name) else {"video_name": name}
    named = video.Video.proj("video_name") & (video.Video & (session.Session & where).proj()).proj() & of
    found = named.to_arrays("video_id")
    if len(found) == 1:
        return int(found[0])
    raise PblError(
        "DB_NOT_FOUND",
        found=f"{len(found)} registered videos {name!r}" + "".join(f", {k} {v}" for k, v in where.items()),
        expected="one: its number, or its file name with subject and visit",
        next_step="ingest it first; `pbl ingest` prints the number",
        key=row.where,
    )


def _new_condition(now: Any, stated: Mapping[str, Any]) -> list[str]:
    from pbl_pipeline.gait import Condition

    new = Condition(stated.get("activity", now.activity), stated.get("pace", now.pace))
    return [
        f"{k} {getattr(now, k)} -> {getattr(new, k)}"
        for k in ("activity", "pace")
        if getattr(now, k) != getattr(new, k)
    ]


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value == "":
        return "nothing"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _same(first: Any, value: Any, what: str, whose: str) -> None:
    if first != value:
        raise _conflict(f"{what} {first} and {value} of {whose}", "one value", "correct the row that is wrong")


def _one_person(first: str, code: str, what: str) -> None:
    if first != code:
        raise _conflict(
            f"the codes {first} and {code} for {what}", "one code for one person", "write the same code in all rows"
        )


def _conflict(found: str, expected: str, next_step: str) -> PblError:
    return PblError("SHEET_CONFLICT", found=found, expected=expected, next_step=next_step)


def _about(error: PblError, where: str) -> PblError:
    """The error with the row first, and what it was about already."""
    if error.key is None or str(error.key).startswith(where):
        return error.about(where)
    key = f"{where}: {error.key}"
    return PblError(error.code, found=error.found, expected=error.expected, next_step=error.next_step, key=key)
