"""Jobs of processes that died: reservations to free, crashes to count; and errors with a cause outside the job."""

from __future__ import annotations

import datetime
import os
import platform
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError, said
from pbl_schemas import worker
from pbl_schemas.job_errors import error_message
from pbl_schemas.jobs import jobs_of

from . import queue
from .queue import Claim

#: Time without a heartbeat after which a worker is dead (s). It exceeds `heartbeat.PERIOD_S`, a minute without the
#: database, and a process that compiles.
DEAD_AFTER_S = 180.0

#: Crashes of its process, and deaths of the whole worker that held it (which may have another cause), after which a job
#: becomes an error row.
CRASHES, DEATHS = 3, 10

#: Exceptions that say nothing about the job: a signal, a lost server. DataJoint's own populate makes error rows of them
#: that begin with the exception's name (a worker puts the job back); they are tried again without being asked.
INTERRUPTED = ("KeyboardInterrupt", "SystemExit", "LostConnectionError", "OperationalError", "InterfaceError")
INTERRUPTED_ROWS = f"error_message REGEXP '^({'|'.join(INTERRUPTED)})(:|$)'"


def free_dead(table: Any) -> int:
    """Put jobs back that a dead process left: reserved by it, or in error because it was interrupted. Jobs that wait
    for a time of a clock that was set back become ready.

    A process of this host is judged by its number and age. A process of another host is dead when no heartbeat of it
    was seen for `DEAD_AFTER_S`; one that never had a heartbeat (a populate by hand) when its reservation is older than
    the time limit of its table. A job whose processes died `DEATHS` times becomes an error row.
    """
    jobs, n = jobs_of(table), queue.advance_delayed(table)
    for row in jobs.reserved.to_dicts():
        if not _alive(row, table):
            key = {k: row[k] for k in jobs.primary_key}
            job = Claim(table, key, int(row["priority"]), row["host"], int(row["pid"]), int(row["connection_id"]))
            deaths = int(row["deaths"]) + (job.connection_id != jobs.connection.connection_id)  # or we let it go
            if deaths < DEATHS:
                n += queue.put_back(job, deaths=deaths)
            else:
                n += queue.fail(job, _crash(job, deaths, "with its supervisor"))
    return n + queue.reset(jobs.errors & INTERRUPTED_ROWS)


def crashed(job: Claim, reason: str) -> bool:
    """Count a crash of the job's process: put it back, or make an error row of it the third time (`CRASHES`). Returns
    whether the job was still that process's."""
    n = job.attempts + 1
    if n < CRASHES:
        return queue.put_back(job, f"its process died ({reason})", attempts=n)
    return queue.fail(job, _crash(job, n, reason))


def _crash(job: Claim, n: int, reason: str) -> str:
    error = PblError(
        "WORKER_CRASH",
        found=said("the worker's process died {n} times over this job, last: {why}", n=n, why=reason),
        expected="a result or a coded error",
        next_step="check memory (exit by SIGKILL) and the recording; then `pbl retry`, or report it",
        key=str(job),
    )
    return error_message(error, job.table.__name__, job.key)


def overdue(job: Claim, limit_s: float) -> bool:
    """Make a job the error row TIME_LIMIT. Returns whether it was still that process's."""
    error = PblError(
        "TIME_LIMIT",
        found=said("no result within the time limit of {s:g} s", s=limit_s),
        expected="a result in that time",
        next_step="look at the recording; `pbl worker --limit-factor 4` allows more, then `pbl retry`",
        key=str(job),
    )
    return queue.fail(job, error_message(error, job.table.__name__, job.key))


def _alive(row: dict[str, Any], table: Any) -> bool:
    from .registry import stage_of

    now = table.connection.query("SELECT CURRENT_TIMESTAMP(3)").fetchone()[0]
    if row["host"] == platform.node():
        if int(row["pid"]) == os.getpid():  # our number, but not our job: in a container every worker has the same
            return queue.is_held(table, {k: row[k] for k in jobs_of(table).primary_key})
        return _alive_here(int(row["pid"]), row["reserved_time"], now)
    same = (worker.Worker & {"worker_host": row["host"], "worker_pid": row["pid"]}).to_dicts()
    if same:
        beating = [w["worker_seen"] for w in same if w["worker_stopped"] is None]
        # abs: where the server's clock was set back, what was before is in the future.
        return any(abs((now - seen).total_seconds()) < DEAD_AFTER_S for seen in beating)
    reserved = row["reserved_time"]
    return reserved is None or abs((now - reserved).total_seconds()) < stage_of(table).limit_s


def _alive_here(pid: int, reserved: datetime.datetime | None, now: datetime.datetime) -> bool:
    """Return whether a process of this host lives; a number that a younger process has by now counts as dead."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    started = _age_of_process(pid)
    if started is None or reserved is None:
        return True
    # A process younger than the reservation cannot have made it (two seconds for the clocks).
    return started + 2.0 >= (now - reserved).total_seconds()


def _age_of_process(pid: int) -> float | None:
    """Return the seconds since a process started; None without /proc."""
    try:
        ticks = int(Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19])
        uptime = float(Path("/proc/uptime").read_text(encoding="utf-8").split()[0])
    except (OSError, ValueError, IndexError):
        return None
    return uptime - ticks / os.sysconf("SC_CLK_TCK")
