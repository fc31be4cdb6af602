"""Job tables: DataJoint's queue of each computed table, with additional columns that count attempts."""

from __future__ import annotations

from typing import Any

import pymysql

from pbl_pipeline.errors import PblError

from .datajoint_setup import AccessError
from .rows import MadeOnce

#: Additional columns of DataJoint's job table, 0 for each new job, with their meaning.
COUNTS = {
    "attempts": "how often its inputs changed or it took its process down",
    "deaths": "how often the worker that held it died, whatever the reason",
}

#: The server's number of "duplicate column name": another process was quicker.
_THERE_ALREADY = 1060


@MadeOnce
def keys_of(table: Any) -> Any:
    """Query of the keys that can be computed for a table (class)."""
    return table().key_source


@MadeOnce
def jobs_of(table: Any) -> Any:
    """The job table of a computed table (class), for which DataJoint reads every foreign key of the server.

    It is declared where it is missing, and gets the columns of `COUNTS`; an account that may not declare relies on
    `pbl_schemas.operations.declare.declare_all`. Both end a transaction that is open.
    """
    jobs = table.jobs
    if missing := [name for name in COUNTS if name not in jobs.heading.names]:
        _add(jobs, missing)
        jobs = table.jobs
    return jobs


def _add(jobs: Any, names: list[str]) -> None:
    columns = ", ".join(f"ADD COLUMN `{n}` tinyint NOT NULL DEFAULT 0 COMMENT '{COUNTS[n]}'" for n in names)
    try:
        jobs.connection.query(f"ALTER TABLE {jobs.full_table_name} {columns}")
    except pymysql.err.OperationalError as error:
        if error.args[0] != _THERE_ALREADY:
            raise
    except AccessError as error:
        raise PblError(
            "DB_MIGRATION",
            found=f"the queue {jobs.full_table_name} lacks {', '.join(names)}, which this account may not add",
            expected="queues as `pbl db init` makes them",
            next_step="run `pbl db init` once with an account that may change tables",
        ) from error
