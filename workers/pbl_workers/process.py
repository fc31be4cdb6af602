"""A working process of `pbl worker`: connects, tests itself, works, and reports its jobs to the supervisor."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

from pbl_pipeline import temporary
from pbl_pipeline.bench.profile import profiled
from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import VISIBLE_GPUS, fewer_collections
from pbl_pipeline.video import frames_kept

from . import registry, run_job
from .log import event, to_stderr
from .queue import Claim
from .run_job import Outcome

log = logging.getLogger("pbl.worker")

#: Exit code of a process whose self-test failed: starting another would not help.
SELFTEST_FAILED = 3
#: Exit code of a process whose GPU does not compute, such as one without free memory.
DEVICE_FAILED = 4
#: Exit code that `multiprocessing` states of a process whose end the one it was forked from cannot tell any more.
UNHEARD = 255
_PR_SET_PDEATHSIG = 1  # of Linux' prctl.h
_LOADED_IN = os.getpid()  # of a forked process: the one that it was forked from


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `pbl worker`. grace_s: how long a running job may continue after SIGTERM. limit_factor: multiplies the
    time limits of the tables. gpus: dealt to the processes in turn, one to each; where all stages are served, one
    process for each GPU fits, and the others do the rest. phones: one process more takes only recordings of phones, and
    has precedence on the cores. Of one process: short: takes no job of a long recording; long: takes no others, and
    ends when none is left; phone: is the one for phones."""

    resource: str = "all"
    processes: int = 1
    batch: int = 1
    once: bool = False
    max_jobs: int | None = None
    grace_s: float = 60.0
    limit_factor: float = 1.0
    selftest: bool = True
    gpus: tuple[str, ...] = ()
    phones: bool = False
    short: bool = False
    long: bool = False
    phone: bool = False
    profile: str = ""  # folder for the processor times of each process (`bench.profile`)

    @property
    def lone(self) -> bool:
        """True if long recordings get a temporary process, because a single process serves detection."""
        ends = self.once or self.max_jobs is not None
        return self.processes == 1 and not ends and registry.DETECTOR in registry.GROUPS[self.resource]

    @property
    def all_processes(self) -> int:
        """Number of processes, with the one for phones, which is the last."""
        return self.processes + self.phones

    @property
    def shares_gpu(self) -> bool:
        """Of one process: True if others fit on its GPU."""
        return bool(self.gpus) and self.processes > 1 and registry.GROUPS[self.resource] == (registry.FIT,)

    def of_process(self, number: int) -> Options:
        """The options of one of the processes: its GPU, and how many processes share that; the last of several is for
        short recordings, so that long ones never hold them all; beside a lone one the number after the one for phones
        is for long recordings. The one for phones uses no GPU: its memory is for the others."""
        if number == self.processes:
            return dataclasses.replace(self, phone=True, processes=1, batch=1, gpus=(), max_jobs=None)
        one = dataclasses.replace(self, short=self.lone or 0 < number == self.processes - 1)
        if number > self.processes:
            one = dataclasses.replace(self, long=True, once=True, batch=1, selftest=False)
        if not self.gpus:
            return one
        n = len(self.gpus)
        # A fit takes gigabytes of a GPU, and one process fits more sessions than many can detect.
        resource = "cpu" if self.resource == "all" and n <= number < self.processes else self.resource
        gpus, sharing = (self.gpus[number % n],), 2 if self.lone else len(range(number % n, self.processes, n))
        return dataclasses.replace(one, resource=resource, gpus=gpus, processes=sharing)


@contextlib.contextmanager
def _ends_without_device() -> Iterator[None]:
    """End the process with DEVICE_FAILED where its GPU does not compute."""
    try:
        yield
    except Exception as error:
        if not (reason := run_job.device_failure(error)):
            raise
        event(log, logging.CRITICAL, "the device does not compute", error=reason)
        raise SystemExit(DEVICE_FAILED) from error


def begin(given: dict[str, str], target: Callable[..., None], options: Options, pipe: Connection) -> None:
    """Run `target` with these variables (`shared_cores`), which a process that was forked has from others. It dies with
    the one that it was forked from, as the supervisor hears from that one how it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getpid() != _LOADED_IN != os.getppid():  # it has ended already
            os._exit(UNHEARD)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    os.environ |= given
    target(options, pipe)


@_ends_without_device()
def work(options: Options, pipe: Connection) -> None:
    """Run a working process (`Options.of_process`): connect, run the self-test, work."""
    fewer_collections()
    if options.gpus:
        os.environ[VISIBLE_GPUS] = options.gpus[0]
    if options.phone:
        import jax

        os.environ |= {"JAX_PLATFORMS": "cpu", "PBL_ONNX_DEVICE": "cpu"}
        jax.config.update("jax_platforms", "cpu")  # it may have been imported, and have read its variable, before
    if options.processes > 1:
        # Otherwise JAX reserves most of a GPU's memory for the first of several processes that share it.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

    import pbl_schemas

    from . import heartbeat, loop, selftest

    stop = threading.Event()

    def end(*_: object) -> None:
        stop.set()

    def end_now(*_: object) -> None:
        stop.set()
        raise SystemExit(0)  # handlers above put the running job back

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)  # a terminal sends it to all; the supervisor decides
    signal.signal(signal.SIGUSR1, end_now)
    to_stderr()
    try:
        if not _connected(pbl_schemas, stop):
            return
    except PblError as error:
        event(log, logging.CRITICAL, "cannot start", code=error.code, text=error.text())
        raise SystemExit(1) from error
    to_stderr()  # connecting set DataJoint's own level
    temporary.sweep()  # of processes that were killed here
    tables = registry.tables_of(options.resource)
    if options.selftest:
        try:
            if not _tested(tables, stop):
                return
        except selftest.SelfTestFailed as error:
            event(log, logging.CRITICAL, "self-test failed", error=str(error))
            raise SystemExit(SELFTEST_FAILED) from error

    def report(job: Claim | None, outcome: Outcome | None) -> None:
        if job is not None:
            stage_is(job.table.__name__ if outcome is None else "-")
        try:
            pipe.send((job, outcome))
        except OSError:  # the supervisor has ended: so does this process
            stop.set()

    with heartbeat.Heartbeat(options.resource) as beats:
        takes = loop.takes(options.short, options.phones, options.phone, options.long)
        worker = loop.Worker(
            tables, beats, stop, report, options.batch, takes=takes, phone=options.phone or options.long
        )
        worker.siblings = options.processes > 1 and not options.long
        worker.shares_gpu = options.shares_gpu
        if options.short:
            worker.long_waits = functools.partial(report, None, None)
        event(log, logging.INFO, "worker started", resource=options.resource, worker=beats.worker)
        try:
            with frames_kept(), profiled(options.profile) as stage_is:
                worker.run(once=options.once, max_jobs=options.max_jobs)
        finally:
            event(log, logging.INFO, "worker ended", done=worker.done, failed=worker.failed)


def _connected(pbl_schemas: Any, stop: threading.Event) -> bool:
    """Connect and bind the tables, which loads the numerical libraries; wait until the database is available."""
    while not stop.is_set():
        try:
            pbl_schemas.activate()
            return True
        except PblError as error:
            if error.code != "DB_NOT_RUNNING":
                raise
            event(log, logging.WARNING, "database away", error=error.found)
        except run_job.DATABASE_ERRORS as error:
            event(log, logging.WARNING, "database away", error=str(error)[:200])
        stop.wait(run_job.DATABASE_PAUSE_S)
    return False


def _tested(tables: Sequence[Any], stop: threading.Event) -> bool:
    """Run the self-test; wait while the store is full or away."""
    from . import selftest

    while not stop.is_set():
        try:
            selftest.check(tables)
            return True
        except selftest.SelfTestFailed as error:
            cause = run_job.cause_outside(error)
            if cause is None:
                raise
            event(log, logging.WARNING, "store away", error=cause)
        stop.wait(run_job.STORE_WAIT_S)
    return False
