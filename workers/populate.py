"""The populate loop: every computed table of the chain, in order, each job reserved, errors left in their rows."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from typing import Any

from pbl_pipeline import progress
from schemas import computed_tables
from schemas.jobs import jobs_of
from schemas.status import empty_rows

from . import queue, recover, refresh, run_job
from .registry import stage_of, table_named


@dataclasses.dataclass
class TableRun:
    """What one run did to one table. errors: code -> how many. empty: rows with a status that says so."""

    table: str
    done: int = 0
    empty: int = 0
    waiting: int = 0
    errors: dict[str, int] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Run:
    """What one run did. `dropped`: rows deleted because a person chose somebody else. `interrupted`: by a signal."""

    tables: list[TableRun]
    freed: int = 0
    retried: int = 0
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)
    planned: int = 0
    interrupted: bool = False

    @property
    def did_something(self) -> bool:
        """False when there was nothing to do."""
        return bool(self.dropped or self.planned or any(t.done or t.errors for t in self.tables))


def populate(tables: Sequence[str] | None = None, limit: int | None = None, retry_errors: bool = False) -> Run:
    """Compute what is missing, table after table in the order of the chain.

    One call is one worker; several processes may run at once. `schemas.activate()` must have been called.

    Parameters
    ----------
    tables
        Names of the tables to visit (default: all).
    limit
        Most computations per table.
    retry_errors
        Clear error rows first, so that their keys are tried again.

    Raises
    ------
    PblError
        USAGE for an unknown table name.
    """
    from schemas.tracking import drop_outdated_choices

    # DataJoint would print every error row's text into the progress bars; the summary and `pbl status` say it.
    logging.getLogger("datajoint").setLevel(logging.CRITICAL)
    chosen = _choose(tables)
    run = Run([])
    for table in chosen:
        run.freed += recover.free_dead(table)
        if retry_errors:
            run.retried += queue.reset(jobs_of(table).errors)
    run.dropped = drop_outdated_choices()
    names = [t.__name__ for t in chosen]
    for table in chosen:
        if table.__name__ == "SessionFit":
            run.planned += refresh.plan()
        part = TableRun(table.__name__)
        run.tables.append(part)
        try:
            _populate_table(table, part, limit)
        except (KeyboardInterrupt, SystemExit):
            recover.free_own(table)
            run.interrupted = True
            return run
    if "TrialInput" in names and "SessionFit" not in names:
        run.planned += refresh.plan()
    return run


def _choose(names: Sequence[str] | None) -> list[Any]:
    wanted = {table_named(n).__name__ for n in names or ()}
    return [t for t in computed_tables() if not names or t.__name__ in wanted]


def _populate_table(table: Any, part: TableRun, limit: int | None) -> None:
    queue.sweep(table)
    queue.fill(table)
    empty_before = len(empty_rows(table))
    total = ready(table)
    with progress.bar(table.__name__, total=total if limit is None else min(total, limit), unit="row") as update:
        calls = 0
        while limit is None or calls < limit:
            jobs = queue.claim(table, min(stage_of(table).batch, limit - calls if limit is not None else 1000))
            if not jobs:
                break
            for job in jobs:
                outcome = run_job.run(job)
                part.done += outcome.what == run_job.DONE
                if outcome.code:
                    part.errors[outcome.code] = part.errors.get(outcome.code, 0) + 1
                calls += 1
                update(1)
    part.empty = max(0, min(len(empty_rows(table)) - empty_before, part.done))
    part.waiting = count_waiting(table)


def ready(table: Any) -> int:
    """How many jobs can be taken now."""
    return len(jobs_of(table).pending & "scheduled_time <= CURRENT_TIMESTAMP(3)")


def count_waiting(table: Any) -> int:
    """Videos that wait for a person's choice (only SubjectChoice has them)."""
    return len(table & {"choice_status": "NEEDS_CHOICE"}) if table.__name__ == "SubjectChoice" else 0
