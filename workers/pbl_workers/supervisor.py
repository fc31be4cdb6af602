"""`pbl worker`: a supervisor and its working processes.

The working processes compute (`pbl_workers.loop`) and report over a pipe which jobs they work on. The supervisor opens
no video and loads no numerical library, so it survives a job that crashes its process: a process that dies is
replaced, and the job that killed it is put back, or becomes an error row when it has done so too often; a job beyond
its time limit is ended with its process.

By hand, although systemd and Kubernetes restart processes: they do not know which job a process worked on, so they
cannot count its crashes, end it at its time limit, or put it back. Deaths are counted for each place of a process: one
GPU without memory stops no other process. Only where every process dies at its start, the supervisor ends, and
restarting it is left to them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import shared_cores
from pbl_schemas import connection, worker

from . import queue, recover, registry, run_job
from .heartbeat import Heartbeat, Silent
from .log import event
from .metrics import Metrics
from .process import DEVICE_FAILED, SELFTEST_FAILED, UNHEARD, Options, begin, work
from .queue import Claim
from .run_job import Outcome

log = logging.getLogger("pbl.worker")

#: Pause before a process that died is replaced (s): doubled up to the longest while those in its place keep dying.
RESTART_S = (0.5, 60.0)
#: Lifetime of a process after which the pause begins again from the shortest (s).
HEALTHY_S = 60.0
#: After so many processes in a row that died earlier and without a job, in every place, the supervisor ends.
HOPELESS = 5
#: Nice value of the other processes where one is for phones: it then gets nine tenths of each core that it wants.
BATCH_NICE = 10
#: After the grace period a process has this long to put its job back; then it is killed (s).
LAST_S = 15.0


@contextlib.contextmanager
def _copies_of(module: str) -> Iterator[None]:
    """Fork processes from one that has imported a module; before and after the block, others are copies of another
    one, with other variables (`pbl_pipeline.limited`)."""
    if sys.platform != "linux":
        yield
        return
    from multiprocessing import forkserver

    copied: Any = forkserver._forkserver  # pyright: ignore - ending it has no public name
    others = copied._preload_modules
    copied._stop()
    copied.set_forkserver_preload([module])
    try:
        yield
    finally:
        copied._stop()
        copied.set_forkserver_preload(others)


@dataclasses.dataclass
class _Child:
    process: Any
    pipe: Connection
    started: float
    jobs: dict[tuple[str, str], tuple[Claim, float]] = dataclasses.field(default_factory=dict)
    why: str = ""
    number: int = 0  # which of the worker's processes it is: its replacement gets the same GPU
    overdue: bool = False

    def heard(self, job: Claim, outcome: Outcome | None, limit_factor: float) -> None:
        """Note a job that began (no outcome yet) or ended."""
        name = (job.table.__name__, job.hash)
        if outcome is None:
            self.jobs[name] = (job, time.monotonic() + _limit_s(job, limit_factor))
        else:
            self.jobs.pop(name, None)


@dataclasses.dataclass
class _Place:
    """Place of a working process. deaths: in a row, as `HOPELESS` counts them. lived_s: the longest life of these.
    until: end of its pause (`time.monotonic`) while no process has it."""

    name: str
    deaths: int = 0
    lived_s: float = 0.0
    pause_s: float = 0.0
    until: float = 0.0
    why: str = ""

    def lives(self, lived_s: float) -> None:
        """Forget deaths once a process lives longer than those before it."""
        self.deaths *= lived_s < min(2 * self.lived_s, HEALTHY_S)

    def rest(self, why: str, lived_s: float, over_job: bool) -> None:
        """Pause after a death."""
        healthy = lived_s > HEALTHY_S
        self.deaths = 0 if healthy or over_job else self.deaths + 1
        self.lived_s = max(self.lived_s, lived_s)
        shortest, longest = RESTART_S
        self.pause_s = shortest if healthy or not self.pause_s else min(2 * self.pause_s, longest)
        self.why, self.until = why, time.monotonic() + self.pause_s

    def __str__(self) -> str:
        then = f"starts again {self.pause_s:g} s after it died" if self.until < math.inf else "is not started again"
        return f"{self.name} {then}: {self.why}{f', {self.deaths} times in a row' if self.deaths > 1 else ''}"


class Supervisor:
    """Keeps `options.all_processes` working processes alive until told to stop; `run` returns the exit code."""

    def __init__(self, options: Options, metrics: Metrics | None = None, target: Callable[..., None] | None = None):
        """`target` replaces `work` as the function that the processes run: tests and benchmarks install stand-ins."""
        self.options, self.metrics, self.target = options, metrics or Metrics(), target or work
        self._children: list[_Child] = []
        # Read from the processes, not counted: a process may announce a job twice, and die without ending any.
        self.metrics.in_hand.set_function(lambda: sum(len(c.jobs) for c in self._children))
        self._places: dict[int, _Place] = {}
        self._beats: Silent = Silent()
        self._stopping = False
        self._long_waits = False  # as a process for short recordings said
        self._due: list[tuple[float, signal.Signals]] = []  # signals that are still to be sent, with their time
        self._unsettled: list[Callable[[], Any]] = []  # what is to become of jobs of processes that died
        self._settle_at = 0.0
        # Copies of a process that has only loaded the libraries (`_copies_of`): they begin at once, with its memory.
        # Not copies of this one: its threads would not survive that.
        self._start = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
        self.loaded = "pbl_workers.loaded"

    def stop(self, *_: object) -> None:
        """Let the running jobs end within the grace period; called again, do not wait for them."""
        end = time.monotonic() + (0.0 if self._stopping else self.options.grace_s)
        self._stopping = True
        self._due = [(0.0, signal.SIGTERM), (end, signal.SIGUSR1), (end + LAST_S, signal.SIGKILL)]

    def run(self) -> int:
        """Watch until every process has ended (`once`), or until SIGTERM or SIGINT."""
        before = {s: signal.signal(s, self.stop) for s in (signal.SIGTERM, signal.SIGINT)}
        try:
            with Heartbeat(worker.SUPERVISOR) as self._beats, _copies_of(self.loaded):
                return self._watch()
        finally:
            for s, handler in before.items():
                signal.signal(s, handler)

    def _watch(self) -> int:
        self._children = [self._launch(number) for number in range(self.options.all_processes)]
        code = 0
        while self._places:
            self._listen(0.5)
            self._send_due()
            self._end_overdue()
            code = max(code, self._reap())
            if self._places and min(self._places) >= self.options.processes and not self._stopping:
                self.stop()  # the processes for phones and long recordings do not outlive the others
            self._serve_long()
            self._settle()
        return code

    # ------------------------------------------------------------------------------------------------- processes
    def _place(self, number: int) -> _Place:
        if number not in self._places:
            gpus = self.options.of_process(number).gpus
            self._places[number] = _Place(f"process {number + 1}{f' (GPU {gpus[0]})' if gpus else ''}")
        return self._places[number]

    def _launch(self, number: int) -> _Child:
        here, there = self._start.Pipe(duplex=False)
        options = self.options.of_process(number)
        with shared_cores(1 if options.phone else self.options.processes + options.long) as given:
            arguments = (given, self.target, options, there)
            process = self._start.Process(target=begin, args=arguments, name="pbl-worker")
            try:
                process.start()
            except (EOFError, OSError):  # the process with the libraries was killed meanwhile
                process = multiprocessing.get_context("spawn").Process(target=begin, args=arguments, name="pbl-worker")
                process.start()
        if self.options.phones and not options.phone and process.pid and hasattr(os, "setpriority"):  # not on Windows
            # From here, before its libraries start threads, which keep the priority they began with.
            with contextlib.suppress(OSError):  # it has ended
                os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + BATCH_NICE)
        there.close()
        self._place(number)
        return _Child(process, here, time.monotonic(), number=number)

    def _serve_long(self) -> None:
        """Start the process for long recordings that a lone process asked for, if there is none."""
        number, asked = self.options.processes + 1, self._long_waits and self.options.lone and not self._stopping
        if asked and number not in self._places:
            self._children.append(self._launch(number))
        self._long_waits = False

    def _send_due(self) -> None:
        """Ask the processes to end after their job (SIGTERM), then to put it back (SIGUSR1), then kill them.

        One signal at a time: of two at once another thread than the main one may get the second, and a wait in which
        the main one is (a sleep, a read) then goes on as if it had not come.
        """
        now, signum = time.monotonic(), None
        while self._due and now >= self._due[0][0]:
            _, signum = self._due.pop(0)
        if signum is not None:
            event(log, logging.INFO, "stopping", signal=signum.name, grace_s=self.options.grace_s)
            for child in self._children:
                if signum == signal.SIGKILL:
                    child.why = "did not stop in time"
                if child.process.is_alive():
                    with contextlib.suppress(ProcessLookupError):  # that it has ended is heard later
                        os.kill(child.process.pid, signum)

    def _listen(self, seconds: float) -> None:
        speaking = [c for c in self._children if not c.pipe.closed]
        wait([*(c.pipe for c in speaking), *(c.process.sentinel for c in self._children)], timeout=seconds)
        for child in speaking:
            try:
                while child.pipe.poll():
                    job, outcome = child.pipe.recv()
                    if job is None:
                        self._long_waits = True
                        continue
                    child.heard(job, outcome, self.options.limit_factor)
                    if outcome is not None and outcome.what != run_job.LATER:
                        self._place(child.number).deaths = 0
                    self.metrics.heard(job, outcome)
            except (EOFError, OSError):
                child.pipe.close()

    def _end_overdue(self) -> None:
        now = time.monotonic()
        for child in self._children:
            late = {name: (job, until) for name, (job, until) in child.jobs.items() if now > until}
            if late and child.process.is_alive():
                first, _ = next(iter(late.values()))
                child.why = f"time limit of {_limit_s(first, self.options.limit_factor):g} s"
                child.jobs, child.overdue = late, True
                child.process.kill()

    def _reap(self) -> int:
        """Reap exited processes, handle their jobs, and replace those that should not have ended, each after the pause
        of its place."""
        code = 0
        for child in list(self._children):
            place, lived_s = self._place(child.number), time.monotonic() - child.started
            if child.process.is_alive():
                place.lives(lived_s)
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
                code = max(code, int(exit_code > 0 and exit_code != DEVICE_FAILED))
                del self._places[child.number]
                continue
            place.rest(_death(exit_code), lived_s, bool(child.jobs))
            if exit_code == SELFTEST_FAILED:
                code, place.deaths, place.until = SELFTEST_FAILED, HOPELESS, math.inf
            event(log, logging.WARNING, "replaced later", about=str(place))
        # The processes for phones and long recordings compute on no GPU and do not outlive the others.
        main = [p for n, p in self._places.items() if n < self.options.processes]
        if main and not self._stopping and all(p.deaths >= HOPELESS for p in main):
            event(log, logging.CRITICAL, "giving up", why="; ".join(map(str, main)))
            self.stop()
            code = max(code, 1)
        self._wake()
        return code

    def _wake(self) -> None:
        """Start processes in places whose pause is over, and report the others."""
        for number in self._places.keys() - {c.number for c in self._children}:
            if self._stopping:
                del self._places[number]
            elif time.monotonic() >= self._places[number].until:
                self.metrics.restarts.inc()
                self._children.append(self._launch(number))
        busy = {c.number for c in self._children}
        self._beats.doing("; ".join(str(p) for n, p in sorted(self._places.items()) if n not in busy))

    def _settle_jobs(self, child: _Child, exit_code: int) -> None:
        reason = child.why or _death(exit_code)
        what = "job lost its process" if exit_code == UNHEARD else "job took its process down"
        for job, _ in child.jobs.values():
            event(log, logging.ERROR, what, reason=reason, about=str(job))
            if child.overdue:
                self._unsettled.append(partial(recover.overdue, job, _limit_s(job, self.options.limit_factor)))
            elif self._stopping or exit_code == UNHEARD:
                why = "the worker was stopped" if self._stopping else reason
                self._unsettled.append(partial(queue.put_back, job, why))
            else:
                self._unsettled.append(partial(recover.crashed, job, reason))
        self._settle()

    def _settle(self) -> None:
        """Settle jobs of dead processes; while the database is away this is retried, or left to `recover`."""
        while self._unsettled and time.monotonic() >= self._settle_at:
            try:
                connection.connect()
                self._unsettled[0]()
            except (PblError, *run_job.DATABASE_ERRORS):
                self._settle_at = time.monotonic() + run_job.DATABASE_PAUSE_S
            else:
                self._unsettled.pop(0)


def _limit_s(job: Claim, factor: float) -> float:
    return registry.stage_of(job.table).limit_s * factor


_EXITS = {
    SELFTEST_FAILED: "its self-test failed",
    DEVICE_FAILED: "its GPU does not compute, or has no memory free",
    UNHEARD: "the process that it was forked from has ended",
}


def _death(exit_code: int) -> str:
    if exit_code < 0:
        return f"signal {signal.Signals(-exit_code).name}"
    return _EXITS.get(exit_code, f"exit code {exit_code}")
