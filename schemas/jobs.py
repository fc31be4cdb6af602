"""Job tables: DataJoint's queue of each computed table, with a column of ours that counts attempts."""

from __future__ import annotations

from typing import Any

import pymysql

from pbl_pipeline.errors import PblError

from ._datajoint import AccessError

#: Counts how often a job was put back because of its own inputs; DataJoint's job table has no such column.
ATTEMPTS = "attempts"

#: The server's number of "duplicate column name": another process was quicker.
_THERE_ALREADY = 1060

_jobs: dict[Any, Any] = {}
_sources: dict[Any, Any] = {}


def keys_of(table: Any) -> Any:
    """Query of the keys that can be computed for a table (class), made once: DataJoint reads the columns of the tables
    above for it."""
    if table not in _sources:
        _sources[table] = table().key_source
    return _sources[table]


def jobs_of(table: Any) -> Any:
    """The job table of a computed table (class), made once: DataJoint reads every foreign key of the server for it.

    It is declared where it is missing, and gets its column `attempts` (0 for each new job); an account that may not
    declare relies on `schemas._declare.declare_all`. Both end a transaction that is open.
    """
    if table not in _jobs:
        jobs = table.jobs
        if ATTEMPTS not in jobs.heading.names:
            _add_attempts(jobs)
            jobs = table.jobs
        _jobs[table] = jobs
    return _jobs[table]


def _add_attempts(jobs: Any) -> None:
    column = f"`{ATTEMPTS}` tinyint NOT NULL DEFAULT 0 COMMENT 'how often its inputs were missing or changed'"
    try:
        jobs.connection.query(f"ALTER TABLE {jobs.full_table_name} ADD COLUMN {column}")
    except pymysql.err.OperationalError as error:
        if error.args[0] != _THERE_ALREADY:
            raise
    except AccessError as error:
        raise PblError(
            "DB_MIGRATION",
            found=f"the queue {jobs.full_table_name} has no column {ATTEMPTS}, and this account may not add it",
            expected="queues as `pbl db init` makes them",
            next_step="run `pbl db init` once with an account that may change tables",
        ) from error
