"""The queue of a table: DataJoint's job rows, filled in one statement, reserved, put back, fenced.

A job row is `pending`, `reserved` or `error`; a finished one is deleted, because the result row marks it as done. Host,
process and connection (written by DataJoint) and the heartbeat of that process (`pbl_workers.heartbeat`) distinguish a
live reservation from a dead one.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import hashlib
import json
import math
import os
import platform
import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import shortened
from pbl_schemas import chain, computed_tables, fit, video
from pbl_schemas.connection import dj
from pbl_schemas.jobs import COUNTS, jobs_of, keys_of
from pbl_schemas.rows import exist, parts
from pbl_schemas.transactions import READ_COMMITTED, repeated

from .registry import LONG, LONG_FRAMES, NEW

#: Candidates that are read for each job: other workers read the same ones.
_SPREAD = 4
#: Longest wait of a job that was put back (s).
LONGEST_WAIT_S = 60.0
#: Time for which candidates are tried without reading again (s): a more urgent job waits no longer.
KEPT_S = 0.1
#: Candidates that were read and not tried, of each table and condition, with the time when (s).
_read: dict[tuple[Any, str | None], tuple[float, list[dict[str, Any]]]] = {}
_MOST_READ = 100
#: Jobs that this process holds: table and hash of the key.
_held: set[tuple[str, str]] = set()


@dataclasses.dataclass(frozen=True)
class Claim:
    """A reserved job. The reservation is valid while its row has these values."""

    table: Any
    key: dict[str, Any]
    priority: int
    host: str
    pid: int
    connection_id: int
    attempts: int = 0  # a column of `pbl_schemas.jobs.COUNTS`

    def __str__(self) -> str:
        return f"{self.table.__name__} " + ", ".join(f"{k}={v}" for k, v in self.key.items())

    @property
    def hash(self) -> str:
        """16 hex digits of the key."""
        return key_hash(self.key)


def key_hash(key: Mapping[str, Any]) -> str:
    """16 hex digits of a job's key."""
    return hashlib.sha256(json.dumps(key, sort_keys=True, default=str).encode()).hexdigest()[:16]


def is_held(table: Any, key: Mapping[str, Any]) -> bool:
    """Return whether this process has reserved the job and not ended it."""
    return (table.__name__, key_hash(key)) in _held


# ------------------------------------------------------------------------------------------------------------- filling
def fill(
    table: Any, keys: Sequence[Mapping[str, Any]] | None = None, priority: int = NEW, where: str | None = None
) -> int:
    """Queue every key that can be computed and has neither a result nor a job, in one statement; returns how many.

    `keys`: restriction to these (keys of a table above); `where`: a condition on the key.
    `priority`: that of a short recording; jobs of a long one get `registry.LONG` instead.
    DataJoint's own refresh inserts row by row.
    """
    if (keys is not None and not keys) or not chain.is_wanted(table):
        return 0
    jobs, quote = jobs_of(table), table.connection.adapter.quote_identifier
    source = keys_of(table)
    if keys is not None:
        if len(some := list(parts(keys))) > 1:
            return sum(fill(table, part, priority, where) for part in some)
        source = source & [dict(k) for k in keys]
    if where is not None:
        source = source & where
    todo = (source - table.proj()).restrict(dj.Not(jobs), semantic_check=False).proj()
    if keys is None and not todo:  # so ends most of the looks at a whole table
        return 0
    columns = ",".join(quote(c) for c in todo.heading.primary_key)
    names = f"{columns},{quote('status')},{quote('priority')}"
    values = f"{columns},'pending',IF({_is_long(source)},{LONG.get(priority, priority)},{int(priority)})"
    # IGNORE: another process may queue the same key between the two halves of the statement. Nothing in it comes from
    # outside: names are DataJoint's own, quoted by its adapter.
    statement = f"INSERT IGNORE INTO {jobs.full_table_name} ({names}) SELECT {values} FROM ({todo.make_sql()}) AS todo"  # noqa: S608
    return _committed(table.connection, lambda: int(table.connection.query(statement).rowcount))


def _is_long(keys: Any) -> str:
    """Return the condition on keys of a long recording, or of a set with one."""
    long = video.VideoInfo.proj("n_frames") & f"n_frames > {LONG_FRAMES}"
    name = "video_id"
    if name not in keys.heading.primary_key:
        name, long = "fit_set", fit.FitSet.Video.proj() * long
    return f"{name} IN (SELECT {name} FROM ({long.make_sql()}) AS long_ones)"  # noqa: S608  of constants


@repeated
def _committed(connection: Any, statement: Callable[[], int]) -> int:
    """Run one statement that reads much and writes little: without locks on what it reads, again after a deadlock.
    Returns how many rows it changed."""
    connection.query(READ_COMMITTED)
    return statement()  # alone it is that transaction


def sweep(table: Any, which: str = "status != 'reserved'") -> int:
    """Delete jobs that are done by another route or no longer requested; return how many."""
    n = 0
    for needless in (table.proj(), dj.Not(keys_of(table).proj())):
        if jobs := jobs_of(table) & which:  # most often there are none
            gone = jobs.restrict(needless, semantic_check=False)
            n += int(_committed(table.connection, functools.partial(gone.delete_quick, get_count=True)))
    return n


# --------------------------------------------------------------------------------------------------- reserving, ending
def most_urgent(wheres: Mapping[Any, str | None]) -> dict[Any, int]:
    """Return the priority of the first job that can be taken now of each table (class) that has one, by one statement.
    `wheres`: for each table a condition on the job's key."""
    found = _ready(wheres, 1)
    if len(_read) >= _MOST_READ:
        _read.clear()
    _read.update({(table, wheres[table]): (time.monotonic(), rows) for table, rows in found.items()})
    return {table: min(int(row["priority"]) for row in rows) for table, rows in found.items()}


def _ready(wheres: Mapping[Any, str | None], n: int) -> dict[Any, list[dict[str, Any]]]:
    """Return candidates for n jobs of each table that has some, the most urgent and oldest. Plain SQL: half of
    DataJoint's time for a query."""
    tables, queues = list(wheres), [jobs_of(table) for table in wheres]
    keys = [jobs.primary_key for jobs in queues]
    names, selects, rows = dict.fromkeys(name for key in keys for name in key), [], defaultdict(list)
    for place, (jobs, key, where) in enumerate(zip(queues, keys, wheres.values(), strict=True)):
        columns = ", ".join(name if name in key else f"NULL AS {name}" for name in names)
        selects.append(
            f"(SELECT {place} AS place, {columns}, priority, attempts FROM {jobs.full_table_name}"  # noqa: S608
            f" WHERE status='pending'{f' AND {where}' if where else ''} AND scheduled_time <= CURRENT_TIMESTAMP(3)"
            f" ORDER BY priority, scheduled_time LIMIT {_SPREAD * n})"
        )
    for row in queues[0].connection.query(" UNION ALL ".join(selects), as_dict=True) if queues else ():
        rows[tables[row["place"]]].append(row)
    return rows


def _candidates(table: Any, n: int, where: str | None, claims: Sequence[Claim]) -> Iterator[dict[str, Any]]:
    """Yield candidates for n jobs in the order in which they are tried: those that were just read, then the queue's.
    `claims`: those that were reserved so far."""
    at, rows = _read.pop((table, where), (-math.inf, []))
    if time.monotonic() - at < KEPT_S:
        n_read = len(rows)
        yield from _drawn(rows)
        if len(claims) == n_read < _SPREAD:  # the queue had no others, and other workers took none
            return
    yield from _drawn(_ready({table: where}, n)[table])


def _drawn(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Take candidates out of a list, the most urgent first. All workers see the same ones: a random order within a
    priority makes two hands on one job rare."""
    rows.sort(key=lambda r: (-r["priority"], random.random()))  # noqa: S311
    while rows:
        yield rows.pop()


def claim(table: Any, n: int = 1, where: str | None = None) -> list[Claim]:
    """Reserve up to n jobs, the most urgent and oldest first; where many workers draw, nearly so. `where`: as for
    `most_urgent`."""
    jobs = jobs_of(table)
    # DataJoint's `jobs.reserve` asks the server for the account's name in a statement before this one.
    reserve = (
        f"UPDATE {jobs.full_table_name} SET status='reserved', host=%s, pid=%s, connection_id=%s, user=USER(),"  # noqa: S608
        f" reserved_time=CURRENT_TIMESTAMP(3) WHERE {' AND '.join(f'`{name}`=%s' for name in jobs.primary_key)}"
        " AND attempts=%s AND status='pending' AND scheduled_time <= CURRENT_TIMESTAMP(3)"
    )
    claims: list[Claim] = []
    for row in _candidates(table, n, where, claims) if n else ():
        key = {k: row[k] for k in jobs.primary_key}
        here = (platform.node(), os.getpid(), jobs.connection.connection_id)
        if jobs.connection.query(reserve, args=(*here, *key.values(), row["attempts"])).rowcount == 1:
            claims.append(Claim(table, key, int(row["priority"]), *here, attempts=int(row["attempts"])))
            _held.add((table.__name__, claims[-1].hash))
            if len(claims) == n:
                break
    return claims


def anything_reserved_here() -> bool:
    """Return whether a process of this machine works on a job."""
    here = {"host": platform.node()}
    return any(exist(*(jobs_of(table).reserved & here for table in computed_tables())))


def finish(job: Claim) -> None:
    """Delete the row of a finished job, if it is still ours."""
    _mine(job).delete_quick()
    release(job)


def fail(job: Claim, message: str, stack: str = "") -> bool:
    """Make an error row of the job; it is tried again on request only (`pbl retry`). Returns whether it was ours."""
    ours = len(_mine(job)) == 1
    if ours:
        jobs_of(job.table).error(job.key, error_message=message, error_stack=stack or None)
    release(job)
    return ours


def put_back(job: Claim, reason: str = "", delay_s: float = 0.0, **counts: int) -> bool:
    """Make the job pending again, earliest after `delay_s`; `reason` stays in its row, and `counts` are values of
    columns of `pbl_schemas.jobs.COUNTS`. Return whether it was ours."""
    ours = reset(_mine(job), reason, delay_s, **counts) == 1
    release(job)
    return ours


def release(job: Claim) -> None:
    """Forget the job: another worker has it."""
    _held.discard((job.table.__name__, job.hash))


def release_all() -> None:
    """Forget all jobs. Remaining reservations are freed like those of a dead process."""
    _held.clear()


def reset(jobs: Any, reason: str = "", delay_s: float = 0.0, **counts: int) -> int:
    """Make all rows of a restricted queue pending, to be taken earliest after `delay_s`; returns how many."""
    columns = "".join(f"{name}=%s, " for name in counts)
    cursor = jobs.connection.query(  # the condition is DataJoint's, which escapes values
        f"UPDATE {jobs.full_table_name} SET {columns}status='pending', host='', pid=0, error_stack=NULL,"  # noqa: S608
        f" error_message=%s, scheduled_time=CURRENT_TIMESTAMP(3) + INTERVAL %s MICROSECOND{jobs.where_clause()}",
        args=(*counts.values(), shortened(reason, 2000), int(delay_s * 1e6)),
    )
    return int(cursor.rowcount)


def reset_to_new(jobs: Any) -> int:
    """`reset`, and forget earlier attempts, on request."""
    return reset(jobs, "", 0.0, **dict.fromkeys(COUNTS, 0))


def advance_delayed(table: Any) -> int:
    """Make jobs ready that would wait for longer than any is put back for: the server's clock was set back."""
    jobs = jobs_of(table)
    cursor = jobs.connection.query(
        f"UPDATE {jobs.full_table_name} SET scheduled_time=CURRENT_TIMESTAMP(3) WHERE status='pending'"  # noqa: S608
        " AND scheduled_time > CURRENT_TIMESTAMP(3) + INTERVAL %s SECOND",
        args=(LONGEST_WAIT_S,),
    )
    return int(cursor.rowcount)


def _mine(job: Claim) -> Any:
    held = {"status": "reserved", "host": job.host, "pid": job.pid, "connection_id": job.connection_id}
    return jobs_of(job.table) & job.key & held


class ReservationLost(Exception):
    """Raised if another worker holds the job by now: its result must not be written twice."""


def lock_reservation(job: Claim) -> float:
    """Inside the transaction that inserts: go on only while the reservation is ours, and let no other worker take it;
    returns when the job was queued (s since 1970).

    The job's row is locked until the transaction ends, so a second holder of the same job waits here and then finds
    either that its reservation is gone or that the result is there.
    """
    jobs = jobs_of(job.table)
    where = " AND ".join(f"`{name}`=%s" for name in job.key)
    row = jobs.connection.query(
        f"SELECT status, host, pid, connection_id, created_time FROM {jobs.full_table_name}"  # noqa: S608
        f" WHERE {where} FOR UPDATE",
        args=tuple(job.key.values()),
    ).fetchone()
    if row is None or tuple(row[:4]) != ("reserved", job.host, job.pid, job.connection_id):
        raise ReservationLost(str(job))
    return row[4].replace(tzinfo=datetime.UTC).timestamp()


def errors_of(table: Any, code: str | None = None, keys: Iterable[Mapping[str, Any]] | None = None) -> Any:
    """Return the error rows of a table, optionally of one code or of some keys."""
    rows = jobs_of(table).errors
    if code is not None:
        if not code.replace("_", "").isalnum():
            raise PblError("USAGE", found=f"code {code!r}", expected="an error code", next_step="see docs/errors.md")
        # DataJoint's own populate writes the name of the exception before its text.
        rows = rows & f"error_message REGEXP '^([A-Za-z]+: )?{code}:' OR error_message LIKE '{code}%%'"
    if keys is not None:
        rows = rows & [dict(k) for k in keys]
    return rows
