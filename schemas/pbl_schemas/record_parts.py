"""Part tables whose rows are records of the library, below the row of the result that has them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pbl_pipeline.records import definition, from_row, to_row

from .datajoint_setup import dj
from .rows import Rows, stored_rows


class Records:
    """Methods of a part table of records: they know the class and the prefix of its columns."""

    record: Any
    prefix: str

    @classmethod
    def insert_records(cls: Any, key: Mapping[str, Any], records: Iterable[Any]) -> None:
        """Insert records of the result with this key."""
        cls.insert({**key, **to_row(record, cls.prefix)} for record in records)

    @classmethod
    def records(cls, key: Any, rows: Rows = stored_rows) -> list[Any]:
        """Return the records of the results that agree with a key, in the order of the table's own key."""
        return [from_row(cls.record, row, cls.prefix) for row in rows(cls, key)]


def part_of(name: str, record: type, prefix: str = "", comment: str = "", of: tuple[str, ...] = ("master",)) -> Any:
    """Return a part table of this name of records of a class; `prefix`: of its columns; `of`: tables in its key."""
    lines = "\n".join([f"# {comment}"] * bool(comment) + [f"-> {table}" for table in of] + [definition(record, prefix)])
    return type(dj.Part)(name, (Records, dj.Part), {"definition": lines, "record": record, "prefix": prefix})
