"""The session in the rows of what was computed from a fit, so that a join with `Session` is not every pair."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection

#: Stage, table and the last column of its key.
_TABLES = (
    ("fit", "__session_fit", "fit_method"),
    ("gait", "__gait_events", "gait_method"),
    ("gait", "__gait_cycle", "gait_method"),
    ("gait", "__spatiotemporal", "gait_method"),
    ("gdi", "__g_d_i", "norm"),
    ("gdi", "__session_gdi", "norm"),
    ("qc", "__session_qc", "norm"),
    ("validation", "__kinematic_error", "reference"),
)


def statements(conn: Any) -> list[str]:
    """The column `session_id` after the key, filled from the set of the row, then closed and bound to `Session`."""
    out = []
    sets = f"`{connection.schema_name('fit')}`.`fit_set`"
    sessions = f"`{connection.schema_name('session')}`.`session`"
    for stage, name, last in _TABLES:
        schema = connection.schema_name(stage)
        table = f"`{schema}`.`{name}`"
        column = conn.query(
            "SELECT is_nullable FROM information_schema.columns "
            "WHERE table_schema = %s AND table_name = %s AND column_name = 'session_id'",
            args=(schema, name),
        ).fetchone()
        bound = conn.query(
            "SELECT 1 FROM information_schema.key_column_usage WHERE table_schema = %s AND table_name = %s "
            "AND column_name = 'session_id' AND referenced_table_name IS NOT NULL",
            args=(schema, name),
        ).fetchone()
        if column is None:
            out.append(f"ALTER TABLE {table} ADD COLUMN session_id INT NULL AFTER `{last}`")
        if column is None or column[0] == "YES":
            out += [
                f"UPDATE {table} AS r JOIN {sets} AS s USING (fit_set) SET r.session_id = s.session_id",  # noqa: S608
                f"ALTER TABLE {table} MODIFY COLUMN session_id INT NOT NULL",
            ]
        if not bound:
            out.append(
                f"ALTER TABLE {table} ADD FOREIGN KEY (session_id) REFERENCES {sessions} (session_id) "
                "ON UPDATE CASCADE ON DELETE RESTRICT"
            )
    return out
