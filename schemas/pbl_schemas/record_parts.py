"""Part tables whose rows are records of the library, below the row of the result that has them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from typing import Any

from pbl_pipeline.names import shortened
from pbl_pipeline.records import declared, definition, from_row, to_row
from pbl_pipeline.results.measures import OF_VISIT

from .datajoint_setup import dj
from .rows import Rows, stored_rows


class Records:
    """Methods of a part table of records: they know the class and the prefix of its columns."""

    record: Any
    prefix: str
    number: str  # column that counts the records of a result, from 1; "" if they have their own key

    @classmethod
    def insert_records(cls: Any, key: Mapping[str, Any], records: Iterable[Any]) -> None:
        """Insert records of the result with this key."""
        numbers = ({cls.number: i} if cls.number else {} for i in itertools.count(1))
        cls.insert({**key, **n, **to_row(record, cls.prefix)} for n, record in zip(numbers, records, strict=False))

    @classmethod
    def records(cls, key: Any, rows: Rows = stored_rows, **others: Any) -> list[Any]:
        """Return the records of the results that agree with a key, in the order of the table's own key; `others`: as
        for `from_row`."""
        return [from_row(cls.record, row, cls.prefix, **others) for row in rows(cls, key)]


class Measures:
    """Methods of a part table of measures by name, of which one may be unknown for a reason."""

    record: Any
    prefix: str
    by: str  # column of the name
    without: tuple[str, ...]

    @classmethod
    def insert_measures(
        cls: Any, key: Mapping[str, Any], measures: Mapping[str, Any], reasons: Mapping[str, str]
    ) -> None:
        """Insert the measures (None: not known) of the result with this key."""
        cls.insert(
            {
                **key,
                cls.by: name,
                f"{cls.prefix}_missing": shortened(reasons.get(name, ""), 1000),
                **to_row(measure or cls.record, cls.prefix, cls.without),
            }
            for name, measure in measures.items()
        )

    @classmethod
    def measure(cls, row: Mapping[str, Any]) -> Any:
        """Return the measure of a row; None if it is not known."""
        return None if row[f"{cls.prefix}_mean"] is None else from_row(cls.record, row, cls.prefix)

    @classmethod
    def measures(
        cls, key: Any, order: Iterable[str] = (), rows: Rows = stored_rows
    ) -> tuple[dict[str, Any], dict[str, str]]:
        """Return the measures of a result by name, those of `order` before others, and why one is not known."""
        found = {r[cls.by]: r for r in rows(cls, key)}
        found = {n: found[n] for n in (*order, *found) if n in found}
        missing = {n: str(r[f"{cls.prefix}_missing"]) for n, r in found.items()}
        return {n: cls.measure(r) for n, r in found.items()}, {n: why for n, why in missing.items() if why}


def part_of(
    name: str, record: type, prefix: str = "", comment: str = "", key: str = "", of: tuple[str, ...] = ("master",)
) -> Any:
    """Return a part table of this name of records of a class.

    Parameters
    ----------
    prefix
        Of its columns.
    key
        Line of the definition that stands for the key of the class: a table above, or a column that counts the records.
    of
        Tables whose keys are in its own.
    """
    own = [d.path[0] for d in declared(record) if d.column.key and key]
    lines = [f"# {comment}"] * bool(comment) + [f"-> {table}" for table in of] + [key] * bool(key)
    lines += ["---"] * (bool(key) or not any(d.column.key for d in declared(record)))  # `definition` ends its own key
    number = key.partition(":")[0].strip() if ":" in key else ""
    text = "\n".join([*lines, definition(record, prefix, without=own)])
    return _part(name, Records, {"definition": text, "record": record, "prefix": prefix, "number": number})


def measures_of(record: type, prefix: str, comment: str, by: str, of_visit: bool = False) -> Any:
    """Return a part table `Measure` of measures of a class.

    Parameters
    ----------
    prefix
        Of its columns.
    by
        Name and type of the column with the name of the measure.
    of_visit
        With the columns `OF_VISIT`.
    """
    text = f"""
    # {comment}
    -> master
    {by}  # name, with its unit
    ---
    {definition(record, prefix, OF_VISIT)}
    {prefix}_missing : varchar(1000)  # why it is null
    {definition(record, prefix, only=OF_VISIT) if of_visit else ""}
    """
    own = {"record": record, "prefix": prefix, "by": by.split()[0], "without": () if of_visit else OF_VISIT}
    return _part("Measure", Measures, {"definition": text, **own})


def _part(name: str, methods: type, content: dict[str, Any]) -> Any:
    return type(dj.Part)(name, (methods, dj.Part), content)
