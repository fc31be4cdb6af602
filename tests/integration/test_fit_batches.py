"""Batches of fits on two threads: each session once, two batches at a time, and what becomes of them at the end."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pymysql
import pytest

from pbl_schemas import fit
from pbl_schemas.jobs import jobs_of
from pbl_workers import loop, queue
from pbl_workers.heartbeat import Silent
from pbl_workers.loop import Worker
from research.benchmarks import gpu_worker
from tests import StandIn

from . import chain

#: Sessions, in batches of two.
N = 7


@pytest.fixture
def sessions(
    tables: None, database: Path, monkeypatch: pytest.MonkeyPatch, stand_in: StandIn
) -> Callable[[Callable], Worker]:
    """Sessions that wait for their fit, and a worker on two threads, given what stands for `fit_sessions`."""
    gpu_worker.put_sessions(database, gpu_worker.plans(N, [5.0], alike=True))
    assert gpu_worker.queue_fits(0) == N
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")

    def worker(solve: Callable[..., None]) -> Worker:
        def fit_sessions(given, paramset, **options):
            solve(len(given), **options)
            return [chain.fit_session(s.trials, s.names, paramset, s.camera_motion) for s in given]

        stand_in(fit_sessions=fit_sessions)
        return Worker([fit.SessionFit], Silent(), batch=2)

    return worker


def jobs() -> dict[str, int]:
    return {s: n for s, n in jobs_of(fit.SessionFit).progress().items() if n and s != "total"}


def test_two_batches_are_computed_at_a_time_and_each_session_once(sessions):
    together, sizes = threading.Barrier(2, timeout=120), []

    def solve(n: int, threads: int | None) -> None:
        sizes.append(n if threads is None else -1)
        together.wait()  # breaks, and with it the batch, where no other one is being computed

    worker = sessions(solve)
    loop.run_fits(queue.claim(fit.SessionFit, 2), worker)
    assert sorted(sizes) == [1, 2, 2, 2]
    assert not together.broken
    assert (worker.done, worker.failed) == (N, 0)
    assert len(fit.SessionFit()) == N
    assert set((fit.SessionFit.Trial & "trial_n_fitted > 0").to_arrays("video_id")) == set(
        fit.TrialInput.to_arrays("video_id")
    )
    assert jobs() == {}


def test_one_that_shares_its_gpu_computes_one_batch_at_a_time(sessions):
    busy, seen = threading.Lock(), []

    def solve(n: int, threads: int | None) -> None:
        alone = busy.acquire(blocking=False)
        time.sleep(0.05)  # the main thread has the next batch ready
        seen.append((n, threads, alone))
        busy.release()

    worker = sessions(solve)
    worker.shares_gpu = True
    loop.run_fits(queue.claim(fit.SessionFit, 2), worker)
    assert seen == [(2, 1, True), (2, 1, True), (2, 1, True), (1, 1, True)]
    assert (worker.done, worker.failed) == (N, 0)


def test_told_to_stop_it_ends_what_it_has_and_takes_no_more(sessions):
    computed = []
    worker = sessions(lambda n, **_: computed.append(n))

    def stop(job, outcome) -> None:
        if outcome is not None:
            worker.stop.set()

    worker.report = stop
    loop.run_fits(queue.claim(fit.SessionFit, 2), worker)
    # The batch that was written when it was told, and one for each thread.
    assert worker.done == len(fit.SessionFit()) == sum(computed) == 6
    assert jobs() == {"pending": N - 6}


def test_told_to_end_at_once_it_puts_all_back(sessions):
    worker = sessions(lambda n, **_: None)

    def end(*_: object) -> None:
        raise SystemExit(0)

    worker.one = end
    with pytest.raises(SystemExit):
        loop.run_fits(queue.claim(fit.SessionFit, 2), worker)
    # `one` itself puts back the job it has in hand; here it is a stand-in.
    assert jobs() == {"pending": N - 1, "reserved": 1}
    assert len(fit.SessionFit()) == 0


def test_a_database_that_is_away_between_two_batches_leaves_no_job_behind(sessions, faults):
    worker = sessions(lambda n, **_: None)
    faults(queue, "claim", None, None, pymysql.err.OperationalError(2006, "Server has gone away"))
    worker.run(once=True)
    assert (worker.done, len(fit.SessionFit())) == (N, N)
    assert jobs() == {}
