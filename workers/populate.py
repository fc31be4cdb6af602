"""The populate loop: every computed table of the chain, in order, each job reserved, errors left in their rows."""

from __future__ import annotations

import dataclasses
import datetime
import logging
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError
from schemas import computed_tables
from schemas._base import dj, error_code
from schemas.status import empty_rows

#: How the message of an error begins that says nothing about the video: a signal, a lost server, or inputs that
#: somebody changed during the computation. Such rows are tried again without being asked.
INTERRUPTED = (
    "KeyboardInterrupt",
    "SystemExit",
    "LostConnectionError",
    "OperationalError",
    "InterfaceError",
    "DataJointError: Referential integrity failed",
    "DataJointError: fetch1",
)


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
    from schemas.plan import plan_fit_sets
    from schemas.tracking import drop_outdated_choices

    # DataJoint would print every error row's text into the progress bars; the summary and `pbl status` say it.
    logging.getLogger("datajoint").setLevel(logging.CRITICAL)
    chosen = _choose(tables)
    run = Run([])
    for table in chosen:
        run.freed += free_dead(table)
        if retry_errors:
            run.retried += clear_errors(table)
    run.dropped = drop_outdated_choices()
    names = [t.__name__ for t in chosen]
    for table in chosen:
        if table.__name__ == "SessionFit":
            run.planned += len(plan_fit_sets())
        part = TableRun(table.__name__)
        run.tables.append(part)
        try:
            _populate_table(table, part, limit)
        except (KeyboardInterrupt, SystemExit):
            free_own(table)
            run.interrupted = True
            return run
    if "TrialInput" in names and "SessionFit" not in names:
        run.planned += len(plan_fit_sets())
    return run


def _choose(names: Sequence[str] | None) -> list[Any]:
    tables = computed_tables()
    if not names:
        return tables
    known = {t.__name__.lower(): t for t in tables}
    unknown = [n for n in names if n.lower() not in known]
    if unknown:
        raise PblError(
            "USAGE",
            found=f"no computed table {', '.join(unknown)}",
            expected="one of " + ", ".join(t.__name__ for t in tables),
            next_step="name one of these with --table, or leave it out",
        )
    wanted = {n.lower() for n in names}
    return [t for t in tables if t.__name__.lower() in wanted]


def _populate_table(table: Any, part: TableRun, limit: int | None) -> None:
    jobs = table.jobs
    fill_queue(table)
    empty_before = len(empty_rows(table))
    calls = 0
    with progress.bar(table.__name__, total=_ready(jobs, limit), unit="row") as update:
        # One key a call: an interrupt must end the loop (populate itself would go on to the next key), and other
        # workers take keys from the same queue while we compute.
        while (limit is None or calls < limit) and _ready(jobs, 1):
            result = table.populate(
                reserve_jobs=True, refresh=False, suppress_errors=True, return_exception_objects=True, max_calls=1
            )
            for _, error in result["error_list"]:
                if isinstance(error, (KeyboardInterrupt, SystemExit)):
                    raise error
                code = error_code(f"{type(error).__name__}: {error}")
                part.errors[code] = part.errors.get(code, 0) + 1
            part.done += result["success_count"]
            done = result["success_count"] + len(result["error_list"])
            calls += done
            update(done)
    part.empty = max(0, min(len(empty_rows(table)) - empty_before, part.done))
    part.waiting = count_waiting(table)


def fill_queue(table: Any) -> int:
    """Queue every key that has no result and no job, in one statement; returns how many.

    DataJoint's own refresh inserts row by row (66 s for 300,000 keys); it still runs, to clean up.
    """
    jobs, quote = table.jobs, table.connection.adapter.quote_identifier
    todo = (table().key_source - table.proj()).restrict(dj.Not(jobs), semantic_check=False).proj()
    columns = ",".join(quote(c) for c in todo.heading.primary_key)
    names = f"{columns},{quote('status')},{quote('priority')}"
    values = f"{columns},'pending',{int(table.connection._config.jobs.default_priority)}"
    # IGNORE: another process may queue the same key between the two halves of the statement. Nothing in it comes from
    # outside: names are DataJoint's own, quoted by its adapter.
    statement = f"INSERT IGNORE INTO {jobs.full_table_name} ({names}) SELECT {values} FROM ({todo.make_sql()}) AS todo"  # noqa: S608
    cursor = table.connection.query(statement)
    jobs.refresh(delay=-1)
    return int(cursor.rowcount)


def _ready(jobs: Any, limit: int | None) -> int:
    """How many jobs can be taken now, at most `limit`."""
    n = len(jobs.pending & "scheduled_time <= CURRENT_TIMESTAMP(3)")
    return n if limit is None else min(n, limit)


def count_waiting(table: Any) -> int:
    """Videos that wait for a person's choice (only SubjectChoice has them)."""
    return len(table & {"choice_status": "NEEDS_CHOICE"}) if table.__name__ == "SubjectChoice" else 0


# ---------------------------------------------------------------------------------------------------- stuck jobs
def free_dead(table: Any) -> int:
    """Put jobs back that a dead process of this host left: reserved by it, or in error because it was interrupted.

    Judged by host and process number. A number that a younger process carries by now counts as dead, and so does our
    own: at the start this process has reserved nothing (in a container the worker is always process 1).
    """
    jobs, n = table.jobs, 0
    for row in jobs.reserved.proj("host", "pid", "reserved_time").to_dicts():
        if row["host"] == platform.node() and not _alive(int(row["pid"]), row["reserved_time"], jobs):
            n += _put_back(jobs, row)
    for word in INTERRUPTED:
        for row in (jobs.errors & f"error_message like '{word}%'").to_dicts():
            n += _put_back(jobs, row)
    return n


def free_own(table: Any) -> int:
    """Put back what this process was computing when a signal ended it."""
    mine = table.jobs & {"host": platform.node(), "pid": os.getpid()}
    n = 0
    for row in mine.to_dicts():
        interrupted = row["status"] == "error" and row["error_message"].startswith(INTERRUPTED)
        if row["status"] == "reserved" or interrupted:
            n += _put_back(table.jobs, row)
    return n


def clear_errors(table: Any) -> int:
    """Make every error row of a table pending again."""
    rows = table.jobs.errors.keys()
    return sum(_put_back(table.jobs, row) for row in rows)


def _put_back(jobs: Any, row: dict[str, Any]) -> int:
    key = {k: row[k] for k in jobs.primary_key}
    jobs.update1({**key, "status": "pending", "error_message": "", "error_stack": None, "host": "", "pid": 0})
    return 1


def _alive(pid: int, reserved: datetime.datetime | None, jobs: Any) -> bool:
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    started = _age_of_process(pid)
    if started is None or reserved is None:
        return True
    now = jobs.connection.query("SELECT CURRENT_TIMESTAMP(3)").fetchone()[0]
    # A process younger than the reservation cannot have made it (two seconds for the clocks).
    return started + 2.0 >= (now - reserved).total_seconds()


def _age_of_process(pid: int) -> float | None:
    """Seconds since a process started; None where the system does not tell (no /proc)."""
    try:
        ticks = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return None
    return uptime - ticks / os.sysconf("SC_CLK_TCK")
