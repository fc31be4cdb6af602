"""Fits in batches: while the device solves one batch, the one before is inserted and the next is fetched."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from . import queue, run_job
from .queue import Claim
from .run_job import Computed

if TYPE_CHECKING:
    from .loop import Worker


def run_fits(first: list[Claim], worker: Worker) -> None:
    """Do the jobs of `first` and, as long as there are more of that table, the next batches.

    One thread computes and touches no database; this one reserves, fetches and inserts, so that the device always has
    the next batch waiting. A job that the batch could not compute is computed alone.
    """
    table = first[0].table
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="fits") as device:
        batch, result = first, _start(device, first)
        while batch:
            following = [] if worker.stop.is_set() else queue.claim(table, worker.batch)
            ahead = _start(device, following) if following else None
            worker.heartbeat.doing(f"{table.__name__}: batch of {len(batch)}")
            for job in batch:
                worker.say("start", job, None)  # the time limit counts from here
            left = [*batch, *following]
            try:
                ended = []
                for job, made in zip(batch, result.result(), strict=True):
                    left.remove(job)
                    ended.append(worker.one(job, made))
            except (KeyboardInterrupt, SystemExit):  # told to end at once
                for job in left:
                    queue.put_back(job)
                raise
            worker.follow(ended)
            batch = following
            if ahead is not None:
                result = ahead


def _start(device: ThreadPoolExecutor, jobs: list[Claim]) -> Future[list[Computed | None]]:
    """Fetch the inputs here, compute there."""
    fetched = run_job.fetch_batch(jobs)
    return device.submit(run_job.compute_batch, jobs, fetched)


def warm(tables: list[Any]) -> None:
    """Load what the first job would load (imports, compiled programs), before it is reserved."""
    import importlib

    names = {t.__name__ for t in tables}
    if "SessionFit" in names:
        importlib.import_module("pbl_pipeline.fit")
    if names & {"Tracking", "Keypoints"}:
        importlib.import_module("pbl_pipeline.keypoints")
