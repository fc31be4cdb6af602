"""Columns that a migration adds to a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pbl_schemas import connection

_SQL = {"float64": "DOUBLE", "bool": "TINYINT"}


def added(conn: Any, stage: str, table: str, columns: Mapping[str, tuple[str, str, str]]) -> list[str]:
    """Return the statements that add nullable columns to a table, those that it has left out; none without the table.

    columns: name -> type (such as `float64`), comment, and the column after which it stands.
    """
    schema = connection.schema_name(stage)
    rows = conn.query(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s",
        args=(schema, table),
    )
    there = {str(row[0]) for row in rows.fetchall()}
    add = f"ALTER TABLE `{schema}`.`{table}` ADD COLUMN"
    return [
        f"{add} {name} {_SQL.get(kind, kind)} NULL COMMENT ':{kind}:{comment}' AFTER {before}"
        for name, (kind, comment, before) in columns.items()
        if there and name not in there
    ]
