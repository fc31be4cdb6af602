"""Import of visits, scores, cohorts and trials of a study from sheets (`pbl study import`, docs/files.md)."""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.csv_cells import quoted
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_height, check_label, check_mass, normalised_label
from pbl_pipeline.texts import code_of

from .. import lab, session, study, video
from ..decisions.review_decisions import record
from ..instruments import FLAGS, NUMBERS, disagreement
from ..intake.records import VisitRecord, add_people, delete_forces, session_ids, set_condition, set_height, set_mass
from ..intake.sheets import (
    Imported,
    Line,
    Row,
    Sheet,
    check_same,
    conflict,
    date_of,
    needed,
    number_of,
    read_sheets,
    refused,
    similar_codes,
)
from ..rows import insert_in_parts, inside, parts, rows_inside
from ..subject_codes import check_subject, day_of
from ..transactions import in_transaction

#: Text fields and the most characters of each; the first three are needed.
TEXTS = {
    "instrument": 32,
    "instrument_name": 128,
    "instrument_unit": 16,
    "instrument_source": 255,
    "minimal_change_source": 255,
}
_NEEDED = (*list(TEXTS)[:3], *FLAGS)


def add_instrument(values: Mapping[str, str], by: str) -> dict[str, PblError]:
    """Insert an instrument with a row of Decision; returns the errors by field, and with any of them inserts nothing.

    `values`: text by field (`TEXTS`, `NUMBERS`, `FLAGS` as yes or no); an empty one is not stated.
    """
    return in_transaction(lambda: _add(Row("instrument", {k: t for k, v in values.items() if (t := v.strip())}), by))


def _add(row: Row, by: str) -> dict[str, PblError]:
    made: dict[str, Any] = {}
    errors: dict[str, PblError] = {}
    for field in (*TEXTS, *NUMBERS, *FLAGS):
        line = Line(field)
        with line.about():
            made[field] = _value(row, field)
        if line.errors:
            errors[field] = line.errors[0]
    low, high = (made.get(f"instrument_{end}") for end in ("low", "high"))
    if low is not None and high is not None and low >= high:
        expected = f"more than the lowest value, {low:g}"
        errors["instrument_high"] = refused(f"{high:g}", expected, "correct one of them", "instrument_high")
    if made.get("minimal_change") is not None and made.get("minimal_change_source") == "":
        found = "a minimal important change without its source"
        expected = "who found it, in whom"
        errors["minimal_change_source"] = refused(found, expected, "write it, or neither", "minimal_change_source")
    if not errors:
        study.ClinicalInstrument.insert1(made)
        record("instrument", by, {"instrument": made["instrument"]}, {}, made)
    return errors


def _value(row: Row, field: str) -> Any:
    text = row.cells.get(field, "")
    if not text and field in _NEEDED:
        raise refused("an empty field", "a value", "write it", field)
    if field in FLAGS:
        if text not in ("yes", "no"):
            raise refused(repr(text[:20]), "yes or no", "choose one of them", field)
        return text == "yes"
    if field in NUMBERS:
        value = number_of(row, field, text) if text else None
        if field == "minimal_change" and value is not None and value <= 0:
            raise refused(text, "a change above 0", "correct it, or leave it empty", field)
        return value
    check_label(field, text, TEXTS[field])
    if field == "instrument":
        taken = {*COLUMNS, "instrument", "value", "video"}
        taken |= {str(name).lower() for name in study.ClinicalInstrument().to_arrays("instrument")}
        if text.lower() in taken or text.lower().replace(" ", "_") in taken:
            raise refused(repr(text), "a name that no instrument and no column of a sheet has", "choose another", field)
        if quoted(text) != text:
            raise refused(repr(text), "a name that no spreadsheet computes", "choose another", field)
    if field == "instrument_unit" and text.lower() == "punkte":
        return "points"  # the word by which whole numbers are asked for (`study.check_score`)
    return text


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
#: Height of the person and mass at the visit, with the checks of their values.
_SIZES = {"height_m": check_height, "mass_kg": check_mass}
COLUMNS = ("subject", "visit", *_DATED, *VISIT_COLUMNS, *_SIZES, "population", "record", "cohort", *MEMBER_COLUMNS)
SCORE_COLUMNS = ("subject", "visit", "instrument", "value")
TRIAL_COLUMNS = ("video", "subject", "visit", "activity", "pace")
#: Columns whose words are codes (`texts.code_of`) -> kind of the codes.
CODED = {"role": "role", "population": "population", "assistive_device": "aid", "orthosis": "orthosis"}
#: A cell that removes what is stored; an empty one leaves it.
CLEAR = "-"
_LONGEST = {
    "visit": 64,
    "record": 255,
    "note": 1000,
    "reason": 255,
    "intervention": 64,
    "assistive_device": 64,
    "orthosis": 64,
}
_YES, _NO = ("yes", "true", "1", "in"), ("no", "false", "0", "out")


def import_sheets(paths: Sequence[Path], dry_run: bool = False, distinct_codes: bool = False) -> Imported:
    """Bring the tables to what sheets say, all of them in one transaction: nothing is changed where a row is refused.

    Empty cells leave what is stored, "-" removes it. Rows that are stored as they stand change nothing.

    Raises `PblError` FILE_MISSING, SHEET_FORMAT for a sheet that cannot be read. What is wrong with a row is in the
    result.

    `dry_run`: change nothing; return what would be done. `distinct_codes`: codes that differ only in case, zeros or
    hyphens are different people.
    """
    sheets = [sheet for path in paths for sheet in read_sheets(path)]
    return in_transaction(lambda: import_rows(sheets, dry_run, distinct_codes))


def import_rows(sheets: Sequence[Sheet], dry_run: bool = False, distinct_codes: bool = False) -> Imported:
    """Import sheets that were read as `import_sheets` does, inside a transaction of the caller."""
    plan = _Plan(sheets, distinct_codes)
    lines = list(plan.lines.values())
    done = not dry_run and not any(line.errors for line in lines)
    if done:
        plan.apply()
    return Imported(lines, done)


@dataclasses.dataclass
class _Stated:
    """Statements of the sheets about a visit, score, ..., with the first row that makes one."""

    row: Row
    values: dict[str, Any]


class _Plan:
    """The statements of sheets, compared with the tables."""

    def __init__(self, sheets: Sequence[Sheet], distinct_codes: bool) -> None:
        self.lines: dict[str, Line] = {}
        self.people: dict[str, _Stated] = {}
        self.sessions: dict[tuple[str, str], _Stated] = {}
        self.visits: dict[tuple[str, str], _Stated] = {}
        self.members: dict[tuple[str, str], _Stated] = {}
        self.masses: dict[tuple[str, str], _Stated] = {}
        self.scores: dict[tuple[str, str, str], _Stated] = {}
        self.trials: list[_Stated] = []
        self.instruments = {r["instrument"]: r for r in study.ClinicalInstrument().to_dicts()}
        self.births: dict[str, tuple[str, datetime.date]] = {}
        self.records: dict[str, str] = {}
        for sheet in sheets:
            self._read(sheet)
        self._load()
        if not distinct_codes:
            self._check_codes()
        self._check_times()
        self._check_scores()
        self._compare()

    # ------------------------------------------------------------------------------------------------------- reading
    def _line(self, row: Row) -> Line:
        return self.lines.setdefault(row.where, Line(row.where))

    def _read(self, sheet: Sheet) -> None:
        """Read the rows of a sheet; unknown columns and wrong cells are errors, and the rest is read all the same."""
        names = {name: column for column, name in sheet.plain_names().items()}
        kind = TRIAL_COLUMNS if "video" in names else SCORE_COLUMNS if "instrument" in names else COLUMNS
        known = {names[c]: c for c in kind if c in names}
        wide = [c for c in sheet.columns if c in self.instruments and kind is COLUMNS]
        unknown = [c for c in sheet.columns if c not in known and c not in wide]
        if unknown:
            scores = f"; or a clinical score: {', '.join(self.instruments)}" if kind is COLUMNS else ""
            error = refused(
                f"unknown column {', '.join(map(repr, unknown[:5]))}",
                f"columns of {', '.join(kind)}{scores}",
                "rename or remove it; a score of your own first: pbl study instrument add",
                sheet.name,
            )
            self.lines[sheet.name] = Line(sheet.name, errors=[error])
        read = {TRIAL_COLUMNS: self._trial, SCORE_COLUMNS: self._long_score, COLUMNS: self._visit}[kind]
        for row in sheet.rows:
            line = self._line(row)
            if row.error is not None:
                line.errors.append(row.error)
                continue
            cells = {known.get(c, c): v for c, v in row.cells.items() if c not in unknown}
            wrong = self._wrong_cells(Row(row.where, cells), line, kind)
            if wrong and (kind is not COLUMNS or wrong & {"subject", "visit", "cohort"}):
                continue
            with line.about():
                read(Row(row.where, {c: v for c, v in cells.items() if c not in wrong}))

    def _wrong_cells(self, row: Row, line: Line, kind: tuple[str, ...]) -> set[str]:
        """Return the columns of a row whose cells are wrong by themselves, or empty and needed; each is an error."""
        wrong = dict.fromkeys((*(SCORE_COLUMNS if kind is SCORE_COLUMNS else ()), *row.cells))
        for column in tuple(wrong):
            with line.about():
                self._check_cell(row, column, needed(row, column), kind)
                del wrong[column]
        return set(wrong)

    def _check_cell(self, row: Row, column: str, text: str, kind: tuple[str, ...]) -> None:
        if kind is TRIAL_COLUMNS or column == "instrument":
            return
        if column == "subject":
            check_subject(text, "write the code of the person")
        elif column == "value":
            if (name := row.cells.get("instrument", "")) in self.instruments:
                self._number(row, name, text)
        elif column in self.instruments:
            self._number(row, column, text)
        elif column in VISIT_COLUMNS:
            _visit_value(row, column)
        elif column == "included":
            _flag(row, column)
        elif column in _DATED:
            _day(row, column)
        elif column in _SIZES:
            _size(row, column)
        else:
            check_label(column, text, _LONGEST.get(column, 32))

    def _person(self, row: Row) -> str:
        code = needed(row, "subject")
        stated = self.people.setdefault(code, _Stated(row, {}))
        if population := row.cells.get("population"):
            self._same(row, stated, "population", code_of("population", population), "population", code)
        return code

    def _same(self, row: Row, stated: _Stated, name: str, value: Any, what: str, whose: str) -> None:
        """State a value; another one that was stated before is an error of the row, whose rest is read all the same."""
        with self._line(row).about():
            check_same(stated.values.setdefault(name, value), value, what, whose)

    def _session(self, row: Row, code: str) -> tuple[str, str]:
        label = normalised_label(needed(row, "visit"))
        stated = self.sessions.setdefault((code, label), _Stated(row, {}))
        day = day_of(label)
        if "date" in row.cells:
            date = date_of(row, "date")
            with self._line(row).about():
                check_same(day or date, date, "date of the visit", f"{code}, {label}")
            self._same(row, stated, "session_date", date, "date of the visit", f"{code}, {label}")
        return code, label

    def _visit(self, row: Row) -> None:
        cells = row.cells
        code = self._person(row)
        self._identity(row, code)
        if "height_m" in cells:
            self._same(row, self.people[code], "subject_height", _size(row, "height_m"), "height", code)
        if "cohort" in cells or {*MEMBER_COLUMNS} & {*cells}:
            self._member(row, code)
        scores = [c for c in cells if c in self.instruments]
        stated = {c for c in VISIT_COLUMNS if c in cells}
        if not scores and not stated and not ({"visit", "date", "mass_kg"} & {*cells}):
            return
        key = self._session(row, code)
        if "mass_kg" in cells:
            mass = self.masses.setdefault(key, _Stated(row, {}))
            self._same(row, mass, "body_mass", _size(row, "mass_kg"), "mass", f"{code}, {key[1]}")
        if stated:
            with self._line(row).about():
                if key in self.visits:
                    raise conflict(
                        f"visit {key[1]} of {code} also in {self.visits[key].row.where}",
                        "one row for each visit of a person",
                        "remove one, or correct its label",
                    )
                self.visits[key] = _Stated(row, {VISIT_COLUMNS[c]: _visit_value(row, c) for c in stated})
        for name in scores:
            with self._line(row).about():
                self._score(row, key, name, cells[name])

    def _identity(self, row: Row, code: str) -> None:
        """Compare what identifies a person, and store none of it."""
        line = self._line(row)
        if record := row.cells.get("record"):
            with line.about():
                if (first := self.records.setdefault(record, code)) != code:
                    found = f"the codes {first} and {code} for record {record}"
                    raise conflict(found, "one code for one person", "write the same code in all rows")
                mine = [r for r, c in self.records.items() if c == code]
                if len(mine) > 1:
                    found = f"{len(mine)} records of {code}"
                    raise conflict(found, "one record for a person", "correct code or record")
        if "birth_date" in row.cells:
            day = _day(row, "birth_date")
            text = str(day.year) if len(row.cells["birth_date"]) == 4 else day.isoformat()
            with line.about():
                check_same(self.births.setdefault(code, (text, day))[0], text, "birth date", code)

    def _member(self, row: Row, code: str) -> None:
        cohort = needed(row, "cohort")
        stated = self.members.setdefault((cohort, code), _Stated(row, {}))
        for column, name in MEMBER_COLUMNS.items():
            if column in row.cells:
                value = _flag(row, column) if column == "included" else row.cells[column]
                self._same(row, stated, name, value, f"{column} in {cohort}", code)

    def _long_score(self, row: Row) -> None:
        key = self._session(row, self._person(row))
        self._score(row, key, needed(row, "instrument"), needed(row, "value"))

    def _score(self, row: Row, key: tuple[str, str], name: str, text: str) -> None:
        if name not in self.instruments:
            raise refused(
                f"instrument {name!r}",
                f"one of {', '.join(self.instruments)}",
                "correct the name, or add your own first: pbl study instrument add",
                row.where,
            )
        value = self._number(row, name, text)
        if (other := self.scores.get((*key, name))) is not None:
            raise conflict(
                f"{name} of {key[0]}, {key[1]} also in {other.row.where}",
                "each score of a visit once",
                "remove one, or correct the label of its visit",
            )
        self.scores[(*key, name)] = _Stated(row, {"score_value": value})

    def _number(self, row: Row, name: str, text: str) -> float | str:
        """The value of a score, which its instrument allows; CLEAR as it is."""
        if text != CLEAR:
            study.check_score(value := number_of(row, name, text), self.instruments[name], row.where)
            return value
        return CLEAR

    def _trial(self, row: Row) -> None:
        values = {k: row.cells[k] for k in ("activity", "pace") if k in row.cells}
        for name, text in values.items():
            check_label(name, text, 32)
        self.trials.append(_Stated(row, {**values, "video_id": _video(row)}))

    # ------------------------------------------------------------------------------------------------------- the tables
    def _load(self) -> None:
        people = {*self.people, *(c for _, c in self.members)}
        self.known = {r["subject"]: r for r in lab.Subject.proj("population", "subject_height").to_dicts()}
        self.registered = session.by_label(rows_inside(session.Session(), "subject", people))
        labels = {int(r["session_id"]): key for key, r in self.registered.items()}
        self.stored_visits = {labels[int(r["session_id"])]: r for r in rows_inside(study.Visit(), "session_id", labels)}
        masses = rows_inside(session.BodyMass(), "session_id", labels)
        self.stored_masses = {labels[int(r["session_id"])]: r for r in masses}
        scores = rows_inside(study.ClinicalScore(), "session_id", labels)
        self.stored_scores = {(*labels[int(r["session_id"])], r["instrument"]): r for r in scores}
        members = rows_inside(study.CohortMember(), "subject", people)
        self.stored_members = {
            (r["cohort"], r["subject"]): {**r, "member_included": bool(r["member_included"])} for r in members
        }

    def _check_codes(self) -> None:
        for code, others in similar_codes(self.people, self.known).items():
            with self._line(self.people[code].row).about():
                raise conflict(
                    f"the codes {code} and {', '.join(others)}",
                    "one code for one person",
                    "write the same code; if they are different people, repeat with --distinct-codes",
                )

    def _day(self, key: tuple[str, str]) -> datetime.date | None:
        stated = self.sessions[key].values.get("session_date") if key in self.sessions else None
        return stated or day_of(key[1]) or self._stored_day(key)

    def _stored_day(self, key: tuple[str, str]) -> datetime.date | None:
        return self.registered.get(key, {}).get("session_date")

    def _check_times(self) -> None:
        """Ages and days that follow from dates; refuse what cannot be in time."""
        by_person: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)
        for (code, label), row in self.stored_visits.items():
            by_person[code][label] = dict(row)
        for (code, label), stated in self.visits.items():
            before = by_person[code].get(label, {})
            by_person[code][label] = {**before, **{k: v for k, v in stated.values.items() if v != CLEAR}}
        for key, stated in self.sessions.items():
            with self._line(stated.row).about():
                self._age(key)
            day, stored = stated.values.get("session_date"), self.stored_visits.get(key)
            if stored is not None and key not in self.visits and day not in (None, self._stored_day(key)):
                # Its role has to fit the new day, and days from an event follow from it.
                values = {"visit_days": None} if stored["intervention_date"] is not None else {}
                self.visits[key] = _Stated(stated.row, values)
        for key, stated in self.visits.items():
            with self._line(stated.row).about() as line:
                if line.errors:  # the role may be what is wrong
                    continue
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
            raise conflict(f"a visit on {day}, before the birth ({text})", "a visit after it", "correct one of them")
        age = float(day.year - birth.year) if only_year else math.floor((day - birth).days / 36.525) / 10
        if visit is None:
            return
        given = visit.values.setdefault("visit_age", age)
        if given != CLEAR and abs(given - age) > 1.5:
            raise conflict(f"age {given:g} and birth {text}", f"an age of {age:g} on {day}", "correct one of them")

    def _days(self, key: tuple[str, str], stated: _Stated, merged: Mapping[str, Any]) -> None:
        day, event = self._day(key), merged.get("intervention_date")
        role = merged.get("visit_role")
        if not role:
            raise refused(
                "no role of the visit",
                "a role, such as baseline, pre, 6_weeks",
                "write it into the column role",
                stated.row.where,
            )
        if day is None or not isinstance(event, datetime.date):
            return
        days = (day - event).days
        given = stated.values.get("visit_days", merged.get("visit_days"))
        if isinstance(given, int) and given != days:
            raise conflict(
                f"{given} days, {day} and an intervention on {event}", f"{days} days", "correct one of the three"
            )
        if given is None:
            stated.values["visit_days"] = days
        after = study.role_days(role)
        if after is not None and (days > 0 if after < 0 else days < 0):
            raise conflict(
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
            raise conflict(
                f"role {visits[key[1]]['visit_role']} on {day}, role {row['visit_role']} on {its}",
                "roles in the order of their dates",
                "correct role or date",
            )

    def _check_scores(self) -> None:
        """Refuse scores that contradict others of the visit: a total against its parts, a speed against its time."""
        by_visit: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
        for (code, label, name), row in self.stored_scores.items():
            by_visit[code, label][name] = row["score_value"]
        for (code, label, name), stated in self.scores.items():
            by_visit[code, label][name] = stated.values["score_value"]
        for key in dict.fromkeys(k[:2] for k in self.scores):
            wrong = disagreement({n: v for n, v in by_visit[key].items() if v != CLEAR})
            stated = [self.scores[(*key, n)] for n in wrong[0] if (*key, n) in self.scores] if wrong else []
            if wrong and stated:
                with self._line(stated[0].row).about():
                    raise conflict(f"{wrong[1]} of {', '.join(key)}", wrong[2], "correct the score that is wrong")

    # ------------------------------------------------------------------------------------------------------ comparison
    def _compare(self) -> None:
        """Put into words what each row changes, and keep only that."""
        self._differences(self.people, self.known, lambda code, _: f"new person {code}")
        self._differences(self.sessions, self.registered, lambda key, _: f"new session {key[1]} of {key[0]}")
        self._differences(self.visits, self.stored_visits, _new_visit)
        self._differences(self.masses, self.stored_masses, lambda _, values: f"mass {_shown(values['body_mass'])}")
        self._differences(self.members, self.stored_members, lambda key, _: f"new member {key[1]} of cohort {key[0]}")
        self._differences(self.scores, self.stored_scores, _new_score)
        self._compare_trials()

    def _differences(
        self, stated: dict[Any, _Stated], stored: Mapping, new: Callable[[Any, dict[str, Any]], str]
    ) -> None:
        """Leave of what is stated what differs from what is stored; `new`: in words what is not stored at all."""
        for key, one in list(stated.items()):
            values = {k: _default(k) if v == CLEAR else v for k, v in one.values.items()}
            old = stored.get(key)
            if old is None:
                texts = [new(key, values)]
            else:
                values = {k: v for k, v in values.items() if old[k] != v}
                texts = [f"{_column(key, k)} {_shown(old[k])} -> {_shown(v)}" for k, v in values.items()]
            one.values = values
            self._line(one.row).changes += filter(None, texts)
            if not any(texts):
                del stated[key]

    def _compare_trials(self) -> None:
        numbers = [t.values["video_id"] for t in self.trials]
        now = {v: c for some in parts(numbers) for v, c in video.conditions(inside("video_id", some)).items()}
        for stated in list(self.trials):
            number = stated.values["video_id"]
            with self._line(stated.row).about() as line:
                if numbers.count(number) > 1:
                    raise conflict(f"video_id {number} in several rows", "each video once", "remove all but one")
                changes = _new_condition(now[number], stated.values)
                line.changes += changes
                if not changes:
                    self.trials.remove(stated)

    # -------------------------------------------------------------------------------------------------------- applying
    def apply(self) -> None:
        """Write what `_compare` has left. Inside a transaction."""
        add_people(VisitRecord(code, population=s.values.get("population")) for code, s in self.people.items())
        for code, stated in self.people.items():
            if "subject_height" in stated.values:
                set_height(code, stated.values["subject_height"])
        numbers = {key: int(r["session_id"]) for key, r in self.registered.items()} | session_ids(
            VisitRecord(*key, date=s.values.get("session_date")) for key, s in self.sessions.items()
        )
        blank = {column: _default(column) for column in VISIT_COLUMNS.values()}
        visits = {key: ({"session_id": numbers[key]}, s.values) for key, s in self.visits.items()}
        _write(study.Visit, visits, self.stored_visits, blank)
        delete_forces(key["session_id"] for key, values in visits.values() if "assistive_device" in values)
        for key, stated in self.masses.items():
            set_mass(numbers[key], stated.values["body_mass"])
        cohorts = ({"cohort": c} for c in sorted({c for c, _ in self.members}))
        insert_in_parts(study.Cohort, cohorts, skip_duplicates=True)
        blank = {"member_included": True, "member_group": "", "member_reason": ""}
        members = {key: ({"cohort": key[0], "subject": key[1]}, s.values) for key, s in self.members.items()}
        _write(study.CohortMember, members, self.stored_members, blank)
        scores = [{"session_id": numbers[k[:2]], "instrument": k[2], **s.values} for k, s in self.scores.items()]
        gone = ({k: r[k] for k in ("session_id", "instrument")} for r in scores if r["score_value"] is None)
        for some in parts(gone):
            (study.ClinicalScore & some).delete_quick()
        entered = (r for r in scores if r["score_value"] is not None)
        insert_in_parts(study.ClinicalScore, entered, replace=True)
        for stated in self.trials:
            set_condition(stated.values["video_id"], stated.values.get("activity"), stated.values.get("pace"))


def _write(table: Any, stated: Mapping[Any, tuple[dict, dict]], stored: Mapping, blank: Mapping[str, Any]) -> None:
    """Insert the rows (key and values) that are new, with `blank` where nothing is stated, and update the others."""
    new = ({**key, **blank, **values} for name, (key, values) in stated.items() if name not in stored)
    insert_in_parts(table, new)
    for name, (key, values) in stated.items():
        if name in stored:
            table.update1({**key, **values})


def _new_visit(key: tuple[str, str], values: Mapping[str, Any]) -> str:
    role = f" ({values['visit_role']})" if values.get("visit_role") else ""
    return f"new visit {key[1]} of {key[0]}{role}"


def _new_score(key: tuple[str, str, str], values: Mapping[str, Any]) -> str:
    return "" if values["score_value"] is None else f"{key[2]} {values['score_value']:g}"


def _column(key: Any, column: str) -> str:
    """The name of a column in words: of a score that of its instrument."""
    return key[2] if column == "score_value" else re.sub("^(visit|member|session|subject|body)_", "", column)


def _default(column: str) -> Any:
    empty = ("visit_days", "visit_age", "intervention_date", "score_value", "subject_height", "body_mass")
    return None if column in empty else ""


def _day(row: Row, column: str) -> datetime.date:
    """The day in a cell; of a birth date that is only a year its middle."""
    text = row.cells[column]
    if column == "birth_date" and re.fullmatch(r"(18|19|20)\d\d", text):
        return datetime.date(int(text), 7, 1)
    return date_of(row, column)


def _size(row: Row, column: str) -> float | str:
    text = row.cells[column]
    if text == CLEAR:
        return CLEAR
    value = number_of(row, column, text)
    _SIZES[column](value)
    return value


def _flag(row: Row, column: str) -> bool:
    text = row.cells[column].lower()
    if text not in (*_YES, *_NO):
        raise refused(f"{column} {text!r}", "yes or no", "write one of them", row.where)
    return text in _YES


def check_role(text: str, where: str) -> str:
    """Return the role of a visit that a text states. Raises `PblError` SHEET_FORMAT for one that cannot be a role."""
    text = code_of("role", text)
    if not study.is_role(text):
        expected = "baseline, pre, 6_weeks, 3_months, 6_months, or a word of small letters, digits and _"
        raise refused(f"role {text[:40]!r}", expected, "write it so", where)
    return text


def _visit_value(row: Row, column: str) -> Any:
    text = row.cells[column]
    if column == "role":
        return check_role(text, row.where)
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
            raise refused(f"{column} {text}", expected, "correct it", row.where)
        return int(number) if column == "days" else number
    check_label(column, text, _LONGEST[column])
    return code_of(CODED[column], text) if column in CODED else text


def _video(row: Row) -> int:
    name = needed(row, "video")
    where = {k: v for k, v in (("subject", row.cells.get("subject")), ("session_label", row.cells.get("visit"))) if v}
    where = session.as_registered(where)
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
