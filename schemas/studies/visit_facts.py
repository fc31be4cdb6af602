"""Registration of a visit by a form, and what is stated of its person and recordings; each change a row of Decision."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_height, check_label, check_mass

from .. import lab, session, study, video
from ..decisions.review_decisions import Decided, decisions, record
from ..intake.records import replace_height, replace_mass, set_condition, set_population
from ..intake.sheets import Row, Sheet, conflict, date_of, number_of, refused
from ..subject_codes import check_subject
from ..transactions import in_transaction
from .study_sheets import CLEAR, COLUMNS, import_rows


def check_fields(session_id: int, given: Iterable[str], known: Collection[str], expected: str) -> None:
    """Raise `PblError` USAGE for a field that the form does not have."""
    if unknown := sorted(set(given) - set(known)):
        raise PblError(
            "USAGE",
            found=f"a field {unknown[0][:64]!r}",
            expected=expected,
            next_step="load the form again",
            key=f"session_id={session_id}",
        )


def last_decision(session_id: int, kinds: Collection[str]) -> Decided | None:
    """Return the newest decision of these kinds about a visit; None where there is none."""
    return next((d for d in decisions(session_id) if d.what in kinds), None)


def decided_meanwhile(session_id: int, last: Decided | None, did: str) -> PblError:
    """DECIDED_MEANWHILE for a form that was loaded before `last`, whose person `did` that; None: an import."""
    who = "it was imported" if last is None else f"{last.by} {did} at {last.at} UTC"
    return PblError(
        "DECIDED_MEANWHILE",
        found=f"since this form was loaded something else is stored: {who}",
        expected="what the form showed; nothing of yours was written",
        next_step="load the form again, look at what is stored, and enter then",
        key=f"session_id={session_id}",
    )


#: Fields of a new visit: column of a sheet of `pbl study import`, and the most characters.
NEW = {"subject": 32, "visit": 64, "date": 10, "role": 32, "population": 32}
#: Field by which a person confirms that a code that is like another one is of another person.
DISTINCT = "distinct"
#: Fields of a registered visit and the most characters; height (m) and population are of the person.
FACTS = {"height_m": 10, "mass_kg": 10, "population": 32, "assistive_device": 64, "orthosis": 64}
#: What the names of the fields of a recording begin with; its video_id follows.
ACTIVITY, PACE = "activity:", "pace:"
_NUMBERS = ("height_m", "mass_kg")
#: Kind of decision by the first part of a field's name.
_KINDS = {
    "height_m": "height",
    "mass_kg": "mass",
    "population": "population",
    "assistive_device": "aid",
    "orthosis": "orthosis",
    "activity": "activity",
    "pace": "pace",
}


@dataclasses.dataclass(frozen=True)
class Facts:
    """What is stored of a visit, as a form shows it. values: by field, those of the recordings included, empty where
    nothing is stored; recordings: name by video_id; seen: another text after each change."""

    session_id: int
    subject: str
    label: str
    values: dict[str, str]
    recordings: dict[int, str]
    seen: str


def register_visit(values: Mapping[str, str], by: str) -> tuple[int | None, dict[str, PblError]]:
    """Register a visit, and its person where the code is new.

    Returns the number of the visit, None where nothing was written; errors by field, "" for what is wrong with several.

    Parameters
    ----------
    values
        Text by field: `NEW`, "height_m", and `DISTINCT` ("yes" or empty). Only the first two are needed.
    """
    given = {name: text for name, text in _stripped(values).items() if text}
    return in_transaction(lambda: _register(given, by))


def _register(given: dict[str, str], by: str) -> tuple[int | None, dict[str, PblError]]:
    errors: dict[str, PblError] = {}
    for name in ("subject", "visit"):
        if name not in given:
            errors[name] = refused(name, "nothing", "a value", "write it")
    checks: dict[str, Callable[[str], Any]] = {
        "subject": lambda text: check_subject(text, "write the code of the person"),
        "visit": lambda text: check_label("visit", text, NEW["visit"]),
        "date": lambda text: date_of(Row("date", {"date": text}), "date"),
        "role": _check_role,
        "population": lambda text: check_label("population", text, NEW["population"]),
        "height_m": _height,
    }
    _check({name: given[name] for name in checks if name in given}, checks, errors)
    of_visit = {"subject": given.get("subject", ""), "session_label": given.get("visit", "")}
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
            error = conflict(error.found, error.expected, "correct the code, or tick that they are different people")
        return None, {"": error.with_key(None)}
    number = int((session.Session & of_visit).fetch1("session_id"))
    record("visit", by, {}, {}, {"visit": given["visit"]}, session_id=number)
    before = facts(number).values
    if "height_m" in given and not _same("height_m", given["height_m"], before["height_m"]):
        _write(number, given["subject"], {"height_m": given["height_m"]}, by, before, "")
    return number, {}


def facts(session_id: int) -> Facts:
    """Return what can be stated of a visit. Raises `PblError` DB_NOT_FOUND for an unknown number."""
    rows = (session.Session * lab.Subject & {"session_id": session_id}).to_dicts()
    if not rows:
        raise session.unknown_visit(session_id)
    of_visit = (study.Visit & {"session_id": session_id}).to_dicts()
    masses = (session.BodyMass & {"session_id": session_id}).to_arrays("body_mass")
    values = {
        "height_m": _text(rows[0]["subject_height"]),
        "mass_kg": _text(masses[0] if len(masses) else None),
        "population": "" if rows[0]["population"] == "unknown" else rows[0]["population"],
        **{name: of_visit[0][name] if of_visit else "" for name in ("assistive_device", "orthosis")},
    }
    videos = (video.Video & {"session_id": session_id}).to_dicts(order_by="video_id")
    conditions = video.conditions({"session_id": session_id})
    for row in videos:
        condition = conditions[row["video_id"]]
        values[f"{ACTIVITY}{row['video_id']}"] = condition.activity
        values[f"{PACE}{row['video_id']}"] = condition.pace
    text = json.dumps([session_id, values], sort_keys=True)
    seen = hashlib.sha256(text.encode()).hexdigest()[:16]
    names = {int(row["video_id"]): row["video_name"] for row in videos}
    return Facts(session_id, rows[0]["subject"], rows[0]["session_label"], values, names, seen)


def correct(
    session_id: int, values: Mapping[str, str], by: str, seen: str, reason: str = ""
) -> tuple[tuple[str, ...], dict[str, PblError]]:
    """Bring what is stored of a visit, its person and its recordings to what was entered, all of it or nothing.

    What was computed with another height, mass or walking aid, or pools other recordings now, is deleted and pending
    again.

    Raises `PblError` DB_NOT_FOUND; USAGE for an unknown field; DECIDED_MEANWHILE where another value was stored
    meanwhile.

    Returns the fields that were changed; the errors by field, with any of which nothing was written.

    Parameters
    ----------
    values
        Text by field of `Facts.values`; an empty one removes what is stored. Fields that are not named stay.
    by, reason
        Who entered it, and why (no names).
    seen
        `Facts.seen` of the form that was filled in.
    """
    return in_transaction(lambda: _correct(session_id, _stripped(values), by, seen, reason))


def _correct(
    session_id: int, given: dict[str, str], by: str, seen: str, reason: str
) -> tuple[tuple[str, ...], dict[str, PblError]]:
    session.lock(session_id)  # who enters at the same moment waits here
    now = facts(session_id)
    check_fields(session_id, given, now.values, "a field of the form")
    if now.seen != seen:
        last = last_decision(session_id, _KINDS.values())
        raise decided_meanwhile(session_id, last, "" if last is None else f"changed the {last.what}")
    changed = {name: text for name, text in given.items() if not _same(name, text, now.values[name])}
    checks: dict[str, Callable[[str], Any]] = {
        "height_m": _height,
        "mass_kg": _mass,
        **{n: _label(n, FACTS[n]) for n in ("population", "assistive_device", "orthosis")},
        **{n: _label(n.partition(":")[0], 32) for n in changed if ":" in n},
    }
    errors: dict[str, PblError] = {}
    _check({name: text for name, text in changed.items() if text}, checks, errors)
    worn = {name: changed[name] or CLEAR for name in ("assistive_device", "orthosis") if name in changed}
    if worn and not errors:
        row = Row("form", {"subject": now.subject, "visit": now.label, **worn})
        found = import_rows([Sheet("form", tuple(row.cells), (row,))], distinct_codes=True)
        if found.errors:
            return (), {next(iter(worn)): found.errors[0].with_key(None)}
    if errors:
        return (), errors
    _write(session_id, now.subject, changed, by, now.values, reason)
    return tuple(changed), {}


def _write(
    session_id: int, subject: str, changed: Mapping[str, str], by: str, before: Mapping[str, str], reason: str
) -> None:
    """Write values that were checked, each with its row of Decision; aid and orthosis are written by their caller."""
    for name, text in changed.items():
        kind, _, number = name.partition(":")
        if name == "height_m":
            replace_height(subject, _height(text) if text else None)
        elif name == "mass_kg":
            replace_mass(session_id, _mass(text) if text else None)
        elif name == "population":
            set_population(subject, text or "unknown")
        elif number:
            set_condition(int(number), **{kind: text or "unknown"})
        was, after = ({"value": _stored(name, v)} for v in (before[name], text))
        of = {"video_id": int(number)} if number else {"session_id": session_id}
        record(_KINDS[kind], by, {}, was, after, reason, **of)


def _stripped(values: Mapping[str, str]) -> dict[str, str]:
    return {name: text.strip()[:1000] for name, text in values.items()}


def _check(given: Mapping[str, str], checks: Mapping[str, Callable[[str], Any]], errors: dict[str, PblError]) -> None:
    """Add the error of each value that its check refuses."""
    for name, text in given.items():
        try:
            checks[name](text)
        except PblError as error:
            errors[name] = error


def _label(name: str, longest: int) -> Callable[[str], None]:
    return lambda text: check_label(name, text, longest)


def _check_role(text: str) -> None:
    if not study.is_role(text):
        expected = "baseline, pre, 6_weeks, 3_months, or a word of small letters, digits and _"
        raise refused("role", repr(text[:40]), expected, "write it so")


def _height(text: str) -> float:
    value = number_of(Row("height", {}), "height", text[:40])
    check_height(value)
    return value


def _mass(text: str) -> float:
    value = number_of(Row("mass", {}), "mass", text[:40])
    check_mass(value)
    return value


def _stored(name: str, text: str) -> Any:
    """Return what is stored of a field, None where there is nothing."""
    return number_of(Row(name, {}), name, text) if text and name in _NUMBERS else text or None


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _same(name: str, text: str, stored: str) -> bool:
    """Return whether a text is what is stored, also written otherwise: 1,80 for 1.8."""
    if text == stored or name not in _NUMBERS or not (text and stored):
        return text == stored
    try:
        return number_of(Row(name, {}), name, text[:40]) == float(stored)
    except PblError:
        return False
