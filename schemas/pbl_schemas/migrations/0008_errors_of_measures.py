"""The error of each gait measure of a visit."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection

_UNIT = ":float64:in the unit (see session_measure):"
#: Column -> its comment and the column before it.
_COLUMNS = {
    "session_measure_error": (f"{_UNIT} standard deviation of the error of the mean", "session_measure_missing"),
    "session_measure_minimal_change": (f"{_UNIT} minimal detectable change (90 percent)", "session_measure_error"),
}


def statements(conn: Any) -> list[str]:
    """The columns of SessionGdi.Measure: null of visits that were measured before, until they are computed again."""
    schema, table = connection.schema_name("gdi"), "__session_gdi__measure"
    rows = conn.query(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s",
        args=(schema, table),
    )
    there = {str(row[0]) for row in rows.fetchall()}
    return [
        f"ALTER TABLE `{schema}`.`{table}` ADD COLUMN {name} DOUBLE NULL COMMENT '{comment}' AFTER {before}"
        for name, (comment, before) in _COLUMNS.items()
        if there and name not in there
    ]
