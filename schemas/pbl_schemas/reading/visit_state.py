"""Identity of the rows of a visit, by one statement: as long as it is equal, answers made from them can be kept."""

from __future__ import annotations

from typing import Any

from .. import computed_tables, fit, gait, tracking, video
from ..capture import PhoneLink, PhoneRecording
from ..jobs import jobs_of
from ..operations.catalog import quote

#: Tables beside the computed ones and their queues: recordings, sensors, decisions, sets, links with their protocols.
#: The rows of others, and parts, change with rows of these.
_STATED = (video.Video, video.RigView, video.WearableImu, video.NotUsable, tracking.TrackingSelection, fit.FitSet,
           fit.FitSelection, gait.EventCorrection, PhoneLink, PhoneRecording)  # fmt: skip
#: Columns of a queue that change what is said of a job.
_OF_A_JOB = ("status", "error_message", "reserved_time", "scheduled_time", "priority")
#: Names in `state_of` by which the index of a visit changes.
RESULTS = ("SessionGdi", "SessionQc", "FitSelection", "EventCorrection", "NotUsable")


def state_of(session_id: int) -> dict[str, str]:
    """Return a text by table, and by "TABLE jobs" for its queue, which changes with the rows of a visit."""
    parts = []
    for table in _STATED:
        columns = [name for name, column in table.heading.attributes.items() if not (column.json or column.codec)]
        parts.append(_part(table.__name__, table, columns, session_id))
    for table in computed_tables():
        # The last two differ where a row was made anew.
        columns = [name for name in table.heading.names if name.endswith(("_computed", "_seconds"))]
        parts.append(_part(table.__name__, table, [*table.heading.primary_key, *columns], session_id))
        jobs = jobs_of(table)
        parts.append(_part(f"{table.__name__} jobs", jobs, [*jobs.heading.primary_key, *_OF_A_JOB], session_id))
    rows = video.Video.connection.query(" UNION ALL ".join(parts)).fetchall()
    return {str(name): f"{count} {found}" for name, count, found in rows}


def results_state(session_id: int) -> tuple[str, ...]:
    """Return texts which change with the results of a visit, not with its queues."""
    tables = {table.__name__ for table in computed_tables()}
    return tuple(text for name, text in state_of(session_id).items() if name in tables)


def _part(name: str, table: Any, columns: list[str], session_id: int) -> str:
    """Return the query of the number of rows of a visit and of their hashes, XOR."""
    key, where = table.heading.primary_key, f"session_id = {int(session_id)}"
    for column, of in (("fit_set", fit.FitSet), ("video_id", video.Video)):
        if column in key:  # its index; others are rarely indexed
            where = f"{column} IN (SELECT {column} FROM {of.full_table_name} WHERE {where})"  # noqa: S608
            break
    values = ", ".join(f"QUOTE({quote(c)})" for c in columns)
    hashed = f"CAST(CONV(LEFT(SHA2(CONCAT({values}), 256), 16), 16, 10) AS UNSIGNED)"
    return f"SELECT '{name}', COUNT(*), BIT_XOR({hashed}) FROM {table.full_table_name} WHERE {where}"  # noqa: S608
