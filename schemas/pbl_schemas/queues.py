"""The job tables of all computed tables."""

from __future__ import annotations

import logging
from collections.abc import Collection

from .chain import computed_tables
from .job_errors import error_code
from .jobs import jobs_of


def declare() -> None:
    """Declare the queue of every computed table, which a worker's account may not."""
    log = logging.getLogger("datajoint")
    level = log.level
    log.setLevel(logging.ERROR)  # it warns of types that it chooses itself for the keys of a queue
    try:
        for table in computed_tables():
            jobs_of(table)
    finally:
        log.setLevel(level)


def forget_errors(video_id: int, codes: Collection[str] | None = None) -> None:
    """Delete the error rows of a video (with these codes), so that the next populate tries again. Not in a transaction:
    it may declare job tables."""
    for table in computed_tables():
        if "video_id" not in table.primary_key:
            continue
        jobs = jobs_of(table)
        for row in (jobs.errors & {"video_id": video_id}).to_dicts():
            if codes is None or error_code(row["error_message"]) in codes:
                (jobs & {k: row[k] for k in jobs.primary_key}).delete_quick()
