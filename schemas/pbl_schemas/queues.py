"""The job tables of all computed tables."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any

from . import video
from .chain import computed_tables
from .fit_sets import FitSet
from .job_errors import error_code
from .jobs import jobs_of
from .rows import inside, rows_inside


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
    """Delete the error rows of a video and of the sets of its visit (with these codes), so that the next populate tries
    again. Not in a transaction: it may declare job tables."""
    visit = int((video.Video & {"video_id": video_id}).fetch1("session_id"))
    for table in computed_tables():
        jobs = jobs_of(table)
        own: Any = {"video_id": video_id} if "video_id" in jobs.primary_key else False
        if "fit_set" in jobs.primary_key:
            # Also of sets that were deleted: they are planned again under the same name.
            names = {str(name) for name in jobs.errors.to_arrays("fit_set")}
            others = rows_inside(FitSet & f"session_id <> {visit}", "fit_set", names)
            own = inside("fit_set", names - {row["fit_set"] for row in others})
        for row in (jobs.errors & own).to_dicts():
            if codes is None or error_code(row["error_message"]) in codes:
                (jobs & {k: row[k] for k in jobs.primary_key}).delete_quick()
