"""Whether the errors of a joint are normally distributed."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection


def statements(conn: Any) -> list[str]:
    """The column `joint_normal_p` of KinematicError.Joint: null of errors that were computed before."""
    schema, table = connection.schema_name("validation"), "__kinematic_error__joint"
    rows = conn.query(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s",
        args=(schema, table),
    )
    there = {str(row[0]) for row in rows.fetchall()}
    if not there or "joint_normal_p" in there:
        return []
    comment = ":float64:(0..1) p of Shapiro-Wilk of the errors of the frames, or null"
    column = f"joint_normal_p DOUBLE NULL COMMENT '{comment}' AFTER joint_within_90"
    return [f"ALTER TABLE `{schema}`.`{table}` ADD COLUMN {column}"]
