"""The supervisor and its figures: jobs in hand are those of processes that live, whatever these said, however they
ended; and neither waits for a database that does not answer."""

from __future__ import annotations

import multiprocessing
import socket
import threading
import time
import urllib.request
from types import SimpleNamespace

import pymysql
import pytest

from schemas import connection, fit
from schemas.reading import status
from workers import recover
from workers.metrics import Metrics
from workers.process import Options
from workers.queue import Claim
from workers.run_job import DONE, Outcome
from workers.supervisor import Supervisor, _Child


class Process:
    """A working process as its supervisor sees it: a pipe to speak through, and a death."""

    pid, exitcode = 12345, None

    def __init__(self) -> None:
        self.sentinel, self._lives = multiprocessing.Pipe(duplex=False)
        here, self.says = multiprocessing.Pipe(duplex=False)
        self.child = _Child(self, here, 0.0)

    def is_alive(self) -> bool:
        return self.exitcode is None

    def join(self) -> None:
        assert not self.is_alive()

    def die(self, exit_code: int) -> None:
        self.exitcode = exit_code
        self._lives.close()

    def report(self, number: int, seconds: float | None = None) -> None:
        """A fit begins, or (with its duration) ends."""
        job = Claim(fit.SessionFit, {"fit_set": str(number)}, 5, "here", self.pid, 1)
        self.says.send((job, None if seconds is None else Outcome(job, DONE, seconds)))


@pytest.fixture
def boss(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A supervisor of one process whose jobs no database knows, and what was left of each that died."""
    found = Supervisor(Options(), Metrics())
    left: list[int] = []
    monkeypatch.setattr(found, "_settle_jobs", lambda child, *_: left.append(len(child.jobs)))
    monkeypatch.setattr(found, "_launch", lambda _: Process().child)
    monkeypatch.setattr("workers.supervisor.time.sleep", lambda _: None)
    process = Process()
    found._children = [process.child]
    return SimpleNamespace(supervisor=found, process=process, left=left)


def in_hand(boss: SimpleNamespace) -> float:
    boss.supervisor._listen(0.0)
    value = boss.supervisor.metrics.registry.get_sample_value("pbl_jobs_in_hand")
    assert value is not None
    return value


def test_a_job_that_is_announced_twice_is_in_hand_once(boss: SimpleNamespace):
    """Fits of a batch are begun together, and each again when it is inserted."""
    for number in (1, 2):
        boss.process.report(number)
    assert in_hand(boss) == 2
    for number in (1, 2):
        boss.process.report(number)
        boss.process.report(number, seconds=2.0)
    assert in_hand(boss) == 0
    done = {"table": "SessionFit", "outcome": "done", "code": ""}
    assert boss.supervisor.metrics.registry.get_sample_value("pbl_jobs_total", done) == 2


def test_jobs_of_a_process_that_died_are_in_nobodys_hand(boss: SimpleNamespace):
    for number in (1, 2, 3):
        boss.process.report(number)
    boss.process.report(1, seconds=2.0)
    assert in_hand(boss) == 2
    boss.process.die(-9)
    boss.supervisor._reap()
    assert boss.left == [2]
    assert in_hand(boss) == 0
    assert len(boss.supervisor._children) == 1  # another took its place


def test_jobs_of_a_process_that_died_while_the_database_is_away_are_settled_later(
    boss: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
):
    """The supervisor goes on listening, and ends when it is told to."""
    supervisor, crashed, away = boss.supervisor, [], [True, True]

    def connect() -> None:
        if away:
            away.pop()
            raise pymysql.err.OperationalError(2003, "Can't connect")

    monkeypatch.undo()
    monkeypatch.setattr(connection, "connect", connect)
    monkeypatch.setattr(recover, "crashed", lambda job, reason: crashed.append(job.key))
    monkeypatch.setattr("workers.run_job.DATABASE_PAUSE_S", 0.05)
    boss.process.report(1)
    supervisor._listen(0.0)
    supervisor._settle_jobs(boss.process.child, -9)
    assert crashed == []
    until = time.monotonic() + 60.0
    while not crashed and time.monotonic() < until:
        supervisor._settle()
    assert crashed == [{"fit_set": "1"}]
    assert not away


def test_metrics_answer_while_the_database_hangs(monkeypatch: pytest.MonkeyPatch):
    answers = threading.Event()
    answers.set()

    def queue_counts(_: object) -> dict[str, dict[str, int]]:
        assert answers.wait(30)
        return {"SessionFit": {"pending": 7}}

    monkeypatch.setattr(status, "queue_counts", queue_counts)
    monkeypatch.setattr("workers.metrics.READ_EVERY_S", 0.01)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    Metrics().serve(port, "127.0.0.1", object)

    def asked(line: str) -> bool:
        """Whether the answer comes to have this line, each time without waiting for the database."""
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20.0) as answer:
                if line in answer.read().decode().splitlines():
                    return True
            time.sleep(0.02)
        return False

    assert asked("pbl_database_up 1.0")
    assert asked('pbl_queue_jobs{status="pending",table="SessionFit"} 7.0')
    monkeypatch.setattr("workers.metrics.FRESH_S", 0.2)
    answers.clear()
    assert asked("pbl_database_up 0.0")
    answers.set()
    assert asked("pbl_database_up 1.0")
