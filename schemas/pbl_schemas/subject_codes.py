"""Pseudonymous codes of people, and the day that a session's label names."""

from __future__ import annotations

import datetime
import re

from pbl_pipeline.errors import PblError

#: Form of a pseudonymous code.
SUBJECT_CODE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")


def check_subject(code: str, next_step: str, key: object = None) -> None:
    """Raise USAGE for a text that is not a pseudonymous code; `next_step` and `key` are those of the error."""
    if not SUBJECT_CODE.fullmatch(code):
        raise PblError(
            "USAGE",
            found=f"subject code {code[:50]!r}",
            expected="a pseudonymous code of letters, digits, '-', '_' and '.', at most 32 long (never a name)",
            next_step=next_step,
            key=key,
        )


def iso_label(label: str) -> str:
    """Return a label that is a day as D.M.YYYY in the form YYYY-MM-DD; others as they are."""
    match = re.fullmatch(r"(\d\d?)\.(\d\d?)\.(\d{4})", label)
    return f"{match[3]}-{int(match[2]):02}-{int(match[1]):02}" if match else label


def day_of(label: str) -> datetime.date | None:
    """Return the day in a session's label (ISO, such as YYYY-MM-DD, also with a time, or D.M.YYYY); None for any other
    text."""
    try:
        return datetime.datetime.fromisoformat(iso_label(label)).date()
    except ValueError:
        return None


def folded(code: str) -> str:
    """Return a code without case, hyphens and leading zeros: codes that agree then are likely of one person."""
    return re.sub(r"0*(\d+)", r"\1", re.sub(r"[-_.]", "", code.lower()))
