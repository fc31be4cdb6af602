"""Fits in batches: while the device solves one, the one before is inserted and the next is prepared."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

from . import queue, run_job
from .queue import Claim
from .run_job import Computed, Outcome


class Runs(Protocol):
    """The part of a worker (`loop.Worker`) that batches use."""

    stop: threading.Event
    heartbeat: Any
    batch: int

    report: Callable[[Claim, Outcome | None], None]

    def one(self, job: Claim, computed: Computed | None = None) -> Outcome: ...
    def follow(self, outcomes: Sequence[Outcome]) -> None: ...


def run_fits(first: list[Claim], worker: Runs, where: str | None = None) -> None:
    """Do the jobs of `first` and, as long as there are more of that table, the next batches. `where`:
    as for `queue.claim`.

    Threads compute and touch no database; this one reserves, fetches and inserts, so that the device always has the
    next batch waiting. A job that the batch could not compute is computed alone.
    """
    table, n = first[0].table, _threads()
    with ThreadPoolExecutor(max_workers=n, thread_name_prefix="fits") as device:
        waiting = deque([(first, _start(device, first))])
        while waiting:
            while len(waiting) <= n and not worker.stop.is_set() and (more := queue.claim(table, worker.batch, where)):
                waiting.append((more, _start(device, more)))
            batch, result = waiting.popleft()
            worker.heartbeat.doing(f"{table.__name__}: batch of {len(batch)}")
            for job in batch:
                worker.report(job, None)  # the time limit counts from here
            left = list(batch)
            try:
                ended = []
                for job, made in zip(batch, result.result(), strict=True):
                    left.remove(job)
                    ended.append(worker.one(job, made))
            except BaseException:  # told to end at once, or the database does not answer
                device.shutdown(wait=False, cancel_futures=True)
                for job in left:
                    worker.report(job, Outcome(job, run_job.LATER))
                for job in (*left, *(job for jobs, _ in waiting for job in jobs)):
                    queue.put_back(job)
                raise
            worker.follow(ended)


def _threads() -> int:
    """How many batches are computed at a time: on a GPU two, so that one is packed and unpacked on the host while the
    other is solved; a CPU does both itself."""
    import jax

    return 1 if jax.default_backend() == "cpu" else 2


def _start(device: ThreadPoolExecutor, jobs: list[Claim]) -> Future[list[Computed | None]]:
    """Fetch the inputs here, compute there."""
    fetched = run_job.fetch_batch(jobs)
    return device.submit(run_job.compute_batch, jobs, fetched)
