"""Entry of the role of a visit in a study and its clinical scores by a person, each change a row of Decision.

The rows are checked and written as those of a sheet of `pbl study import` are.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pbl_pipeline.errors import PblError

from .. import session, study
from ..decisions.review_decisions import record
from ..intake.sheets import Row, Sheet, refused, with_point
from ..transactions import in_transaction
from .study_sheets import CLEAR, SCORE_COLUMNS, import_rows
from .visit_facts import check_fields, decided_meanwhile, last_decision

#: Name of the field of the role; the others are named by their instruments.
ROLE = "role"
#: Roles that are offered; any word of small letters, digits and underscores can be one.
USUAL_ROLES = (*study.FIRST_ROLES, "6_weeks", "3_months", "6_months", "12_months", "24_months")


@dataclasses.dataclass(frozen=True)
class Entry:
    """What is stored of a visit, as a form shows it. values: by field, empty where there is none; instruments: rows of
    ClinicalInstrument by name; seen: another text after each change."""

    session_id: int
    subject: str
    label: str
    values: dict[str, str]
    instruments: dict[str, dict[str, Any]]
    seen: str


@dataclasses.dataclass(frozen=True)
class Entered:
    """The outcome. changed: the fields that were; errors: by field; with any of them nothing was written."""

    changed: tuple[str, ...]
    errors: dict[str, PblError]


def entry(session_id: int) -> Entry:
    """Return what can be entered about a visit. Raises `PblError` DB_NOT_FOUND for an unknown number."""
    rows = (session.Session & {"session_id": session_id}).to_dicts()
    if not rows:
        raise session.unknown_visit(session_id)
    roles = (study.Visit & {"session_id": session_id}).to_arrays("visit_role")
    scores = (study.ClinicalScore & {"session_id": session_id}).to_dicts()
    stored = {r["instrument"]: f"{r['score_value']:.12g}" for r in scores}
    known = instruments()
    values = {ROLE: str(roles[0]) if len(roles) else "", **{n: stored.get(n, "") for n in known}}
    text = json.dumps([session_id, values], sort_keys=True)
    seen = hashlib.sha256(text.encode()).hexdigest()[:16]
    return Entry(session_id, rows[0]["subject"], rows[0]["session_label"], values, known, seen)


def instruments() -> dict[str, dict[str, Any]]:
    """Return the rows of ClinicalInstrument by name."""
    return {r["instrument"]: r for r in study.ClinicalInstrument().to_dicts(order_by="instrument")}


def enter(session_id: int, values: Mapping[str, str], by: str, seen: str, reason: str = "") -> Entered:
    """Bring what is stored of a visit to what was entered, all of it or nothing.

    Raises `PblError` DB_NOT_FOUND; USAGE for an unknown field; DECIDED_MEANWHILE where another value was stored
    meanwhile. What is wrong with a value is in the result.

    Parameters
    ----------
    values
        Text by field of `Entry.values`; an empty one removes a score. Fields that are not named stay.
    by, reason
        Who entered it, and why (no names).
    seen
        `Entry.seen` of the form that was filled in.
    """
    return in_transaction(lambda: _enter(session_id, values, by, seen, reason))


def _enter(session_id: int, values: Mapping[str, str], by: str, seen: str, reason: str) -> Entered:
    session.lock(session_id)  # who enters at the same moment waits here
    now = entry(session_id)
    check_fields(session_id, values, now.values, "the role or an instrument of ClinicalInstrument")
    if now.seen != seen:
        last = last_decision(session_id, ("role", "score"))
        did = "" if last is None else f"entered {last.about.get('instrument', 'the role')}"
        raise decided_meanwhile(session_id, last, did)
    given = {name: text.strip()[:200] for name, text in values.items()}
    given = {name: text if name == ROLE else with_point(text) for name, text in given.items()}
    changed = {name: text for name, text in given.items() if not _same(text, now.values[name])}
    errors: dict[str, PblError] = {}
    if changed.get(ROLE) == "":
        errors[ROLE] = refused(ROLE, "no role", f"a role, such as {', '.join(USUAL_ROLES[:3])}", "write it")
    of_visit = {"subject": now.subject, "visit": now.label}
    rows = {
        name: Row(name, {**of_visit, **({"role": text} if name == ROLE else _score(name, text))})
        for name, text in changed.items()
        if name not in errors
    }
    roles = Sheet("role", ("subject", "visit", "role"), tuple(r for n, r in rows.items() if n == ROLE))
    scores = Sheet("scores", SCORE_COLUMNS, tuple(r for n, r in rows.items() if n != ROLE))
    # Codes that are alike are a question to who registers people, not to who enters a score.
    found = import_rows([s for s in (roles, scores) if s.rows], dry_run=bool(errors), distinct_codes=True)
    errors |= {line.where: line.errors[0] for line in found.lines if line.errors}
    if errors:
        return Entered((), errors)
    for name, text in changed.items():
        is_role = name == ROLE
        about = {} if is_role else {"instrument": name}
        before, after = ({"value": _stored(v, is_role)} for v in (now.values[name], text))
        record("role" if is_role else "score", by, about, before, after, reason, session_id=session_id)
    return Entered(tuple(changed), {})


def _score(name: str, text: str) -> dict[str, str]:
    return {"instrument": name, "value": text or CLEAR}


def _same(text: str, stored: str) -> bool:
    """Whether a text is what is stored, also written otherwise: 12.0 for 12."""
    if text == stored:
        return True
    try:
        return "_" not in text and float(text) == float(stored)
    except ValueError:
        return False


def _stored(text: str, is_role: bool) -> Any:
    """What is stored of a field: a number of a score, None where there is nothing."""
    if not text:
        return None
    return text if is_role else float(text)
