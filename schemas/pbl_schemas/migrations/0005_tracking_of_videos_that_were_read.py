"""Tracking refers to the VideoInfo that it reads: deleted, it takes along what was computed from it.

Rows without one, left behind when `pbl reprocess --table VideoInfo` deleted it, are deleted with all below; once the
recording is read again they are computed again.
"""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.operations.catalog import quote


def statements(conn: Any) -> list[str]:
    """Delete the rows without a VideoInfo, in one transaction, then add the foreign key."""
    name = connection.schema_name("tracking"), "__tracking"
    there = conn.query(
        "SELECT SUM(referenced_table_name <=> '__video_info') FROM information_schema.key_column_usage"
        " WHERE table_schema = %s AND table_name = %s",
        args=name,
    ).fetchone()[0]
    if there is None or there:  # no such table yet, or it has the foreign key
        return []
    table, info = _tables()
    left = conn.query(_unread("video_id, tracking_method"))
    keys = [dict(zip(("video_id", "tracking_method"), row, strict=True)) for row in left.fetchall()]
    deletes = []
    if keys:
        conn.dependencies.load(force=True)  # tables that this upgrade has just created are among those below
        cascade = dj.Diagram.cascade(dj.FreeTable(conn, table) & keys, part_integrity="cascade")
        deletes = [f"DELETE FROM {t.full_table_name}{t.where_clause()}" for t in reversed(cascade) if len(t)]  # noqa: S608
        deletes = ["START TRANSACTION", *deletes, "COMMIT"]
    return [
        *deletes,
        f"ALTER TABLE {table} ADD FOREIGN KEY (video_id) REFERENCES {info} (video_id)"
        " ON UPDATE CASCADE ON DELETE RESTRICT",
    ]


def changed(conn: Any) -> list[tuple[str, str]]:
    """Set and gait_method ("": all) of the results that are computed again."""
    members = quote(connection.schema_name("fit"), "fit_set__video")
    sets = conn.query(f"SELECT DISTINCT fit_set FROM {members} WHERE video_id IN ({_unread('video_id')})")  # noqa: S608
    return [(str(name), "") for (name,) in sets.fetchall()]


def _unread(columns: str) -> str:
    table, info = _tables()
    return f"SELECT {columns} FROM {table} WHERE video_id NOT IN (SELECT video_id FROM {info})"  # noqa: S608


def _tables() -> tuple[str, str]:
    return (
        quote(connection.schema_name("tracking"), "__tracking"),
        quote(connection.schema_name("video"), "__video_info"),
    )
