"""Prometheus metrics of a worker: finished jobs and their duration; and those of the installation."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from pbl_pipeline.resources import gpu_use
from pbl_schemas import worker
from pbl_schemas.operations.archive import disks
from pbl_schemas.reading import status

from .queue import Claim
from .run_job import Outcome

#: Upper ends of the duration classes (s): from a light job to a long video.
SECONDS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)

#: Seconds between two looks at the database, and after which a look counts as too old: the database hangs.
READ_EVERY_S, FRESH_S = 15.0, 45.0


class Metrics:
    """Counters of one supervisor; `serve` puts them at http://HOST:PORT/metrics."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        here = self.registry
        self.jobs = Counter("pbl_jobs", "Jobs ended, by table and outcome", ["table", "outcome", "code"], registry=here)
        self.seconds = Histogram("pbl_job_seconds", "Time of a job", ["table"], buckets=SECONDS, registry=here)
        self.in_hand = Gauge("pbl_jobs_in_hand", "Jobs being computed by this worker", registry=here)
        self.restarts = Counter("pbl_process_restarts", "Working processes that died and were replaced", registry=here)

    def heard(self, job: Claim, outcome: Outcome | None) -> None:
        """Count a job that a working process ended; None when it began."""
        if outcome is not None:
            self.jobs.labels(job.table.__name__, outcome.what, outcome.code).inc()
            self.seconds.labels(job.table.__name__).observe(outcome.seconds)

    def serve(self, port: int, host: str, connect: Callable[[], Any]) -> None:
        """Start the endpoint in a thread. `connect` returns a connection for the installation's figures."""
        self.registry.register(_Installation(connect))
        start_http_server(port, addr=host, registry=self.registry)


class KeptReports(Metrics):
    """Metrics that also keep every report with its time (`time.monotonic`), for benchmarks."""

    def __init__(self) -> None:
        super().__init__()
        self.reports: list[tuple[float, Claim, Outcome | None]] = []

    def heard(self, job: Claim, outcome: Outcome | None) -> None:
        """Keep and count a report."""
        self.reports.append((time.monotonic(), job, outcome))
        super().heard(job, outcome)


class _Installation(Collector):
    """Figures of the installation, as a thread last read them: a request never waits for the database or a disk.

    One worker of all shows the database's, so that they sum up right; each shows disks and GPUs of its machine.
    """

    def __init__(self, connect: Callable[[], Any]) -> None:
        self._connect = connect
        self._figures: list[GaugeMetricFamily] = []
        self._machine: list[GaugeMetricFamily] = []
        self._read = -math.inf  # time of the last answer
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="installation", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and with it its connection."""
        self._closed.set()
        self._thread.join()

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """The figures, while they are not too old, and whether they are."""
        answers = time.monotonic() - self._read < FRESH_S
        yield from (self._figures if answers else ())
        yield from self._machine
        yield GaugeMetricFamily("pbl_database_up", "1 when the database answers", int(answers))

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                with contextlib.closing(self._connect()) as server:
                    self._look(server)
            except Exception:  # noqa: BLE001  away: it is asked again, until it is closed
                self._figures, self._read = [], -math.inf
                self._machine = machine_figures()
            self._closed.wait(READ_EVERY_S)

    def _look(self, server: Any) -> None:
        """Read the figures for as long as this is the worker that shows them, else note that the database answers."""
        # The server then soon ends the connection, and with it the lock, of a machine that is gone.
        server.query(f"SET SESSION wait_timeout = {max(1, int(4 * READ_EVERY_S))}")
        number = server.query("SELECT CONNECTION_ID()").fetchone()[0]
        with worker.installation_lock("metrics", server) as ours:
            # A connection that was made anew has lost the lock.
            while server.query("SELECT CONNECTION_ID()").fetchone()[0] == number:
                self._figures = figures(server) if ours else []
                self._machine, self._read = machine_figures(), time.monotonic()
                if not ours or self._closed.wait(READ_EVERY_S):
                    return
        self._figures = []


def machine_figures() -> list[GaugeMetricFamily]:
    """Free and total bytes of the disks of this machine; use and memory of its NVIDIA GPUs."""
    free = GaugeMetricFamily("pbl_disk_free_bytes", "Free space of a disk", labels=["disk"])
    size = GaugeMetricFamily("pbl_disk_size_bytes", "Size of a disk", labels=["disk"])
    with contextlib.suppress(OSError):
        for name, free_gb, size_gb in disks():
            free.add_metric([name], 1e9 * free_gb)
            size.add_metric([name], 1e9 * size_gb)
    of_gpus = {
        "busy": GaugeMetricFamily("pbl_gpu_busy_ratio", "Fraction of time that a GPU works", labels=["gpu"]),
        "used": GaugeMetricFamily("pbl_gpu_memory_used_bytes", "Memory of a GPU in use", labels=["gpu"]),
        "size": GaugeMetricFamily("pbl_gpu_memory_size_bytes", "Memory of a GPU", labels=["gpu"]),
    }
    for one in gpu_use() or ():
        for name in of_gpus.keys() & one.keys():
            of_gpus[name].add_metric([one["gpu"]], one[name])
    return [free, size, *of_gpus.values()]


def figures(server: Any) -> list[GaugeMetricFamily]:
    """Queues, errors, workers and regular work, read by a connection that no other thread uses."""
    counts = status.queue_counts(server)
    alive, lost = status.worker_counts(server)
    jobs = GaugeMetricFamily("pbl_queue_jobs", "Jobs by table and status", labels=["table", "status"])
    errors = GaugeMetricFamily("pbl_queue_errors", "Jobs in error, since ever", labels=["table", "code"])
    oldest = GaugeMetricFamily("pbl_queue_oldest_seconds", "Age of the oldest pending job", labels=["table"])
    seen = GaugeMetricFamily("pbl_cron_seen_age_seconds", "Since the last sign of life", labels=["cron"])
    good = GaugeMetricFamily("pbl_cron_good_age_seconds", "Since the last success", labels=["cron"])
    ok = GaugeMetricFamily("pbl_cron_ok", "1 if the last pass did not fail", labels=["cron"])
    for table, of_table in counts.items():
        for state, n in of_table.items():
            jobs.add_metric([table, state], n)
    for of_code, n in status.error_counts(server, counts).items():
        errors.add_metric(of_code, n)
    for table, age in status.oldest_jobs(server, counts).items():
        oldest.add_metric([table], age)
    for one in status.cron_passes(server):
        seen.add_metric([one.name], one.seen_s)
        ok.add_metric([one.name], int(not one.failed))
        if one.good_s is not None:
            good.add_metric([one.name], one.good_s)
    return [
        *(jobs, errors, oldest, seen, good, ok),
        GaugeMetricFamily("pbl_workers", "Workers with a heartbeat", alive),
        GaugeMetricFamily("pbl_workers_lost", "Workers whose heartbeat ended in the last hour, not in order", lost),
    ]
