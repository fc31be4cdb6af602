"""Checks of every form over the stored values of a visit: its fields, whether something else was stored meanwhile, and
which values differ."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from pbl_pipeline.errors import PblError

from ..decisions.review_decisions import Decided, decisions
from ..intake.sheets import Row, number_of


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


def is_stored(text: str, stored: str, numeric: bool) -> bool:
    """Return whether a text is what is stored, of a number also written otherwise: 1,80 or 1.80 for 1.8."""
    if text == stored or not (numeric and text and stored):
        return text == stored
    try:
        return number_of(Row("", {}), "", text) == float(stored)
    except PblError:
        return False


def stored_value(text: str, numeric: bool) -> Any:
    """Return what is stored of a field, None where there is nothing."""
    return number_of(Row("", {}), "", text) if text and numeric else text or None
