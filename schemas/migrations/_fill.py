"""A new column that may not be null, in a table that has rows."""

from __future__ import annotations

import re
from typing import Any

from schemas._differences import declaration, server_columns


def fill(conn: Any, table: Any, column: str, value: str) -> list[str]:
    """Statements that add a column and give the rows that are there a value; what of it is done already is left out.

    Parameters
    ----------
    table
        An instance of the table's class.
    column
        A column of its declaration. Where a later version no longer declares it there is nothing to do.
    value
        SQL expression of the value for the rows that are there: what is true of them, never a guess.
    """
    found = server_columns(conn, table.database, table.table_name)
    sql = declaration(conn, table)[1].get(column)
    if not found or sql is None or (column in found and not found[column].nullable):
        return []
    name = table.full_table_name
    may_be_null = re.sub(r"\bNOT NULL\b", "NULL", sql, count=1)
    added = [] if column in found else [f"ALTER TABLE {name} ADD COLUMN {may_be_null}"]
    update = f"UPDATE {name} SET `{column}` = {value} WHERE `{column}` IS NULL"  # noqa: S608  written in a migration
    return [*added, update, f"ALTER TABLE {name} MODIFY COLUMN {sql}"]
