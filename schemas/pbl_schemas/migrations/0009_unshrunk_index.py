"""The index without people's distribution as prior knowledge, of trials and visits."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection

_MEANING = ":float64:(-) not drawn towards the mean of people: for correlations and means over people"
#: Table -> its prefix of the columns.
_TABLES = {"__g_d_i": "gdi", "__session_gdi": "session_gdi"}


def statements(conn: Any) -> list[str]:
    """The columns of GDI and SessionGdi: null of visits that were measured before, until they are computed again."""
    schema, out = connection.schema_name("gdi"), []
    for table, prefix in _TABLES.items():
        rows = conn.query(
            "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s",
            args=(schema, table),
        )
        there = {str(row[0]) for row in rows.fetchall()}
        columns = {
            f"{prefix}_unshrunk": (_MEANING, f"{prefix}_minimal_change"),
            f"{prefix}_unshrunk_sd": (
                f":float64:(-) standard deviation of the error of {prefix}_unshrunk",
                f"{prefix}_unshrunk",
            ),
        }
        out += [
            f"ALTER TABLE `{schema}`.`{table}` ADD COLUMN {name} DOUBLE NULL COMMENT '{comment}' AFTER {before}"
            for name, (comment, before) in columns.items()
            if there and name not in there
        ]
    return out
