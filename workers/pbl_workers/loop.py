"""The working process: take jobs, compute, insert, queue their followers; wait if there is nothing to do."""

from __future__ import annotations

import dataclasses
import logging
import math
import random
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from pbl_pipeline.video import release_frames
from pbl_schemas import tables_version
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading.visit_progress import Scope
from pbl_schemas.rows import exist

from . import queue, refresh, registry, run_job
from .heartbeat import Silent
from .log import event
from .queue import Claim
from .run_job import Computed, Outcome


def run_fits(first: list[Claim], worker: Worker, where: str | None = None) -> None:
    """Do the jobs of `first` and, as long as there are more of that table, the next batches. `where`:
    as for `queue.claim`.

    Threads compute and touch no database; this one reserves, fetches and inserts, so that the device always has the
    next batch waiting. A job that the batch could not compute is computed alone.
    """
    table, n, threads = first[0].table, _at_once(worker), 1 if worker.shares_gpu else None
    with ThreadPoolExecutor(max_workers=n, thread_name_prefix="fits") as device:
        waiting = deque([(first, _start(device, first, threads))])
        while waiting:
            while len(waiting) <= n and not worker.stop.is_set() and (more := queue.claim(table, worker.batch, where)):
                waiting.append((more, _start(device, more, threads)))
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
            except BaseException:  # told to end immediately, or the database does not answer
                device.shutdown(wait=False, cancel_futures=True)
                for job in left:
                    worker.report(job, Outcome(job, run_job.LATER))
                for job in (*left, *(job for jobs, _ in waiting for job in jobs)):
                    queue.put_back(job)
                raise
            worker.follow(ended)


def _at_once(worker: Worker) -> int:
    """Return how many batches are computed at a time: two on a GPU, so that one is packed and unpacked on the host
    while the other is solved; a CPU does both itself, and processes that share a GPU fill it together."""
    import jax

    return 1 if worker.shares_gpu or jax.default_backend() == "cpu" else 2


def _start(device: ThreadPoolExecutor, jobs: list[Claim], threads: int | None) -> Future[list[Computed | None]]:
    """Fetch the inputs here, compute there."""
    fetched = run_job.fetch_batch(jobs)
    return device.submit(run_job.compute_batch, jobs, fetched, threads)


log = logging.getLogger("pbl.worker")

#: Pause after the first look that found nothing, and the longest; each look that finds nothing doubles it.
IDLE_S = (0.5, 20.0)
#: Time without a look at all tables by any worker after which an idle one looks (s).
REFRESH_EVERY_S = 60.0
#: Longest pause of the process for phones between two looks, and of one that ends when nothing is left.
PHONE_S = 1.0
#: Time for which the other processes leave a job of a phone's recording to that process (s): longer than its pause.
LEAVE_S = 3
#: Interval at which a lone process looks for long recordings, which it leaves to another one (s).
LONG_EVERY_S = 10.0
#: Conditions on a job: of a long recording, or not; of a phone's; of none, or one that had waited for `LEAVE_S`.
_IS_LONG = f"priority IN ({','.join(map(str, registry.LONG.values()))})"
_IS_SHORT = f"NOT {_IS_LONG}"
_IS_FIRST = f"priority = {registry.FIRST}"
_IS_LEFT = f"(priority != {registry.FIRST} OR scheduled_time < CURRENT_TIMESTAMP(3) - INTERVAL {LEAVE_S} SECOND)"


def takes(short: bool, phones: bool, phone: bool, long: bool = False) -> str | None:
    """Return the condition on the jobs that a process takes (`process.Options`); None for all."""
    if phone or long:
        return _IS_FIRST if phone else _IS_LONG
    return " AND ".join(([_IS_SHORT] if short else []) + ([_IS_LEFT] if phones else [])) or None


@dataclasses.dataclass
class Worker:
    """One working process.

    tables: the computed tables it serves. stop: set when it is to end after the running job. report: called with each
    job before it and while it waits for the database (without an outcome), and after it. batch: fits per batch.
    limit: most jobs of each table. found: what its looks at the tables, and its jobs, made computable. only: takes no
    job but of these recordings; called before each look, as sets come and go. takes: condition on its jobs (`takes`).
    phone: looks often, and for nothing but jobs that are queued. long_waits: called where no job is more urgent than
    that of a long recording, which another process takes. siblings: other processes of this machine also work;
    shares_gpu: and fit on the same GPU.
    """

    tables: Sequence[Any]
    heartbeat: Silent
    stop: threading.Event = dataclasses.field(default_factory=threading.Event)
    report: Callable[[Claim, Outcome | None], None] = lambda *_: None
    batch: int = 1
    limit: int | None = None
    only: Callable[[], Scope] | None = None
    takes: str | None = None
    phone: bool = False
    long_waits: Callable[[], None] | None = None
    siblings: bool = False
    shares_gpu: bool = False
    done: int = 0
    failed: int = 0
    found: refresh.Refreshed = dataclasses.field(default_factory=refresh.Refreshed)
    _taken: Counter[str] = dataclasses.field(default_factory=Counter)
    _refreshed: float = -1e9
    _checked: float = -1e9
    _everything: bool | None = None
    _in_hand: int | None = None  # video_id of the recording that was read last
    _looked_for_long: float = -1e9

    def run(self, once: bool = False, max_jobs: int | None = None) -> None:
        """Work until `stop`; with `once` until nothing is left to do anywhere, nor in hand on this machine."""
        self._everything = True if once else None
        idle, troubled, quiet = IDLE_S[0], 0, 0
        while not self.stop.is_set() and (max_jobs is None or self.done + self.failed < max_jobs):
            try:
                n = self.step()
                if time.monotonic() - self._checked > REFRESH_EVERY_S:
                    tables_version.refuse_newer()  # after a migration it ends, and its successor does not start
                    self._checked = time.monotonic()
                found = bool(n) or self._refresh()
            except run_job.DATABASE_ERRORS as error:
                troubled += 1
                if troubled * run_job.DATABASE_PAUSE_S > run_job.DATABASE_WAIT_S:
                    raise
                self.heartbeat.doing(f"waits for the database: {error}")
                event(log, logging.WARNING, "database away", error=str(error)[:200])
                run_job.wait_for_database(self.stop, pause=not run_job.is_gone(error))
                queue.release_all()  # what was reserved for later; a job in hand has waited for the database itself
                self._refreshed = -1e9
                continue
            troubled = 0
            if n:
                idle, quiet = IDLE_S[0], 0
                continue
            if found:
                continue
            if once and found is not None:
                # A job of another process of this machine may make more computable, and has not yet when it ends.
                quiet = 0 if self.siblings and queue.anything_reserved_here() else quiet + 1
                if quiet > self.siblings:
                    return
            self._forget_recording()
            self.heartbeat.doing("waits for a recording of a phone" if self.phone else "idle")
            # Not all at the same moment: workers that were started together would go on asking together.
            self.stop.wait(idle * random.uniform(0.7, 1.3))  # noqa: S311
            idle = min(2 * idle, PHONE_S if self.phone or once else IDLE_S[1])

    def step(self) -> int:
        """Take jobs of the table that is most urgent, and do them; returns how many."""
        conditions, position = self._conditions(), {table: i for i, table in enumerate(self.tables)}
        ranked = [(urgent, -position[table], table) for table, urgent in queue.most_urgent(conditions).items()]
        if self.long_waits is not None and time.monotonic() - self._looked_for_long > LONG_EVERY_S:
            self._looked_for_long = time.monotonic()
            longs = queue.most_urgent(dict.fromkeys(self.tables, _IS_LONG)).values()
            if longs and min(longs) < min((p for p, *_ in ranked), default=math.inf):
                self.long_waits()
        # What is near its end first: a session that is nearly done should not wait for all others to begin.
        ranked.sort(key=lambda r: r[:2])
        anyones = [(table, conditions[table]) for _, _, table in ranked]
        for table, where in [*self._of_recording_in_hand(ranked, conditions), *anyones]:
            stage = registry.stage_of(table)
            n = self.batch if stage.resource == registry.FIT else stage.batch
            if self.limit is not None:
                n = min(n, self.limit - self._taken[table.__name__])
            jobs = queue.claim(table, n, where) if n > 0 else []
            if jobs:
                self._taken[table.__name__] += len(jobs)
                self._do(jobs, conditions[table])
                return len(jobs)
        return 0

    def _of_recording_in_hand(
        self, ranked: Sequence[tuple[int, int, Any]], conditions: dict[Any, str | None]
    ) -> list[tuple[Any, str]]:
        """Return the tables that have a job as urgent as any, with the condition on those of the recording whose
        pictures are in memory: another process would decode it again."""
        if self._in_hand is None or not ranked:
            return []
        most, mine = ranked[0][0], f"priority={ranked[0][0]} AND video_id={self._in_hand}"
        tables = [t for urgent, _, t in ranked if urgent == most and "video_id" in jobs_of(t).primary_key]
        return [(t, f"{mine} AND {conditions[t]}" if conditions[t] else mine) for t in tables]

    def _conditions(self) -> dict[Any, str | None]:
        """Return the tables whose jobs may be taken, with the condition on their keys."""
        if self.only is None:
            return dict.fromkeys(self.tables, self.takes)
        scope = self.only()
        return {table: where for table in self.tables if (where := scope.where(table)) is not None}

    def _do(self, jobs: list[Claim], where: str | None) -> None:
        if registry.stage_of(jobs[0].table).resource == registry.FIT and self.batch > 1:
            run_fits(jobs, self, where)
            return
        ended, left = [], list(jobs)
        try:
            while left and not self.stop.is_set():
                ended.append(self.one(left.pop(0)))
        finally:  # also where we are told to end immediately
            for job in left:
                queue.put_back(job)
        self.follow(ended)

    def one(self, job: Claim, computed: run_job.Computed | None = None) -> Outcome:
        """Do one job, with all its reports."""
        self.heartbeat.doing(str(job))
        self.report(job, None)
        try:
            outcome = run_job.run(job, computed, self.stop, lambda: self.report(job, None))
        except BaseException:  # it was put back, or the database would not take how it ended
            self.report(job, Outcome(job, run_job.LATER))
            raise
        self.report(job, outcome)
        good = outcome.what in (run_job.DONE, run_job.ALREADY)
        if job.table.__name__ == "VideoInfo":
            self._in_hand = int(job.key["video_id"])
        elif job.table.__name__ == "Keypoints":
            self._forget_recording(memory=False)
        self.done += good
        self.failed += outcome.what == run_job.FAILED
        self.heartbeat.count(job.table.__name__, int(good), int(outcome.what == run_job.FAILED), outcome.seconds)
        level = logging.INFO if good else logging.WARNING
        event(
            log, level, outcome.what, job=job, seconds=round(outcome.seconds, 3), code=outcome.code, text=outcome.text
        )
        if outcome.what == run_job.LATER:
            self.stop.wait(1.0)  # the cause is outside of the job: the next one would meet it too
        return outcome

    def _forget_recording(self, memory: bool = True) -> None:
        self._in_hand = None
        release_frames(memory)

    def follow(self, outcomes: Sequence[Outcome]) -> None:
        """Queue what the jobs made computable."""
        good = [o.job for o in outcomes if o.what in (run_job.DONE, run_job.ALREADY)]
        self.found.add(refresh.after(good, [o.job for o in outcomes if o.what == run_job.FAILED]))

    def _refresh(self) -> bool | None:
        """Look at all tables if it is time. Return whether something was found; None while another worker is looking,
        or working on our recordings."""
        if self.only is not None:
            scope = self.only()
            # Asked first: what a job makes computable that ends after this is found in the next round.
            held = exist(*(jobs_of(t).reserved & w for t in self.tables if (w := scope.where(t)) is not None))
            found = refresh.refresh_scope(self.only())
            self.found.add(found)
            if found.queued or found.freed:
                return True
            # Another worker may have queued a job since our last step and not taken it yet.
            ours = {} if self.limit is not None else self._conditions()
            return None if any(held) or queue.most_urgent(ours) else False
        if self.phone or (time.monotonic() - self._refreshed < REFRESH_EVERY_S and self._refreshed > 0):
            return False
        self.heartbeat.doing("looks at all tables")
        found = refresh.refresh(self._everything)
        if found is None:
            return None
        self._refreshed = time.monotonic()
        self.found.add(found)
        if found.queued or found.freed:
            event(log, logging.INFO, "refreshed", queued=found.queued, freed=found.freed, planned=found.planned)
        mine = {t.__name__ for t in self.tables}
        return any(name in mine for name in found.queued) or bool(found.freed)
