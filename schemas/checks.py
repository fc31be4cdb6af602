"""Quality checks of the library as rows of a part table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .rows import number

if TYPE_CHECKING:
    from pbl_pipeline.qc import Check


def check_columns(prefix: str) -> str:
    """Definition lines of a part table of quality checks; the names carry the prefix for the same reason."""
    return f"""
    -> master
    {prefix}_check           : varchar(64)       # name, with its unit
    ---
    {prefix}_check_outcome   : enum('PASS', 'WARN', 'EMPTY', 'NEEDS_CHOICE', 'FAIL')
    {prefix}_check_value=null     : float64      # in the unit (see {prefix}_check)
    {prefix}_check_threshold=null : float64      # in the unit (see {prefix}_check)
    {prefix}_check_advice    : varchar(1000)     # what to do about it
    """


def check_row(prefix: str, check: Check) -> dict[str, Any]:
    """A library `Check` as values of `check_columns(prefix)`."""
    return {
        f"{prefix}_check": check.check,
        f"{prefix}_check_outcome": check.outcome,
        f"{prefix}_check_value": number(check.value),
        f"{prefix}_check_threshold": number(check.threshold),
        f"{prefix}_check_advice": check.advice[:1000],
    }


def check_values(prefix: str, row: Mapping[str, Any]) -> tuple:
    """The arguments of the library's `Check` from a row of `check_columns(prefix)`."""
    return tuple(row[f"{prefix}_check{end}"] for end in ("", "_outcome", "_value", "_threshold", "_advice"))
