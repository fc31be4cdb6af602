"""`pbl populate`: the worker, run once in this process, with a bar and a summary."""

from __future__ import annotations

import dataclasses
import functools
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from pbl_pipeline import progress
from pbl_schemas import computed_tables, tracking
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading import visit_progress
from pbl_schemas.reading.status import EMPTY_COLUMNS, empty_rows

from . import queue, refresh, run_job
from .heartbeat import Silent
from .loop import Worker
from .queue import Claim
from .registry import table_named
from .run_job import Outcome

#: Pause between two looks at how many jobs there are (s): it is a query a table.
COUNT_EVERY_S = 2.0


@dataclasses.dataclass
class TableRun:
    """Outcome of one run for one table. errors: code -> how many. empty: rows with a status that says so."""

    table: str
    done: int = 0
    empty: int = 0
    waiting: int = 0
    errors: dict[str, int] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Run:
    """Outcome of one run. `dropped`: rows deleted because another person was chosen. `interrupted`: by a signal."""

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


def populate(
    tables: Sequence[str] | None = None,
    limit: int | None = None,
    retry_errors: bool = False,
    visit: int | None = None,
) -> Run:
    """Compute missing results. One call is one worker; several may run at once. `pbl_schemas.activate()` comes before.

    Raises `PblError` USAGE for an unknown table name.

    Parameters
    ----------
    tables
        Names of the tables to visit (default: all).
    retry_errors
        Clear error rows first, so that their keys are tried again.
    visit
        session_id of the visit of which alone is computed, its usable recordings and current sets; jobs of it that
        other workers hold are waited for. None: everything.
    """
    for name in (
        "datajoint",
        "pbl.worker",
    ):  # the summary and `pbl status` report the same
        logging.getLogger(name).setLevel(logging.CRITICAL)
    wanted = {table_named(n) for n in tables or ()}
    chosen = [t for t in computed_tables() if not tables or t in wanted]
    parts = {t.__name__: TableRun(t.__name__) for t in chosen}
    run = Run(list(parts.values()))
    only = None if visit is None else functools.partial(visit_progress.of_visit, visit)
    if retry_errors:
        of_visit = {t: True if only is None else only().where(t) for t in chosen}
        run.retried = sum(queue.reset_to_new(jobs_of(t).errors & w) for t, w in of_visit.items() if w is not None)
    empty_before = {t: len(empty_rows(t)) for t in chosen if t.__name__ in EMPTY_COLUMNS}
    found = (refresh.refresh(everything=True) if only is None else refresh.refresh_scope(only())) or refresh.Refreshed()
    with progress.bar("populate", total=_ready(chosen, limit), unit="row") as update:
        worker = Worker(chosen, Silent(), report=_counting(parts, chosen, limit, update), limit=limit, only=only)
        try:
            worker.run(once=True)
        except (KeyboardInterrupt, SystemExit):
            run.interrupted = True
    found.add(worker.found)
    run.freed, run.planned, run.dropped = found.freed, found.planned, found.dropped
    for table in chosen:
        part = parts[table.__name__]
        if part.done and table in empty_before:
            part.empty = max(0, min(len(empty_rows(table)) - empty_before[table], part.done))
        if table is tracking.SubjectChoice:
            part.waiting = len(table & {"choice_status": "NEEDS_CHOICE"})
    return run


def _ready(tables: Sequence[Any], limit: int | None) -> int:
    ready = "WHERE status='pending' AND scheduled_time <= CURRENT_TIMESTAMP(3)"
    counts = " UNION ALL ".join(f"SELECT COUNT(*) FROM {jobs_of(t).full_table_name} {ready}" for t in tables)  # noqa: S608
    found = jobs_of(tables[0]).connection.query(counts).fetchall()
    return sum(int(n) if limit is None else min(int(n), limit) for (n,) in found)


def _counting(
    parts: dict[str, TableRun], tables: Sequence[Any], limit: int | None, update: Callable[..., None]
) -> Callable[[Claim, Outcome | None], None]:
    """Return the function that counts the worker's jobs by table and draws them."""
    ended, counted = 0, time.monotonic()

    def report(job: Claim, outcome: Outcome | None) -> None:
        nonlocal ended, counted
        if outcome is None:
            return
        part = parts[job.table.__name__]
        part.done += outcome.what == run_job.DONE
        if outcome.what in (run_job.FAILED, run_job.LATER) and outcome.code:
            part.errors[outcome.code] = part.errors.get(outcome.code, 0) + 1
        ended += 1
        total = None
        if time.monotonic() - counted > COUNT_EVERY_S:
            total, counted = ended + _ready(tables, limit), time.monotonic()
        update(1, part.table, total)

    return report
