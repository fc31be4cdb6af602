"""Execution of one reserved job: computed once and inserted once, despite interruptions."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import deepdiff
import pymysql

from pbl_pipeline.errors import PblError, causes
from pbl_schemas import connection
from pbl_schemas.connection import DuplicateError, IntegrityError, LostConnectionError, inserting
from pbl_schemas.datajoint_setup import AWAY, FULL, REPEAT
from pbl_schemas.job_errors import error_message, of_database, of_job
from pbl_schemas.jobs import keys_of
from pbl_schemas.rows import InputChanged, exist
from pbl_schemas.stored_files import remove_left_over

from . import queue, recover
from .queue import Claim, ReservationLost

#: Outcomes of a job.
DONE, ALREADY, LOST, FAILED, LATER = "done", "already there", "another worker has it", "failed", "later"
#: The key of the job is gone: a row above was deleted, or another selection replaced it. The job is deleted.
VANISHED = "no longer asked for"

#: Exceptions of the driver and DataJoint about the database: where it is away, full or read-only the computed result is
#: kept and written later; at most `REPEATS` times the same statement is tried again immediately.
DATABASE_ERRORS = (
    LostConnectionError,
    pymysql.err.OperationalError,
    pymysql.err.InterfaceError,
    pymysql.err.InternalError,
)
REPEATS = 10
#: Attempts of a job whose inputs are gone or changed, and how long it waits after each but the last (s).
ATTEMPTS, RETRY_S = 3, (1.0, 30.0)
#: Errors of the file system that are unrelated to the job: store full, read-only, away.
STORE_GONE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE, errno.ENOTCONN, errno.EACCES)
#: How long a job waits after such an error (s).
STORE_WAIT_S = queue.LONGEST_WAIT_S
#: Of which JAX's messages have one where a device does not compute.
DEVICE_WORDS = ("CUDA", "RESOURCE_EXHAUSTED", "UNAVAILABLE")
#: How long a result is kept for a database that is away, and the pause between two attempts to reach it (s).
DATABASE_WAIT_S, DATABASE_PAUSE_S = 3600.0, 2.0


@dataclasses.dataclass
class Outcome:
    """Outcome of a job. code: of an error. seconds: all of it, the wait for a database included."""

    job: Claim
    what: str
    seconds: float = 0.0
    code: str = ""
    text: str = ""


@dataclasses.dataclass
class Computed:
    """A result that was computed before its insert, with its inputs."""

    fetched: tuple
    result: tuple

    def of(self, fetched: tuple) -> bool:
        """Return whether these inputs are the same."""
        with contextlib.suppress(ValueError):  # arrays among them have no one answer
            if bool(fetched == self.fetched):
                return True
        # A hash takes milliseconds; it also finds two NaN alike.
        return deepdiff.DeepHash(fetched)[fetched] == deepdiff.DeepHash(self.fetched)[self.fetched]


def run(
    job: Claim,
    computed: Computed | None = None,
    stop: threading.Event | None = None,
    waiting: Callable[[], None] = lambda: None,
) -> Outcome:
    """Compute and insert one reserved job, and end its reservation.

    `computed`: a result from a batch; it is used if the inputs are still those it was computed from. `waiting`: called
    again and again while the job waits for the database.

    A result is inserted only while the reservation is ours (`queue.lock_reservation`), so that a job which two
    processes were given leaves one row. Where the database goes away after the computation, or its disk is full, the
    result is kept and inserted when it is back, for up to `DATABASE_WAIT_S`. A store that is full or away puts the job
    back for `STORE_WAIT_S`. A job whose inputs are gone or changed is put back too, each time for longer; `ATTEMPTS` of
    these make an error row.

    KeyboardInterrupt and SystemExit put the job back and go on up. Raises `PblError` DEVICE_UNAVAILABLE where the
    device does not compute: it counts as a crash of the process, which has to end.
    """
    start, attempt, repeated = time.monotonic(), _Attempt(job, computed), 0
    while True:
        try:
            outcome = Outcome(job, attempt.make())
            queue.finish(job)
            break
        except (KeyboardInterrupt, SystemExit):
            queue.put_back(job)
            raise
        except Exception as error:
            repeated += 1
            if is_gone(error) or number_of(error) in FULL:
                kept = repeated * DATABASE_PAUSE_S < DATABASE_WAIT_S
                if kept and wait_for_database(stop, waiting, pause=not is_gone(error)):
                    continue
                queue.release(job)  # its reservation is that of a dead process, and is freed as such
                outcome = _outcome(job, LATER, error)
            elif number_of(error) in REPEAT and repeated < REPEATS:
                continue
            elif reason := device_failure(error):  # all further jobs of this process would meet it too
                recover.crashed(job, reason)
                raise _no_device(job, reason) from error
            else:
                outcome = _settle(job, error)
            break
    return dataclasses.replace(outcome, seconds=time.monotonic() - start)


@dataclasses.dataclass
class _Attempt:
    """Fetch, compute, insert. What was computed is kept for the next attempt, where its inputs are still the same."""

    job: Claim
    computed: Computed | None = None

    def make(self) -> str:
        """DONE, ALREADY (the row is there) or VANISHED (it is not asked for any longer); raises what goes wrong."""
        table, key = self.job.table(), self.job.key
        there, wanted = exist(table & key, _wanted(self.job))
        if there or not wanted:
            return ALREADY if there else VANISHED
        if self.computed is not None:
            with contextlib.suppress(InputChanged):  # then it is computed again
                self._insert(table, key, self.computed)
                return DONE
        fetched = table.make_fetch(dict(key))
        self.computed = Computed(fetched, table.make_compute(dict(key), *fetched))
        self._insert(table, key, self.computed)
        return DONE

    def _insert(self, table: Any, key: dict[str, Any], computed: Computed) -> None:
        """Insert what was computed. Raises InputChanged if its inputs are not the same any longer."""
        with table.connection.transaction:
            queued_s = queue.lock_reservation(self.job)
            if not computed.of(table.make_fetch(dict(key))):
                raise InputChanged("other rows than before the computation", self.job)
            remove_left_over(table, key, queued_s)
            try:
                with inserting(table):
                    table.make_insert(dict(key), *computed.result)
            except BaseException as error:
                if not is_gone(error):  # then another worker may have the job; the next insert removes them
                    remove_left_over(table, key, queued_s)
                raise


def _wanted(job: Claim) -> Any:
    """Query of the key, with a row if it can still be computed: its rows above exist, and it is still requested."""
    return keys_of(job.table) & job.key


def _outcome(job: Claim, what: str, error: BaseException) -> Outcome:
    if what == LATER and not isinstance(error, PblError):
        error = of_database(error) or error  # the job is not at fault
    coded = of_job(error, job.table.__name__, job.key)
    return Outcome(job, what, code=coded.code, text=coded.text())


def _settle(job: Claim, error: Exception) -> Outcome:
    """End the reservation of a job that failed, by what kind of error it was."""
    if isinstance(error, ReservationLost):
        queue.release(job)
        return Outcome(job, LOST)
    if isinstance(error, DuplicateError) and job.key in job.table():
        queue.finish(job)
        return Outcome(job, ALREADY)
    if cause := cause_outside(error):
        queue.put_back(job, cause, STORE_WAIT_S)
        return _outcome(job, LATER, error)
    if isinstance(error, IntegrityError):  # a row above was deleted while we computed
        error = InputChanged(f"a row that the result refers to is gone ({error})", job)
    if isinstance(error, InputChanged):
        if not _wanted(job):
            queue.finish(job)
            return Outcome(job, VANISHED)
        tried = job.attempts + 1
        if tried < ATTEMPTS:
            queue.put_back(job, f"its inputs changed: {error.found}", RETRY_S[job.attempts], attempts=tried)
            return _outcome(job, LATER, error)
    queue.fail(
        job,
        error_message(error, job.table.__name__, job.key),
        "".join(traceback.format_exception(error)),
    )
    return _outcome(job, FAILED, error)


def cause_outside(error: BaseException) -> str | None:
    """Return the message of the file system or the database if the store or the server is at fault, not the job."""
    if number_of(error) in REPEAT:
        return f"DATABASE: {type(error).__name__}: {error}"
    if isinstance(error, PblError) and error.code == "STORE_FULL":  # `pbl_schemas.origin.computes` gave it its code
        return f"STORE: {error.found}"
    for seen in causes(error):
        if isinstance(seen, OSError) and seen.errno in STORE_GONE and not isinstance(error, PblError):
            return f"STORE: {type(seen).__name__}: {seen}"
    return None


def device_failure(error: BaseException) -> str:
    """Return JAX's message where the device does not compute, a GPU that is gone or has no memory left, else "".

    Any other error of JAX is one of the job, which the next device would meet too.
    """
    seen = next((e for e in causes(error) if type(e).__name__ in ("JaxRuntimeError", "XlaRuntimeError")), None)
    message = " ".join(str(seen).split())[:200]
    return message if seen and any(word in message for word in DEVICE_WORDS) else ""


def _no_device(job: Claim, reason: str) -> PblError:
    return PblError(
        "DEVICE_UNAVAILABLE",
        found=reason,
        expected="a device that computes",
        next_step="see whether `nvidia-smi` lists it and memory is free; the job waits for another process",
        key=str(job),
    )


def number_of(error: BaseException) -> int:
    """The server's number of an error, 0 if there is none."""
    first = error.args[0] if isinstance(error, DATABASE_ERRORS) and error.args else 0
    return first if isinstance(first, int) else 0


def is_gone(error: BaseException) -> bool:
    """Return whether an error means that the database cannot be reached."""
    return isinstance(error, LostConnectionError) or (isinstance(error, DATABASE_ERRORS) and number_of(error) in AWAY)


def wait_for_database(
    stop: threading.Event | None = None, waiting: Callable[[], None] = lambda: None, pause: bool = False
) -> bool:
    """Return True when the server answers (again); False after `DATABASE_WAIT_S`, or where we are to stop.

    `waiting` is called before each pause, of which there is one at least with `pause`.
    """
    stop, until = stop or threading.Event(), time.monotonic() + DATABASE_WAIT_S
    while time.monotonic() < until:
        if not pause:
            with contextlib.suppress(PblError, *DATABASE_ERRORS):
                connection.connect()
                return True
        pause = False
        waiting()
        if stop.wait(DATABASE_PAUSE_S):
            return False
    return False


def fetch_batch(jobs: Sequence[Claim]) -> list[tuple | None]:
    """Return the inputs of several jobs of one table; None if they cannot be fetched (the job alone reports why)."""
    table, out = jobs[0].table(), []
    for job in jobs:
        try:
            out.append(table.make_fetch(dict(job.key)))
        except DATABASE_ERRORS:
            raise
        except Exception:  # noqa: BLE001
            out.append(None)
    return out


def compute_batch(
    jobs: Sequence[Claim], fetched: Sequence[tuple | None], threads: int | None = None
) -> list[Computed | None]:
    """Compute several jobs together (`make_computes` of their table); touches no database.

    The result is None for a job without inputs or of a batch that fails: it is then run alone and reports its own
    error.
    """
    out: list[Computed | None] = [None] * len(jobs)
    good = [i for i, f in enumerate(fetched) if f is not None]
    try:
        keys = [dict(jobs[i].key) for i in good]
        results = jobs[0].table().make_computes(keys, [fetched[i] for i in good], threads)
    except Exception:  # noqa: BLE001
        return out
    for i, result in zip(good, results, strict=True):
        inputs = fetched[i]
        if result is not None and inputs is not None:
            out[i] = Computed(inputs, result)
    return out
