"""Visits: the recordings of one subject that share one body."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import normalised_label

from . import lab  # noqa: F401  the definition refers to it
from .datajoint_setup import dj

schema = dj.Schema()

#: Label of the session of videos that were ingested without one.
UNLABELLED = "unlabelled"


@schema
class Session(dj.Manual):
    definition = """
    # a visit: its videos are fitted together with one body
    session_id          : int32
    ---
    -> lab.Subject
    session_label       : varchar(64)          # date (YYYY-MM-DD) or the lab's own label
    session_date=null   : date                 # when recorded, null when unknown
    session_created     : datetime             # when registered, UTC
    unique index (subject, session_label)
    """


@schema
class BodyMass(dj.Manual):
    definition = """
    # body mass of the person at a visit; a visit without a row: not known
    -> Session
    ---
    body_mass           : float64              # (kg)
    """


def by_label(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], Mapping[str, Any]]:
    """Return rows of Session by subject and label: as it is stored and, where no other row has it, normalised."""
    out = {(r["subject"], r["session_label"]): r for r in rows}
    for (subject, label), row in tuple(out.items()):
        out.setdefault((subject, normalised_label(label)), row)
    return out


def as_registered(restriction: Mapping[str, Any]) -> dict[str, Any]:
    """Return a restriction with its `subject` normalised, and its `session_label` as it is stored."""
    out = {k: normalised_label(v) if k == "subject" and isinstance(v, str) else v for k, v in restriction.items()}
    if isinstance(given := out.get("session_label"), str):
        label = normalised_label(given)
        of_person = Session & {k: v for k, v in out.items() if k == "subject"}
        same = [stored for stored in of_person.to_arrays("session_label") if normalised_label(stored) == label]
        out["session_label"] = next((one for one in (given, label) if one in same), min(same, default=label))
    return out


def lock(session_id: int) -> None:
    """Have every other transaction that locks this visit wait until the present one ends."""
    table = Session.full_table_name  # DataJoint's own name, quoted; the number is an argument
    Session.connection.query(f"SELECT session_id FROM {table} WHERE session_id = %s FOR UPDATE", args=(session_id,))  # noqa: S608


def registered_visit(session_id: int) -> dict[str, Any]:
    """Return the row of Session of a number. Raises `PblError` DB_NOT_FOUND for a number that no visit has."""
    rows = (Session & {"session_id": session_id}).to_dicts()
    if not rows:
        next_step = "`pbl list visits` prints the numbers"
        raise PblError("DB_NOT_FOUND", f"no session_id {session_id}", "a registered visit", next_step)
    return rows[0]
