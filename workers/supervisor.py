"""`pbl worker`: a supervisor and its working processes.

The working processes compute (`workers.loop`) and report over a pipe which jobs they work on. The supervisor opens no
video and loads no numerical library, so it survives whatever a job does to its process: a process that dies is
replaced, and the job that killed it is put back, or becomes an error row when it has done so too often; a job beyond
its time limit is ended with its process.

By hand, although systemd and Kubernetes restart processes: they do not know which job a process worked on, so they
cannot count its crashes, end it at its time limit, or put it back. Where every process dies at its start, the
supervisor ends, and restarting it is left to them.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import multiprocessing
import os
import platform
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

from pbl_pipeline.errors import PblError
from schemas import connection
from schemas.rows import utc_now

from . import queue, registry, run_job
from .log import event, to_stderr
from .metrics import Metrics
from .queue import Claim
from .run_job import Outcome

log = logging.getLogger("pbl.worker")

#: After so many crashes of its process a job becomes an error row.
CRASHES = 3
#: Pause before a process that died is replaced (s): doubled up to the longest while processes keep dying.
RESTART_S = (0.5, 60.0)
#: After a process that lived for so long the pause begins anew (s).
HEALTHY_S = 60.0
#: After so many processes in a row that died earlier and without a job, the supervisor ends with an error.
HOPELESS = 5
#: After the grace period a process has this long to put its job back; then it is killed (s).
LAST_S = 15.0


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `pbl worker`. grace_s: how long a running job may continue after SIGTERM. limit_factor: multiplies the
    time limits of the tables."""

    resource: str = "all"
    processes: int = 1
    batch: int = 1
    once: bool = False
    max_jobs: int | None = None
    grace_s: float = 60.0
    limit_factor: float = 1.0
    selftest: bool = True


@dataclasses.dataclass
class _Child:
    process: Any
    pipe: Connection
    started: float
    jobs: dict[str, tuple[dict[str, Any], float]] = dataclasses.field(default_factory=dict)
    why: str = ""

    def holds(self, message: dict[str, Any], limit_factor: float) -> None:
        """Note a job that began or ended."""
        name = f"{message['table']} {message['hash']}"
        if message["what"] == "start":
            limit = registry.stage_of(message["table"]).limit_s * limit_factor
            self.jobs[name] = (message, time.monotonic() + limit)
        else:
            self.jobs.pop(name, None)


class Supervisor:
    """Keeps `options.processes` working processes alive until told to stop; `run` returns the exit code."""

    def __init__(self, options: Options, metrics: Metrics | None = None, target: Callable[..., None] | None = None):
        """`target` replaces `work` as the function that the processes run: tests and benchmarks install stand-ins."""
        self.options, self.metrics, self.target = options, metrics or Metrics(), target or work
        self._children: list[_Child] = []
        # Read from the processes, not counted: a process may announce a job twice, and die without ending any.
        self.metrics.in_hand.set_function(lambda: sum(len(c.jobs) for c in self._children))
        self._pause = RESTART_S[0]
        self._stillborn = 0
        self._stopping = False
        self._due: list[tuple[float, signal.Signals]] = []  # signals that are still to be sent, with their time
        # Not fork: threads of the numerical libraries do not survive it.
        self._start = multiprocessing.get_context("spawn")

    def stop(self, *_: object) -> None:
        """Let the running jobs end within the grace period; called again, do not wait for them."""
        end = time.monotonic() + (0.0 if self._stopping else self.options.grace_s)
        self._stopping = True
        self._due = [(0.0, signal.SIGTERM), (end, signal.SIGUSR1), (end + LAST_S, signal.SIGKILL)]

    def run(self) -> int:
        """Watch until every process has ended (`once`), or until SIGTERM or SIGINT."""
        before = {s: signal.signal(s, self.stop) for s in (signal.SIGTERM, signal.SIGINT)}
        try:
            self._children = [self._launch() for _ in range(self.options.processes)]
            code = 0
            while self._children:
                self._listen(0.5)
                self._send_due()
                self._end_overdue()
                code = max(code, self._reap())
            return code
        finally:
            for s, handler in before.items():
                signal.signal(s, handler)

    # ------------------------------------------------------------------------------------------------- processes
    def _launch(self) -> _Child:
        here, there = self._start.Pipe(duplex=False)
        process = self._start.Process(target=self.target, args=(self.options, there), name="pbl-worker")
        process.start()
        there.close()
        return _Child(process, here, time.monotonic())

    def _send_due(self) -> None:
        """Ask the processes to end after their job (SIGTERM), then to put it back (SIGUSR1), then kill them."""
        while self._due and time.monotonic() >= self._due[0][0]:
            _, signum = self._due.pop(0)
            event(log, logging.INFO, "stopping", signal=signum.name, grace_s=self.options.grace_s)
            for child in self._children:
                if signum == signal.SIGKILL:
                    child.why = "did not stop in time"
                if child.process.is_alive():
                    os.kill(child.process.pid, signum)

    def _listen(self, seconds: float) -> None:
        speaking = [c for c in self._children if not c.pipe.closed]
        wait([*(c.pipe for c in speaking), *(c.process.sentinel for c in self._children)], timeout=seconds)
        for child in speaking:
            try:
                while child.pipe.poll():
                    message = child.pipe.recv()
                    child.holds(message, self.options.limit_factor)
                    self.metrics.heard(message)
            except (EOFError, OSError):
                child.pipe.close()

    def _end_overdue(self) -> None:
        now = time.monotonic()
        for child in self._children:
            late = [m for m, until in child.jobs.values() if now > until]
            if late and child.process.is_alive():
                limit = registry.stage_of(late[0]["table"]).limit_s * self.options.limit_factor
                child.why = f"time limit of {limit:g} s"
                child.jobs = {k: v for k, v in child.jobs.items() if v[0] in late}
                os.kill(child.process.pid, signal.SIGKILL)

    def _reap(self) -> int:
        """Reap exited processes, handle their jobs, and replace those that should not have ended."""
        code = 0
        for child in list(self._children):
            if child.process.is_alive():
                continue
            self._listen(0.0)  # its last messages
            child.process.join()
            self._children.remove(child)
            exit_code = child.process.exitcode or 0
            if child.jobs:
                self._settle_jobs(child, exit_code)
            elif exit_code and not self._stopping:
                event(log, logging.ERROR, "process died", exit_code=exit_code, reason=_death(exit_code))
            if self._stopping or (exit_code == 0 and not child.jobs):
                code = max(code, 1 if exit_code > 0 else 0)
                continue
            if exit_code == SELFTEST_FAILED:
                return SELFTEST_FAILED
            healthy = time.monotonic() - child.started > HEALTHY_S
            self._stillborn = 0 if healthy or child.jobs else self._stillborn + 1
            if self._stillborn >= HOPELESS:
                event(log, logging.CRITICAL, "giving up", why=f"{HOPELESS} processes in a row died at their start")
                self.stop()
                code = 1
                continue
            if healthy:
                self._pause = RESTART_S[0]
            self.metrics.restarts.inc()
            time.sleep(self._pause)
            self._pause = min(2 * self._pause, RESTART_S[1])
            if not self._stopping:
                self._children.append(self._launch())
        return code

    def _settle_jobs(self, child: _Child, exit_code: int) -> None:
        reason = child.why or _death(exit_code)
        for message, _ in child.jobs.values():
            event(log, logging.ERROR, "job took its process down", reason=reason, about=message["about"])
            if not run_job.wait_for_database():
                return  # `recover` frees its reservation later
            job = _claim_of(message, child.process.pid)
            if self._stopping and not child.why.startswith("time limit"):
                queue.put_back(job, "the worker was stopped")
            else:
                settle_crash(job, reason, at_once=child.why.startswith("time limit"))


def settle_crash(job: Claim, reason: str, at_once: bool = False) -> bool:
    """Count a crash of this job; put it back, or make an error row of it after `CRASHES` (or `at_once`).

    Returns whether it became an error row.
    """
    from schemas.worker import Crash

    known = {"stage": job.table.__name__, "job_hash": job.hash}
    rows = (Crash & known).to_dicts()
    n = int(rows[0]["crash_n"]) + 1 if rows else 1
    plain = json.loads(json.dumps(job.key, default=str))
    row = {**known, "job_key": plain, "crash_n": n, "crash_reason": reason[:255], "crash_time": utc_now()}
    Crash.insert1(row, replace=True)
    if not at_once and n < CRASHES:
        queue.put_back(job, f"its process died ({reason})", 1.0)
        return False
    if at_once:
        error = PblError(
            "TIME_LIMIT",
            found=f"no result within the {reason}",
            expected="a result in that time",
            next_step="look at the recording; `pbl worker --limit-factor 4` allows more, then `pbl retry`",
            key=str(job),
        )
    else:
        error = PblError(
            "WORKER_CRASH",
            found=f"the worker's process died {n} times over this job, last: {reason}",
            expected="a result or a coded error",
            next_step="check memory (exit by SIGKILL) and the recording; then `pbl retry`, or report it",
            key=str(job),
        )
    (Crash & known).delete_quick()
    queue.fail(job, f"PblError: {error}")
    return True


def _claim_of(message: dict[str, Any], pid: int) -> Claim:
    table = registry.table_named(message["table"])
    return Claim(table, message["key"], message["priority"], platform.node(), pid, message["connection_id"])


def _death(exit_code: int) -> str:
    if exit_code < 0:
        return f"signal {signal.Signals(-exit_code).name}"
    return f"exit code {exit_code}"


# ------------------------------------------------------------------------------------------------ a working process
#: Exit code of a process whose self-test failed: starting another would not help.
SELFTEST_FAILED = 3


def work(options: Options, pipe: Connection) -> None:
    """Run a working process: connect, run the self-test, work."""
    if options.processes > 1:
        # Without this JAX reserves most of a GPU's memory for the first of several processes that share it.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import schemas

    from . import heartbeat, loop, selftest

    stop = threading.Event()

    def end(*_: object) -> None:
        stop.set()

    def end_now(*_: object) -> None:
        raise SystemExit(0)  # handlers above put the running job back

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)  # a terminal sends it to all; the supervisor decides
    signal.signal(signal.SIGUSR1, end_now)
    to_stderr()
    try:
        if not _connected(schemas, stop):
            return
    except PblError as error:
        event(log, logging.CRITICAL, "cannot start", code=error.code, text=error.text())
        raise SystemExit(1) from error
    to_stderr()  # connecting set DataJoint's own level
    tables = registry.tables_of(options.resource)
    if options.selftest:
        try:
            selftest.check(tables)
        except selftest.SelfTestFailed as error:
            event(log, logging.CRITICAL, "self-test failed", error=str(error))
            raise SystemExit(SELFTEST_FAILED) from error

    def say(what: str, job: Claim | None, outcome: Outcome | None) -> None:
        if job is None:
            return
        message: dict[str, Any] = {
            "what": what,
            "table": job.table.__name__,
            "hash": job.hash,
            "key": job.key,
            "about": str(job),
            "priority": job.priority,
            "connection_id": job.connection_id,
        }
        if outcome is not None:
            message |= {"outcome": outcome.what, "seconds": outcome.seconds, "code": outcome.code}
        try:
            pipe.send(message)
        except OSError:  # the supervisor has ended: end, too
            stop.set()

    with heartbeat.Heartbeat(options.resource) as beats:
        worker = loop.Worker(tables, beats, stop, say, options.batch)
        event(log, logging.INFO, "worker started", resource=options.resource, worker=beats.worker)
        try:
            worker.run(once=options.once, max_jobs=options.max_jobs)
        finally:
            event(log, logging.INFO, "worker ended", done=worker.done, failed=worker.failed)


def _connected(schemas: Any, stop: threading.Event) -> bool:
    """Connect and bind the tables, which loads the numerical libraries; wait until the database is available."""
    while not stop.is_set():
        try:
            schemas.activate()
            return True
        except PblError as error:
            if error.code != "DB_NOT_RUNNING":
                raise
            event(log, logging.WARNING, "database away", error=error.found)
        except run_job.DATABASE_ERRORS as error:
            event(log, logging.WARNING, "database away", error=str(error)[:200])
        stop.wait(run_job.DATABASE_PAUSE_S)
    return False


def listen_for_metrics(metrics: Metrics, port: int, host: str = "127.0.0.1") -> None:
    """Serve the metrics; the lengths of the queues are read from the database at each request."""
    metrics.serve(port, host, connection.another)
