"""Values of columns, and rows that go with all that was computed from them."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError

from ._datajoint import dj


class InputChanged(PblError):
    """Rows that a computation reads are gone or other ones: it is tried again, a few times."""

    def __init__(self, found: str, key: object = None) -> None:
        super().__init__(
            "INPUT_CHANGED",
            found=found,
            expected="the rows that were there when the job was queued",
            next_step="`pbl retry` once the row is there again (`pbl db restore`, `pbl ingest`, or another method)",
            key=key,
        )


def one(query: Any, *columns: str) -> Any:
    """`query.fetch1(*columns)` for what a computation reads.

    Raises
    ------
    InputChanged
        There is no such row (any more).
    """
    try:
        return query.fetch1(*columns)
    except dj.DataJointError:
        if len(query):
            raise
        raise InputChanged(f"no row of {query.from_clause()} for this key") from None


def utc_now() -> datetime.datetime:
    """Now in UTC, whole seconds, without zone: what a datetime column takes."""
    return datetime.datetime.now(datetime.UTC).replace(tzinfo=None, microsecond=0)


def number(value: Any) -> float | None:
    """A float for a nullable column: None where the value is missing or not finite."""
    if value is None:
        return None
    value = float(value)
    return value if np.isfinite(value) else None


def plain(value: Any) -> Any:
    """Mappings and tuples as dicts and lists of plain numbers: what a json column takes."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    return value


def inside(column: str, values: Iterable[str | int]) -> Any:
    """A restriction to values that hold no quotes (codes and numbers), quick for thousands."""
    listed = ", ".join(f"'{v}'" if isinstance(v, str) else str(v) for v in values)
    return f"{column} IN ({listed})" if listed else False


def delete_below(table: Any, keys: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Delete the rows with these keys and all that was computed from them, in one transaction.

    Returns table name to number of deleted rows, empty when there was nothing.
    """
    if not keys:
        return {}
    # As plain keys: a cascade from a restriction by subqueries fails in DataJoint 2.3.5 ("attribute not found").
    target = table & list(keys)
    counts = {name: n for name, n in dj.Diagram.cascade(target, part_integrity="cascade").counts().items() if n}
    target.delete(prompt=False, part_integrity="cascade")
    return counts
