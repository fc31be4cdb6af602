"""Renames methods whose parameters the code later changed under the same name and version, as happened before 0.1.0.

The old row keeps its parameters and the results that came from them, under `<name>-v<version>-<hash>`; the new
parameters get the usual name. Where such a method is planned for a session, the old plan keeps the old method: new
videos of that session need the new one (`pbl ingest --fit-method` and so on).
"""

from __future__ import annotations

from typing import Any

from pymysql.converters import escape_string

from schemas import fit, gait, gdi, keypoints, tracking
from schemas._base import method_key
from schemas._dump import quote


def statements(conn: Any) -> list[str]:
    """What is still to be done."""
    from pbl_pipeline import fit as fits
    from pbl_pipeline import gait as gaits
    from pbl_pipeline import keypoints as points
    from pbl_pipeline import tracking as tracks

    out: list[str] = []
    for table, prefix, paramsets in (
        (tracking.TrackingMethod, "tracking", tracks.PARAMSETS),
        (tracking.SubjectMethod, "subject", tracks.SUBJECT_PARAMSETS),
        (keypoints.KeypointMethod, "keypoint", points.PARAMSETS),
        (fit.FitMethod, "fit", fits.PARAMSETS),
        (gait.GaitEventMethod, "gait", gaits.EVENT_PARAMSETS),
        (gdi.GdiModel, "gdi", gaits.GDI_PARAMSETS),
    ):
        out += _of_table(conn, table(), prefix, {method_key(p): p.hash for p in paramsets.values()})
    return out


def _of_table(conn: Any, table: Any, prefix: str, hashes: dict[str, str]) -> list[str]:
    if not table.is_declared:
        return []
    column, out = f"{prefix}_method", []
    for row in table.proj(f"{prefix}_method_sha").to_dicts():
        old, sha = row[column], row[f"{prefix}_method_sha"]
        if hashes.get(old, sha) == sha:
            continue
        new = f"{old[:39]}-{sha[:8]}"
        change = f"SET {quote(column)} = '{escape_string(new)}' WHERE {quote(column)} = '{escape_string(old)}'"
        # Queues have no foreign keys that would take the name along. They go first: what was broken off is seen again.
        out += [f"UPDATE {queue} {change}" for queue in _queues(conn, table, column)]
        out.append(f"UPDATE {table.full_table_name} {change}")
    return out


def _queues(conn: Any, table: Any, column: str) -> list[str]:
    prefix = table.database.removesuffix(table.database.rpartition("_")[2]).replace("_", r"\_")
    rows = conn.query(
        "SELECT table_schema, table_name FROM information_schema.columns "
        "WHERE column_name = %s AND table_schema LIKE %s AND table_name LIKE '~~%%' ORDER BY table_schema, table_name",
        args=(column, f"{prefix}%"),
    )
    return [f"{quote(r[0])}.{quote(r[1])}" for r in rows.fetchall()]
