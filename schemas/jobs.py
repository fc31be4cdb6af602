"""Job tables: DataJoint's queue of each computed table."""

from __future__ import annotations

from typing import Any

_jobs: dict[Any, Any] = {}


def jobs_of(table: Any) -> Any:
    """The job table of a computed table (class), made once: DataJoint reads every foreign key of the server for it."""
    if table not in _jobs:
        _jobs[table] = table.jobs
    return _jobs[table]
