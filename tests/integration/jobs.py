"""Jobs in tests: workers of this process, what they leave in the queues, and workers of other machines."""

import datetime
from pathlib import Path
from typing import Any

import pbl_schemas
from pbl_schemas import video, worker
from pbl_schemas.reading.status import queue_counts
from pbl_schemas.rows import utc_now
from pbl_workers import queue, refresh
from pbl_workers.heartbeat import Silent
from pbl_workers.loop import Worker
from tests.rows import register

from . import chain


def work(*tables: Any, **options: Any) -> Worker:
    """One worker in this process until nothing is left that can be taken now; of all tables where none is named."""
    one = Worker(tables or pbl_schemas.computed_tables(), Silent(), **options)
    one.run(once=True)
    return one


def queued(folder: Path, table: Any, name: str = "walk") -> int:
    """The number of a new video whose job of this table is queued."""
    (number,) = register(chain.small_video(folder, name), session_label=name)
    computed = pbl_schemas.computed_tables()
    if table is not computed[0]:
        work(*computed[: computed.index(table)])
    refresh.refresh()
    return number


def first_job(folder: Path, name: str = "walk") -> queue.Claim:
    """The reserved job of a new video."""
    queued(folder, video.VideoInfo, name)
    (job,) = queue.claim(video.VideoInfo, 1)
    return job


def at_once(job: queue.Claim) -> None:
    """Let a job be taken that was put back for later."""
    video.VideoInfo.jobs.update1({**job.key, "scheduled_time": datetime.datetime(2020, 1, 1)})


def counts() -> dict[str, int]:
    """How many rows the computed tables have."""
    return {t.__name__: len(t()) for t in pbl_schemas.computed_tables()}


def jobs_left() -> dict[str, dict[str, int]]:
    """How many rows the queues have, by table and status."""
    left = {t: {s: n for s, n in c.items() if n} for t, c in queue_counts(video.Video.connection).items()}
    return {t: c for t, c in left.items() if c}


def beat(host: str, seconds_ago: float) -> None:
    """A worker of another machine, named like it, whose heart beat for the last time so long ago."""
    seen = utc_now() - datetime.timedelta(seconds=seconds_ago)
    row = {"worker": host, "worker_host": host, "worker_pid": 1, "worker_resource": "all", "worker_version": "0"}
    worker.Worker.insert1({**row, "worker_started": seen, "worker_seen": seen, "worker_doing": ""})


def hold(video_id: int, host: str, pid: int = 1, seconds_ago: float = 0.0) -> None:
    """Let a process hold the job of a video since then."""
    held = {"video_id": video_id, "status": "reserved", "host": host, "pid": pid}
    video.VideoInfo.jobs.update1({**held, "reserved_time": utc_now() - datetime.timedelta(seconds=seconds_ago)})
