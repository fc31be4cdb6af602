"""Transactions that are run again where two processes insert the same, and numbers that are given once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from . import lab
from .datajoint_setup import DuplicateError, dj

T = TypeVar("T")

_ATTEMPTS = 20


def in_transaction(work: Callable[[], T], until: Callable[[], bool] = lambda: False) -> T:
    """Run `work` in a transaction; again where another process inserted the same at that moment, unless `until` holds
    then."""
    for attempt in range(_ATTEMPTS):
        try:
            with lab.schema.connection.transaction:  # type: ignore[union-attr]
                return work()
        except DuplicateError:
            if until() or attempt == _ATTEMPTS - 1:
                raise
    raise AssertionError("unreachable")


def next_id(table: Any, attribute: str, n: int = 1) -> int:
    """The first of n numbers that no row of the table has or has had. Inside a transaction others wait for its end."""
    highest = dj.U().aggr(table, highest=f"max({attribute})").fetch1("highest") or 0
    table.connection.query(
        f"INSERT INTO {lab.Numbered.full_table_name} VALUES (%s, %s)"  # noqa: S608
        " ON DUPLICATE KEY UPDATE numbered_last = GREATEST(numbered_last, %s) + %s",
        args=(attribute, int(highest) + n, int(highest), n),
    )
    return int((lab.Numbered & {"numbered": attribute}).fetch1("numbered_last")) - n + 1
