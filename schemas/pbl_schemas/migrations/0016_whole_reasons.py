"""Reasons in whole: 100 to 255 characters did not hold them all."""

from __future__ import annotations

import re
from typing import Any

from pbl_schemas import connection

_WIDER = {
    "keypoints": ("camera_source", "phone_log"),
    "gait": ("cycle_lengths_missing", "curves_missing", "measure_missing"),
    "gdi": ("session_measure_missing",),
    "kinetics": ("forces_reason", "trial_forces_reason", "forces_missing", "force_missing"),
    "privacy": ("deidentified_reason",),
}


def statements(conn: Any) -> list[str]:
    """Give the columns of reasons 1000 characters, for which the server writes no row anew."""
    rows = conn.query(
        "SELECT table_schema, table_name, column_name, is_nullable, column_default, column_comment"
        " FROM information_schema.columns WHERE character_maximum_length < 1000 AND table_schema IN %s"
        " ORDER BY table_schema, table_name, ordinal_position",
        args=([connection.schema_name(stage) for stage in _WIDER],),
    ).fetchall()
    wider = {(connection.schema_name(stage), name) for stage, names in _WIDER.items() for name in names}
    out = []
    for schema, table, name, nullable, default, comment in rows:
        if (schema, name) in wider:
            null = "NULL" if nullable == "YES" else "NOT NULL" if default is None else "NOT NULL DEFAULT ''"
            said = re.sub(r"^:varchar\(\d+\):", ":varchar(1000):", comment).replace("'", "''")
            change = f"MODIFY COLUMN {name} VARCHAR(1000) {null} COMMENT '{said}'"
            out.append(f"ALTER TABLE `{schema}`.`{table}` {change}")
    return out
