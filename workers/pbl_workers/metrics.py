"""Prometheus metrics of a worker: finished jobs, their duration, and the lengths of the queues."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from .queue import Claim
from .run_job import Outcome

#: Upper ends of the duration classes (s): from a light job to a long video.
SECONDS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)

#: Seconds between two looks at the lengths of the queues, and after which a look counts as too old: the database hangs.
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
        """Start the endpoint in a thread. `connect` returns a database connection for the lengths of the queues."""
        self.registry.register(_Queues(connect))
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


class _Queues(Collector):
    """Job rows by table and status, as a thread last read them: a request never waits for the database."""

    def __init__(self, connect: Callable[[], Any]) -> None:
        self._connect = connect
        self._counts: dict[str, dict[str, int]] = {}
        self._read = -math.inf  # time of the last answer
        threading.Thread(target=self._run, name="queues", daemon=True).start()

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """The counts, while they are not too old, and whether they are."""
        rows = GaugeMetricFamily("pbl_queue_jobs", "Jobs by table and status", labels=["table", "status"])
        up = GaugeMetricFamily("pbl_database_up", "1 when the database answers")
        answers = time.monotonic() - self._read < FRESH_S
        if answers:
            for table, counts in self._counts.items():
                for status, n in counts.items():
                    rows.add_metric([table, status], n)
        up.add_metric([], int(answers))
        yield rows
        yield up

    def _run(self) -> None:
        from pbl_schemas.reading.status import queue_counts

        connection = None
        while True:
            try:
                connection = connection or self._connect()
                self._counts, self._read = queue_counts(connection), time.monotonic()
            except Exception:  # noqa: BLE001  away: it is asked again, for as long as the process lives
                connection, self._read = None, -math.inf
            time.sleep(READ_EVERY_S)
