"""Rows that agree with a key, and deletion of rows with their dependent results."""

from __future__ import annotations

import datetime
import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import pymysql

from pbl_pipeline.errors import PblError

from .datajoint_setup import REPEAT, columns_read_once, decode_attribute, dj

T = TypeVar("T")
#: Values in one restriction: a statement stays short however many there are.
PART = 500

#: Function that returns the rows of a table that agree with a key, in the order of the table's own key: `stored_rows`
#: asks the database each time, `ReadAhead` for many keys at once.
Rows = Callable[[Any, Mapping[str, Any]], list[dict[str, Any]]]


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


class MadeOnce:
    """Decorator of a function that makes a query of a table (class): called once, and again where the tables have
    another connection since. DataJoint takes milliseconds to put a query of several tables together."""

    def __init__(self, make: Callable[[Any], Any]) -> None:
        self._make, self.made = make, dict[Any, Any]()
        functools.update_wrapper(self, make)

    def __call__(self, table: Any) -> Any:
        if table not in self.made or self.made[table].connection is not table().connection:
            self.made[table] = self._make(table)
        return self.made[table]


def one(query: Any, *columns: str) -> Any:
    """`query.fetch1(*columns)` for what a computation reads. Raises InputChanged if there is no such row (any
    longer)."""
    try:
        return query.fetch1(*columns)
    except dj.DataJointError:
        if len(query):
            raise
        raise InputChanged(f"no row of {query.from_clause()} for this key") from None


def stored_rows(table: Any, key: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a table that agree with a key, in the order of its primary key."""
    rows = list((table & key & dj.Top(None, "KEY")).cursor(as_dict=True))
    # DataJoint's own `to_dicts` looks at each value for what to decode: three times as long where there is nothing.
    for name, column in table.heading.attributes.items():
        if column.codec or column.json or column.uuid:
            for row in rows:
                row[name] = decode_attribute(column, row[name], squeeze=False, connection=table.connection)
    return rows


def row_of(table: Any, key: Any, rows: Rows = stored_rows) -> dict[str, Any]:
    """Return the only row of a table that agrees with a key, or with a query where `stored_rows` reads it. Raises
    `PblError` DB_NOT_FOUND for none, USAGE for several."""
    found = rows(table, key)
    if len(found) == 1:
        return found[0]
    raise PblError(
        "USAGE" if found else "DB_NOT_FOUND",
        key=f"{table.__name__} {dict(key) if isinstance(key, Mapping) else 'of the query'}",
        found=f"{len(found)} rows",
        expected="one row",
        next_step="name more columns of the table's key" if found else "`pbl status` shows what is computed",
    )


class ReadAhead:
    """Rows of several results of sets, with one question to the database for each table.

    keys: rows with `fit_set` and, where they are known, the methods; videos: numbers of all videos of these sets. Holds
    the rows of every table that was asked for: for some dozen visits at a time.
    """

    def __init__(self, keys: Sequence[Mapping[str, Any]], videos: Iterable[int]) -> None:
        first = keys[0] if keys else {}
        self._common = {k: v for k, v in first.items() if all(key.get(k) == v for key in keys)}
        self._values = {"fit_set": {str(key["fit_set"]) for key in keys}, "video_id": {int(v) for v in videos}}
        self._tables: dict[tuple, dict[tuple, list[dict[str, Any]]]] = {}
        self._names: dict[Any, frozenset[str]] = {}

    def __call__(self, table: Any, key: Mapping[str, Any]) -> list[dict[str, Any]]:
        if table not in self._names:
            self._names[table] = frozenset(table.heading.names)
        names = self._names[table]
        column = next((c for c in self._values if c in names), None)
        if column is None:  # no result: a method or a norm, the same for many
            return self._grouped((table, *key.items()), (), lambda: stored_rows(table, key))[()]
        by = tuple(c for c in self._values if c in names and c in key)
        all_rows = functools.partial(self._grouped, (table,), (), lambda: self._read(table, column, names))
        own = self._grouped((table, by), by, lambda: all_rows()[()])
        return [r for r in own.get(tuple(key[c] for c in by), ()) if all(r[k] == v for k, v in key.items() if k in r)]

    def _read(self, table: Any, column: str, names: frozenset[str]) -> list[dict[str, Any]]:
        common = {k: v for k, v in self._common.items() if k in names and k not in self._values}
        return stored_rows(table & inside(column, self._values[column]), common)

    def _grouped(
        self, name: tuple, by: tuple[str, ...], read: Callable[[], list[dict[str, Any]]]
    ) -> dict[tuple, list[dict[str, Any]]]:
        if name not in self._tables:
            groups = grouped((tuple(row[c] for c in by), row) for row in read())
            self._tables[name] = groups if groups or by else {(): []}
        return self._tables[name]


def grouped(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, list[Any]]:
    """Return the second ones of pairs in lists by the first, both in the order in which they come."""
    out: dict[Any, list[Any]] = {}
    for key, value in pairs:
        out.setdefault(key, []).append(value)
    return out


def insert_in_parts(table: Any, rows: Iterable[Any], **options: Any) -> None:
    """Insert any number of rows, at most `PART` in a statement: all or none only in a transaction of the caller's."""
    for some in parts(rows):
        table.insert(some, **options)


def exist(*queries: Any) -> list[bool]:
    """Return for each query whether it has rows, by one statement."""
    each = ", ".join(f"EXISTS ({query.make_sql()})" for query in queries)
    return [bool(n) for n in queries[0].connection.query(f"SELECT {each}").fetchone()] if queries else []


def utc_now() -> datetime.datetime:
    """Return the time in UTC by the clock of the database server for a datetime column: one clock for all machines."""
    return dj.conn().query("SELECT UTC_TIMESTAMP()").fetchone()[0]


def moment(at: datetime.datetime | str) -> str:
    """Return a moment (UTC if it has no zone) as the clock of this machine shows it, to the minute."""
    at = datetime.datetime.fromisoformat(at) if isinstance(at, str) else at
    zoned = at if at.tzinfo else at.replace(tzinfo=datetime.UTC)
    return f"{zoned.astimezone():%Y-%m-%d %H:%M}"


def parts(values: Iterable[T]) -> Iterator[list[T]]:
    """Yield the values, `PART` at a time."""
    rest = iter(values)
    while part := list(itertools.islice(rest, PART)):
        yield part


def rows_inside(query: Any, column: str, values: Iterable[str | int]) -> list[dict[str, Any]]:
    """Return the rows of a query with one of the values (as of `inside`), `PART` values a statement."""
    return [row for some in parts(dict.fromkeys(values)) for row in (query & inside(column, some)).to_dicts()]


def inside(column: str, values: Iterable[str | int]) -> Any:
    """Return a restriction to values without quotes (codes and numbers); of more than `PART` read in `parts`."""
    listed = ", ".join(f"'{v}'" if isinstance(v, str) else str(v) for v in values)
    return f"{column} IN ({listed})" if listed else False


def counted(deleted: Mapping[str, int]) -> str:
    """Numbers of deleted rows by table (`delete_below`) in words."""
    return ", ".join(f"{n} of {name}" for name, n in deleted.items())


#: Times that a cascade is begun again where another process inserts below it, or holds its locks, meanwhile.
_DELETES = 5


@columns_read_once()
def delete_below(table: Any, keys: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Delete the rows with these keys and all dependent results, in one transaction. Returns table name to
    number of deleted rows, empty when there was nothing."""
    if not keys:
        return {}
    # As plain keys: a cascade from a restriction by subqueries fails in DataJoint 2.3.5 ("attribute not found").
    target = table & list(keys)
    counts = {name: n for name, n in dj.Diagram.cascade(target, part_integrity="cascade").counts().items() if n}
    for attempt in range(_DELETES):
        try:
            target.delete(prompt=False, part_integrity="cascade")
            break
        except pymysql.err.OperationalError as error:
            # In a transaction that is open who opened it begins again (`pbl_schemas.transactions.repeated`).
            if attempt == _DELETES - 1 or error.args[0] not in REPEAT or target.connection.in_transaction:
                raise
        except dj.DataJointError as error:
            # A worker inserted a row below one that is deleted, after its table's turn; the row above is locked now.
            if attempt == _DELETES - 1 or not str(error).startswith("Delete blocked"):
                raise
            if target.connection.in_transaction:  # it keeps seeing the tables as they were
                raise pymysql.err.OperationalError(REPEAT[0], str(error)) from error
    return counts
