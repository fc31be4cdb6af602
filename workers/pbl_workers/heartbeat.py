"""A worker's heartbeat: a thread writes every few seconds that it is alive, its current job, and its finished jobs.

systemd and Kubernetes know whether a process is alive on their machine; this reports it to workers on other machines,
which free the reservations of dead ones (`recover`), and to `pbl status`.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import secrets
import threading
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pymysql

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import shortened
from pbl_pipeline.resources import gpu_use
from pbl_schemas import connection, worker
from pbl_schemas.connection import dj

#: Seconds between two heartbeats.
PERIOD_S = 15.0


class Silent:
    """Receiver of a worker's reports; this one ignores them, for a worker without a row in `Worker`."""

    def doing(self, what: str) -> None:
        """Report the current job."""

    def count(self, stage: str, done: int, failed: int, busy_s: float) -> None:
        """Report finished jobs of a stage and the seconds they took."""


class Heartbeat(Silent):
    """A context manager that keeps a row of `Worker` up to date.

    The thread has its own connection (DataJoint's is not safe between threads). While the database is unavailable beats
    are skipped and counts are kept until they can be written.
    """

    def __init__(self, resource: str) -> None:
        self.worker = secrets.token_hex(8)
        self.resource = resource
        self._doing = ""
        self._counts: dict[str, list[float]] = defaultdict(lambda: [0, 0, 0.0])
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._connection: Any = None

    def __enter__(self) -> Heartbeat:
        self._try_to_beat()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        with contextlib.suppress(pymysql.err.Error, dj.DataJointError, PblError, OSError):
            self._beat(last=True)
            self._connection.close()

    def doing(self, what: str) -> None:
        """Report the current job; written with the next beat."""
        with self._lock:
            self._doing = shortened(what, 500)

    def count(self, stage: str, done: int, failed: int, busy_s: float) -> None:
        """Add finished jobs; written with the next beat."""
        with self._lock:
            row = self._counts[stage]
            row[0], row[1], row[2] = row[0] + done, row[1] + failed, row[2] + busy_s

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self._try_to_beat()

    def _try_to_beat(self) -> None:
        try:
            self._beat()
        except (pymysql.err.Error, dj.DataJointError, PblError, OSError):
            self._connection = None  # unavailable: try again at the next beat

    def _beat(self, last: bool = False) -> None:
        if self._connection is None:
            self._connection = connection.another()
        run, now, minutes = self._connection.query, "CURRENT_TIMESTAMP(3)", worker.Throughput.full_table_name
        gpus = None if last or self.resource != worker.SUPERVISOR else gpu_use()
        with self._lock:
            doing, counts = self._doing, {k: tuple(v) for k, v in self._counts.items()}
            self._counts.clear()
        try:
            _write(run, self.worker, os.getpid(), self.resource, doing, last, gpus)
            minute = f"DATE_FORMAT({now}, '%%Y-%%m-%%d %%H:%%i:00')"
            while counts:
                stage, (done, failed, busy) = next(iter(counts.items()))
                run(
                    f"INSERT INTO {minutes} (worker, stage, minute, n_done, n_failed, busy)"  # noqa: S608
                    f" VALUES (%s, %s, {minute}, %s, %s, %s) ON DUPLICATE KEY UPDATE n_done = n_done + VALUES(n_done),"
                    " n_failed = n_failed + VALUES(n_failed), busy = busy + VALUES(busy)",
                    args=(self.worker, stage, int(done), int(failed), float(busy)),
                )
                del counts[stage]
        finally:
            for stage, (done, failed, busy) in counts.items():  # not written yet: with the next beat
                self.count(stage, int(done), int(failed), float(busy))


@contextlib.contextmanager
def cron_pass(name: str, busy: int) -> Iterator[None]:
    """Keep the row of regular work up to date (`worker.CRON`) while it runs, and note how it ended. Nothing is noted
    while the database is unavailable, which shows by the row's age. `busy`: exit status that is neither a success nor a
    failure."""
    over = threading.Event()
    failed: str | None = ""

    def beat() -> None:
        while not over.wait(PERIOD_S):
            _note(name, None)

    threading.Thread(target=beat, name="heartbeat", daemon=True).start()
    try:
        yield
    except BaseException as error:
        status = getattr(error, "exit_code", 1)
        # Without the details, which its log has: they may name a person.
        text = f"exit status {status}" if hasattr(error, "exit_code") else getattr(error, "code", type(error).__name__)
        failed = None if status == busy else str(text) if status else ""
        raise
    finally:
        over.set()
        _note(name, failed)


def _note(name: str, failed: str | None) -> None:
    """Note that regular work lives, and how it ended unless `failed` is None."""
    away = contextlib.suppress(pymysql.err.Error, dj.DataJointError, PblError, OSError)
    with away, contextlib.closing(connection.another()) as server:
        _write(server.query, f"cron {name}", 0, worker.CRON, failed, failed == "")


def _write(
    run: Any, name: str, pid: int, resource: str, doing: str | None, ended: bool, gpus: list[Any] | None = None
) -> None:
    """Insert or update a row of `Worker`, seen now. doing: None leaves it. ended: in order, now."""
    now, new = "CURRENT_TIMESTAMP(3)", "{0}=VALUES({0})".format
    kept = "{0}=COALESCE(VALUES({0}), {0})".format
    columns = "worker, worker_host, worker_pid, worker_resource, worker_version"
    run(
        f"INSERT INTO {worker.Worker.full_table_name} ({columns}, worker_started, worker_seen, worker_stopped,"  # noqa: S608
        f" worker_doing, worker_gpus) VALUES (%s, %s, %s, %s, %s, {now}, {now}, IF(%s, {now}, NULL), %s, %s)"
        f" ON DUPLICATE KEY UPDATE {new('worker_host')}, {new('worker_version')}, {new('worker_seen')},"
        f" {kept('worker_stopped')}, {new('worker_gpus')}, worker_doing=COALESCE(%s, worker_doing)",
        args=(
            *(name, platform.node(), pid, resource, code_version(), ended, doing or ""),
            *(None if gpus is None else json.dumps(gpus), doing),
        ),
    )
