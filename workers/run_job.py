"""One reserved job through DataJoint's three-part make: computed once, inserted once, whatever happens in between."""

from __future__ import annotations

import dataclasses
import errno
import threading
import time
import traceback
from collections.abc import Sequence
from typing import Any

import deepdiff
import pymysql

from pbl_pipeline.errors import PblError
from schemas import connection
from schemas.coded_errors import error_code
from schemas.connection import DuplicateError, LostConnectionError

from . import queue
from .queue import Claim, ReservationLost

#: What a job can come to.
DONE, ALREADY, LOST, FAILED, LATER = "done", "already there", "somebody else has it", "failed", "later"

#: What the driver and DataJoint raise for the database itself, and the numbers that say that it is away (the computed
#: result is kept and written when it is back) or that the same statement will do next time.
DATABASE_ERRORS = (LostConnectionError, pymysql.err.OperationalError, pymysql.err.InterfaceError)
AWAY = (0, 1040, 1053, 1927, 2002, 2003, 2006, 2013, 2055, 4031)
REPEAT = (1020, 1205, 1213)
#: Errors of the file system that say nothing about the job: store full, read-only, away.
STORE_GONE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE, errno.ENOTCONN, errno.EACCES)
#: How long a job waits after such an error (s).
STORE_WAIT_S = 60.0
#: How long a result is kept for a database that is away, and the pause between two attempts to reach it (s).
DATABASE_WAIT_S, DATABASE_PAUSE_S = 3600.0, 2.0


@dataclasses.dataclass
class Outcome:
    """What became of a job. code: of an error. seconds: all of it, the wait for a database included."""

    job: Claim
    what: str
    seconds: float = 0.0
    code: str = ""
    text: str = ""


@dataclasses.dataclass
class Computed:
    """A result that was computed before its insert, and what it was computed from."""

    fetched: Any
    result: tuple

    def of(self, fetched: tuple) -> bool:
        """Whether these inputs are the same."""
        try:
            return bool(fetched == self.fetched)
        except ValueError:  # arrays among them have no one answer; hashing takes milliseconds
            return deepdiff.DeepHash(fetched)[fetched] == deepdiff.DeepHash(self.fetched)[self.fetched]


def run(job: Claim, computed: Computed | None = None, stop: threading.Event | None = None) -> Outcome:
    """Compute and insert one reserved job, and end its reservation.

    `computed`: a result from a batch; it is used if the inputs are still those it was computed from.

    A result is inserted only while the reservation is ours (`queue.hold`), so that a job which two processes were given
    leaves one row. Where the database goes away after the computation, the result is kept and inserted when it is
    back, for up to `DATABASE_WAIT_S`. A store that is full or away puts the job back for `STORE_WAIT_S`.

    KeyboardInterrupt and SystemExit put the job back and go on up.
    """
    start, kept = time.monotonic(), [computed] if computed else []
    table = job.table()
    make_compute, make_insert = table.make_compute, table.make_insert

    def compute_once(key: dict, *fetched: Any) -> tuple:
        if kept and kept[0].of(fetched):
            return kept[0].result
        kept[:] = [Computed(fetched, make_compute(key, *fetched))]
        return kept[0].result

    def insert_fenced(key: dict, *result: Any) -> None:
        queue.hold(job)
        make_insert(key, *result)

    table.make_compute, table.make_insert = compute_once, insert_fenced

    def ended(what: str, error: BaseException | None = None) -> Outcome:
        text = f"{type(error).__name__}: {error}" if error is not None else ""
        return Outcome(job, what, time.monotonic() - start, error_code(text) if error else "", text)

    repeated = 0
    while True:
        try:
            made = table._populate1(dict(job.key), None, suppress_errors=True, return_exception_objects=True)
            error = made[1] if isinstance(made, tuple) else None
            if error is None:
                queue.finish(job)
                return ended(DONE if made is True else ALREADY)
            if isinstance(error, (KeyboardInterrupt, SystemExit)):
                raise error
        except (KeyboardInterrupt, SystemExit):
            queue.put_back(job)
            raise
        except DATABASE_ERRORS as lost:  # also DataJoint's own bookkeeping may meet a database that is gone
            error = lost
        if is_gone(error):
            if not wait_for_database(stop):
                queue.let_go(job)  # its reservation is that of a dead process, and is freed as such
                return ended(LATER, error)
        elif _number(error) in REPEAT and repeated < 10:
            repeated += 1
        else:
            return _after_error(job, error, ended)


def _after_error(job: Claim, error: BaseException, ended: Any) -> Outcome:
    if isinstance(error, ReservationLost):
        queue.let_go(job)
        return ended(LOST, error)
    if isinstance(error, DuplicateError) and len(job.table() & job.key):
        queue.finish(job)
        return ended(ALREADY)
    store = _store_error(error)
    if store is not None:
        queue.put_back(job, f"STORE: {store}", STORE_WAIT_S)
        return ended(LATER, error)
    if "Referential integrity failed" in str(error) or "fetch1" in str(error):
        queue.put_back(job, "its inputs changed", 1.0)  # a row above was deleted or replaced while we computed
        return ended(LATER, error)
    message = f"{type(error).__name__}: {error}"
    queue.fail(job, message, "".join(traceback.format_exception(error)))
    return ended(FAILED, error)


def _store_error(error: BaseException) -> str | None:
    """What the file system said where it is the store's fault and not the job's."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, OSError) and seen.errno in STORE_GONE and not isinstance(error, PblError):
            return f"{type(seen).__name__}: {seen}"
        seen = seen.__cause__ or seen.__context__
    return None


def _number(error: BaseException) -> int:
    """The server's number of an error, 0 where there is none."""
    first = error.args[0] if error.args else 0
    return first if isinstance(first, int) else 0


def is_gone(error: BaseException) -> bool:
    """Whether an error says that the database cannot be reached."""
    return isinstance(error, LostConnectionError) or (isinstance(error, DATABASE_ERRORS) and _number(error) in AWAY)


def wait_for_database(stop: threading.Event | None = None, longest_s: float = DATABASE_WAIT_S) -> bool:
    """Return True when the server answers (again); False after `longest_s`, or where we are to stop."""
    until = time.monotonic() + longest_s
    while time.monotonic() < until:
        try:
            connection.connect()
            return True
        except (PblError, *DATABASE_ERRORS):
            if stop is None:
                time.sleep(DATABASE_PAUSE_S)
            elif stop.wait(DATABASE_PAUSE_S):
                return False
    return False


def fetch_batch(jobs: Sequence[Claim]) -> list[tuple | None]:
    """The inputs of several jobs of one table; None where they cannot be fetched (what is wrong is said when the job
    runs alone)."""
    table, out = jobs[0].table(), []
    for job in jobs:
        try:
            out.append(table.make_fetch(dict(job.key)))
        except DATABASE_ERRORS:
            raise
        except Exception:  # noqa: BLE001
            out.append(None)
    return out


def compute_batch(jobs: Sequence[Claim], fetched: Sequence[tuple | None]) -> list[Computed | None]:
    """Compute several jobs together (`make_computes` of their table); touches no database.

    A job without inputs, or of a batch that fails, gives None: it is then run alone, and its error is its own.
    """
    out: list[Computed | None] = [None] * len(jobs)
    good = [i for i, f in enumerate(fetched) if f is not None]
    try:
        results = jobs[0].table().make_computes([dict(jobs[i].key) for i in good], [fetched[i] for i in good])
    except Exception:  # noqa: BLE001
        return out
    for i, result in zip(good, results, strict=True):
        if result is not None:
            out[i] = Computed(fetched[i], result)
    return out
