"""Forms of a visit: its registration, what is stated of its person and recordings, its role and clinical scores.

Each change is a row of Decision. Role and scores are checked and written as the rows of a sheet of `pbl study import`.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_height, check_label, check_mass, normalised_label
from pbl_pipeline.texts import code_of

from .. import lab, session, study, video
from ..decisions.review_decisions import decisions, queue_visit, record
from ..intake.records import set_condition, set_height, set_mass, set_population
from ..intake.sheets import Row, Sheet, conflict, date_of, number_of, refused
from ..rows import moment
from ..subject_codes import check_subject, day_of, iso_label
from ..transactions import in_transaction
from .study_sheets import CLEAR, CODED, COLUMNS, SCORE_COLUMNS, check_role, import_rows

#: Fields of a new visit: column of a sheet of `pbl study import`, and the most characters.
NEW = {"subject": 32, "visit": 64, "date": 10, "role": 32, "population": 32}
#: Field by which a person confirms that a code that is like another one is of another person.
DISTINCT = "distinct"
#: Fields of a registered visit and the most characters; height (m) and population are of the person, the day is asked
#: for where the label names none.
FACTS = {"date": 10, "height_m": 10, "mass_kg": 10, "population": 32, "assistive_device": 64, "orthosis": 64}
#: Prefixes of the names of the fields of a recording, followed by its video_id.
ACTIVITY, PACE = "activity:", "pace:"
#: Fields that are numbers, and their checks.
_NUMBERS = {"height_m": check_height, "mass_kg": check_mass}
#: Kind of decision by the first part of a field's name.
_KINDS = {name: name for name in ("date", "population", "orthosis", "activity", "pace")}
_KINDS |= {"height_m": "height", "mass_kg": "mass", "assistive_device": "aid"}
#: Name of the field of the role; those of scores are named by their instruments.
ROLE = "role"
#: Roles that are offered; any word of small letters, digits and underscores can be one.
USUAL_ROLES = (*study.FIRST_ROLES, "6_weeks", "3_months", "6_months", "12_months", "24_months")


@dataclasses.dataclass(frozen=True)
class Form:
    """Stored values of a visit, as a form shows them."""

    session_id: int
    subject: str
    label: str
    values: dict[str, str]  # by field, empty if nothing is stored
    recordings: dict[int, str] = dataclasses.field(default_factory=dict)  # of the facts: name by video_id
    instruments: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)  # of the scores: rows by name

    @property
    def seen(self) -> str:
        """Text that differs after each change."""
        text = json.dumps([self.session_id, self.values], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def no_day_in_label(self) -> bool:
        """True if the label of the visit names no day, which can then be stated."""
        return day_of(self.label) is None or not self.values.get("date")

    def stored(self, name: str, text: str) -> Any:
        """Return what is stored of a field with this text, None if there is nothing."""
        numeric = name in _NUMBERS or name in self.instruments
        return number_of(Row(name, {}), name, text[:40]) if text and numeric else text or None

    def same(self, name: str, text: str) -> bool:
        """Return whether a text is the stored value, also in another notation: 1,80 for 1.8."""
        old = self.values[name]
        try:
            return iso_label(text) == old or self.stored(name, text) == self.stored(name, old)
        except PblError:
            return False


def register_visit(values: Mapping[str, str], by: str) -> tuple[int | None, dict[str, PblError]]:
    """Register a visit, and its person where the code is new.

    Returns the number of the visit, None if nothing was written; errors by field, `DISTINCT` for a code that
    is like another one, "" for what is wrong with several.

    `values`: text by field: `NEW`, "height_m", and `DISTINCT` ("yes" or empty). Only the first two are needed.
    """
    given = {name: normalised_label(text) for name, text in _stripped(values).items() if text}
    given |= {"visit": iso_label(given["visit"])} if "visit" in given else {}
    return in_transaction(lambda: _register(given, by))


def _check_visit(label: str) -> None:
    """Raise a `PblError` for a label that is too long, or looks like a day and is none, such as 9/3/2026."""
    check_label("visit", label, longest=NEW["visit"])
    if re.fullmatch(r"\d{1,4}([./-])\d\d?\1\d{2,4}", label):
        date_of(Row("visit", {"visit": label}), "visit")


def _register(given: dict[str, str], by: str) -> tuple[int | None, dict[str, PblError]]:
    errors = {n: refused("an empty field", "a value", "write it", n) for n in ("subject", "visit") if n not in given}
    checks: dict[str, Callable[[str], Any]] = {
        "subject": lambda text: check_subject(text, "write the code of the person"),
        "visit": _check_visit,
        "date": lambda text: date_of(Row("date", {"date": text}), "date"),
        "role": lambda text: check_role(text, "role"),
        "population": functools.partial(check_label, "population", longest=NEW["population"]),
        "height_m": functools.partial(_number, "height_m"),
    }
    _check({name: given[name] for name in checks if name in given}, checks, errors)
    of_visit = session.as_registered({"subject": given.get("subject", ""), "session_label": given.get("visit", "")})
    if session.Session & of_visit:
        found = f"visit {of_visit['session_label']} of {of_visit['subject']}, which is registered"
        errors["visit"] = conflict(found, "a visit that is not registered yet", "open it from the list of visits")
    if errors:
        return None, errors
    row = Row("form", {name: given[name] for name in NEW if name in given})
    found = import_rows([Sheet("form", COLUMNS, (row,))], distinct_codes=given.get(DISTINCT) == "yes")
    if found.errors:
        error = found.errors[0]
        if "--distinct-codes" in error.next_step:
            step = "correct the code, or tick that they are different people"
            return None, {DISTINCT: conflict(error.found, error.expected, step)}
        return None, {"": error.with_key(None)}
    number = int((session.Session & of_visit).fetch1("session_id"))
    record("visit", by, {}, {}, {"visit": given["visit"]}, session_id=number)
    now = facts_form(number)
    if "height_m" in given and not now.same("height_m", given["height_m"]):
        _write(now, {"height_m": given["height_m"]}, by, "")
    return number, {}


def facts_form(session_id: int) -> Form:
    """Return what can be stated of a visit. Raises `PblError` DB_NOT_FOUND for an unknown number."""
    visit = session.registered_visit(session_id)
    person = (lab.Subject & {"subject": visit["subject"]}).fetch1()
    of_visit = (study.Visit & {"session_id": session_id}).to_dicts()
    masses = (session.BodyMass & {"session_id": session_id}).to_arrays("body_mass")
    values = {
        "date": str(visit["session_date"] or ""),
        "height_m": _text(person["subject_height"]),
        "mass_kg": _text(masses[0] if len(masses) else None),
        "population": "" if person["population"] == "unknown" else person["population"],
        **{name: of_visit[0][name] if of_visit else "" for name in ("assistive_device", "orthosis")},
    }
    videos = (video.Video & {"session_id": session_id}).to_dicts(order_by="video_id")
    conditions = video.conditions({"session_id": session_id})
    for row in videos:
        condition = conditions[row["video_id"]]
        values[f"{ACTIVITY}{row['video_id']}"] = condition.activity
        values[f"{PACE}{row['video_id']}"] = condition.pace
    names = {int(row["video_id"]): row["video_name"] for row in videos}
    return Form(session_id, visit["subject"], visit["session_label"], values, recordings=names)


def scores_form(session_id: int) -> Form:
    """Return role and scores of a visit. Raises `PblError` DB_NOT_FOUND for an unknown number."""
    visit = session.registered_visit(session_id)
    roles = (study.Visit & {"session_id": session_id}).to_arrays("visit_role")
    scores = (study.ClinicalScore & {"session_id": session_id}).to_dicts()
    stored = {r["instrument"]: f"{r['score_value']:.12g}" for r in scores}
    known = instruments()
    values = {ROLE: str(roles[0]) if len(roles) else "", **{n: stored.get(n, "") for n in known}}
    return Form(session_id, visit["subject"], visit["session_label"], values, instruments=known)


def instruments() -> dict[str, dict[str, Any]]:
    """Return the rows of ClinicalInstrument by name."""
    return {r["instrument"]: r for r in study.ClinicalInstrument().to_dicts(order_by="instrument")}


def correct_facts(
    session_id: int, values: Mapping[str, str], by: str, seen: str, reason: str = ""
) -> tuple[tuple[str, ...], dict[str, PblError]]:
    """Bring what is stored of a visit, its person and its recordings to what was entered, all of it or nothing.

    What was computed with another height, mass or walking aid, or pools other recordings now, is deleted and pending
    again.

    Raises `PblError` DB_NOT_FOUND; USAGE for an unknown field; DECIDED_MEANWHILE if another value was stored
    meanwhile.

    Returns the fields that were changed; the errors by field, with any of which nothing was written.

    Parameters
    ----------
    values
        Text by field of `Form.values`; an empty one removes what is stored. Fields that are not named stay.
    by, reason
        Who entered it, and why (no names).
    seen
        `Form.seen` of the form that was filled in.
    """
    given = _stripped(values)
    return in_transaction(lambda: _correct(_locked(facts_form, session_id, values, seen), given, by, reason))


def enter_scores(
    session_id: int, values: Mapping[str, str], by: str, seen: str, reason: str = ""
) -> tuple[tuple[str, ...], dict[str, PblError]]:
    """Bring role and scores of a visit to what was entered, all of it or nothing: as `correct_facts`, of
    `scores_form`."""
    given = _stripped(values)
    return in_transaction(lambda: _enter(_locked(scores_form, session_id, values, seen), given, by, reason))


def _locked(read: Callable[[int], Form], session_id: int, given: Collection[str], seen: str) -> Form:
    """Return what is stored, which is what the form showed. Raises `PblError` DB_NOT_FOUND, USAGE,
    DECIDED_MEANWHILE."""
    session.lock(session_id)  # a concurrent entry waits here
    now = read(session_id)
    if unknown := sorted(set(given) - set(now.values)):
        raise PblError(
            "USAGE",
            found=f"a field {unknown[0][:64]!r}",
            expected="the role or an instrument of ClinicalInstrument" if now.instruments else "a field of the form",
            next_step="load the form again",
            key=f"session_id={session_id}",
        )
    if now.seen == seen:
        return now
    kinds = ("role", "score") if now.instruments else _KINDS.values()
    who = "it was imported"
    if (last := next((d for d in decisions(session_id) if d.what in kinds), None)) is not None:
        did = f"entered {last.about.get('instrument', 'the role')}" if now.instruments else f"changed the {last.what}"
        who = f"{last.by} {did} at {moment(last.at)}"
    raise PblError(
        "DECIDED_MEANWHILE",
        found=f"since this form was loaded something else is stored: {who}",
        expected="what the form showed; nothing of yours was written",
        next_step="load the form again, look at what is stored, and enter then",
        key=f"session_id={session_id}",
    )


def _correct(now: Form, given: dict[str, str], by: str, reason: str) -> tuple[tuple[str, ...], dict[str, PblError]]:
    changed = {name: text for name, text in given.items() if not now.same(name, text)}
    checks: dict[str, Callable[[str], Any]] = {
        **{n: functools.partial(_number, n) for n in _NUMBERS},
        **{n: functools.partial(check_label, n, longest=m) for n, m in FACTS.items() if n not in _NUMBERS},
        "date": lambda text: date_of(Row("date", {"date": text}), "date"),
        **{n: functools.partial(check_label, n.partition(":")[0], longest=32) for n in changed if ":" in n},
    }
    errors: dict[str, PblError] = {}
    _check({name: text for name, text in changed.items() if text}, checks, errors)
    if changed.get("date") == "":
        errors["date"] = refused("no day", "the day of the visit", "write it", "date")
    cells = {n: changed[n] or CLEAR for n in ("date", "assistive_device", "orthosis") if n in changed}
    if cells and not errors:
        row = Row("form", {"subject": now.subject, "visit": now.label, **cells})
        found = import_rows([Sheet("form", tuple(row.cells), (row,))], distinct_codes=True)
        if found.errors:
            return (), {next(iter(cells)): found.errors[0].with_key(None)}
    if errors:
        return (), errors
    if changed:
        _write(now, changed, by, reason)
    return tuple(changed), {}


def _enter(now: Form, given: dict[str, str], by: str, reason: str) -> tuple[tuple[str, ...], dict[str, PblError]]:
    changed = {name: text[:200] for name, text in given.items() if not now.same(name, text[:200])}
    errors: dict[str, PblError] = {}
    if changed.get(ROLE) == "":
        errors[ROLE] = refused("no role", f"a role, such as {', '.join(USUAL_ROLES[:3])}", "write it", ROLE)
    of_visit = {"subject": now.subject, "visit": now.label}
    cells = {n: {ROLE: t} if n == ROLE else {"instrument": n, "value": t or CLEAR} for n, t in changed.items()}
    rows = {name: Row(name, {**of_visit, **cells[name]}) for name in changed if name not in errors}
    roles = Sheet(ROLE, ("subject", "visit", ROLE), tuple(r for n, r in rows.items() if n == ROLE))
    scores = Sheet("scores", SCORE_COLUMNS, tuple(r for n, r in rows.items() if n != ROLE))
    # Similar codes are asked about at registration, not at the entry of a score.
    found = import_rows([s for s in (roles, scores) if s.rows], dry_run=bool(errors), distinct_codes=True)
    errors |= {line.where: line.errors[0] for line in found.lines if line.errors}
    if errors:
        return (), errors
    for name, text in changed.items():
        kind, about = (ROLE, {}) if name == ROLE else ("score", {"instrument": name})
        was, after = ({"value": now.stored(name, v)} for v in (now.values[name], text))
        record(kind, by, about, was, after, reason, session_id=now.session_id)
    return tuple(changed), {}


def _write(now: Form, changed: Mapping[str, str], by: str, reason: str) -> None:
    """Write values that were checked, each with its row of Decision; day, aid and orthosis are written before."""
    for name, text in changed.items():
        kind, _, number = name.partition(":")
        if name == "height_m":
            set_height(now.subject, _number(name, text) if text else None)
        elif name == "mass_kg":
            set_mass(now.session_id, _number(name, text) if text else None)
        elif name == "population":
            set_population(now.subject, text or "unknown")
        elif number:
            set_condition(int(number), **{kind: text or "unknown"})
        was, after = ({"value": now.stored(name, v)} for v in (now.values[name], text))
        of = {"video_id": int(number)} if number else {"session_id": now.session_id}
        record(_KINDS[kind], by, {}, was, after, reason, **of)
    of_all = {"subject": now.subject} if "height_m" in changed else {"session_id": now.session_id}
    for visit in (session.Session & of_all).to_arrays("session_id"):
        queue_visit(int(visit))


def _stripped(values: Mapping[str, str]) -> dict[str, str]:
    return {name: code_of(CODED.get(name, ""), text.strip()[:1000]) for name, text in values.items()}


def _check(given: Mapping[str, str], checks: Mapping[str, Callable[[str], Any]], errors: dict[str, PblError]) -> None:
    """Add the error of each value that its check refuses."""
    for name, text in given.items():
        try:
            checks[name](text)
        except PblError as error:
            errors[name] = error


def _number(name: str, text: str) -> float:
    what = _KINDS[name]
    value = number_of(Row(what, {}), what, text[:40])
    _NUMBERS[name](value)
    return value


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
