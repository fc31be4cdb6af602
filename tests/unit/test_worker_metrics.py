"""The supervisor and its figures: jobs in hand are those of processes that live, whatever these said, however they
ended; and neither waits for a database that does not answer."""

import contextlib
import multiprocessing
import os
import signal
import socket
import threading
import time
import urllib.request
from multiprocessing import Pipe, forkserver
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import jax
import pymysql
import pytest
from prometheus_client.core import GaugeMetricFamily

from pbl_pipeline import resources
from pbl_pipeline.models.gpu_address import gpu_number
from pbl_pipeline.resources import VISIBLE_GPUS, given_gpus
from pbl_schemas import connection, fit, worker
from pbl_schemas.store import check_store
from pbl_workers import log, metrics, process, recover, registry, run_job, selftest, supervisor
from pbl_workers.metrics import Metrics
from pbl_workers.process import UNHEARD, Options
from pbl_workers.queue import Claim
from pbl_workers.run_job import DONE, Outcome
from pbl_workers.supervisor import HOPELESS, Supervisor, _Child
from tests import Environment, Limits, Machine, refused, until
from tests.command import program
from tests.ended_process import Ended, run_until

from . import gpu_by_name


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
def boss(monkeypatch: pytest.MonkeyPatch, limits: Limits) -> SimpleNamespace:
    """A supervisor of one process whose jobs no database knows, and what was left of each that died."""
    found = Supervisor(Options(), Metrics())
    left: list[int] = []
    monkeypatch.setattr(found, "_settle_jobs", lambda child, *_: left.append(len(child.jobs)))
    monkeypatch.setattr(found, "_launch", lambda _: Process().child)
    limits(supervisor, RESTART_S=(0.0, 0.0))
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
    boss: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, limits: Limits
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
    limits(run_job, DATABASE_PAUSE_S=0.05)
    boss.process.report(1)
    supervisor._listen(0.0)
    supervisor._settle_jobs(boss.process.child, -9)
    assert crashed == []
    until = time.monotonic() + 60.0
    while not crashed and time.monotonic() < until:
        supervisor._settle()
    assert crashed == [{"fit_set": "1"}]
    assert not away


def test_metrics_answer_while_the_database_hangs(monkeypatch: pytest.MonkeyPatch, limits: Limits):
    answers = threading.Event()
    answers.set()

    def figures(_: object) -> list[GaugeMetricFamily]:
        assert answers.wait(30)
        return [GaugeMetricFamily("pbl_workers", "", 7)]

    monkeypatch.setattr(metrics, "figures", figures)
    monkeypatch.setattr(worker, "installation_lock", lambda *_: contextlib.nullcontext(True))
    limits(metrics, READ_EVERY_S=0.01)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    Metrics().serve(port, "127.0.0.1", mock.MagicMock)

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
    assert asked("pbl_workers 7.0")
    limits(metrics, FRESH_S=0.2)
    answers.clear()
    assert asked("pbl_database_up 0.0")
    answers.set()
    assert asked("pbl_database_up 1.0")


# --- The worker's look at the store before it takes jobs: what it must accept, and what it must not.


class Bucket:
    """A bucket whose key may write and read and not delete, as workers have it (docs/security.md)."""

    protocol = "s3"

    def __init__(self, other: bytes | OSError | None = None) -> None:
        """other: bytes of another writer, which are there after each write, or why there are none."""
        self.objects: dict[str, bytes] = {}
        self.other = other

    def put_buffer(self, content: bytes, path: str) -> None:
        if isinstance(self.other, OSError):
            raise self.other
        self.objects[path] = content if self.other is None else self.other

    def get_buffer(self, path: str) -> bytes:
        return self.objects[path]

    def remove(self, path: str) -> None:
        raise PermissionError(13, "Access Denied", path)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Bucket:
    """The bucket of the worker."""
    found = Bucket()
    monkeypatch.setattr(selftest, "store_backend", lambda: found)
    return found


def test_a_key_that_may_not_delete_is_enough(bucket: Bucket):
    selftest.check([])
    selftest.check([])
    assert len(bucket.objects) == 1  # each start of a worker leaves no further object


def test_workers_that_start_together_may_read_each_others_object(bucket: Bucket):
    check_store(bucket)
    (content,) = bucket.objects.values()
    check_store(Bucket(content))


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"", lambda b: bytes([b[0] ^ 1]) + b[1:]])
def test_other_bytes_than_were_written_fail_the_test(bucket: Bucket, damage):
    check_store(bucket)
    (content,) = bucket.objects.values()
    bucket.other = damage(content)
    with pytest.raises(selftest.SelfTestFailed, match="other bytes"):
        selftest.check([])


def test_a_store_that_cannot_be_written_fails_the_test(bucket: Bucket):
    bucket.other = OSError(28, "No space left on device")
    with pytest.raises(selftest.SelfTestFailed, match="No space left"):
        selftest.check([])


# --- A worker uses every GPU that it was given: one process each, and more processes share them evenly.


#: Variable by which JAX does not reserve a GPU's memory for one process.
MEMORY = "XLA_PYTHON_CLIENT_PREALLOCATE"
#: Variables by which JAX and ONNX networks compute on the CPU.
CPU = ("JAX_PLATFORMS", "PBL_ONNX_DEVICE")


@pytest.mark.parametrize(
    ("listed", "expected"),
    [
        ("2,5", ("2", "5")),
        ("2,-1,5", ("2",)),
        ("GPU-8f3a, MIG-77", ("GPU-8f3a", "MIG-77")),
        ("", ()),
        ("-1", ()),
        ("NoDevFiles", ()),
    ],
)
def test_a_batch_system_says_which_gpus_are_ours(listed: str, expected: tuple, environment: Environment):
    environment(**{VISIBLE_GPUS: listed})
    assert given_gpus() == expected


def test_one_gpu_needs_no_turn_nor_what_windows_lacks(environment: Environment, machine: Machine):
    machine(without=["fcntl"])
    environment(**{VISIBLE_GPUS: "GPU-of-windows"})
    assert gpu_number() == 0


@pytest.mark.parametrize(
    ("answer", "expected"),
    [('echo "0, [N/A]"\necho 1', ("0", "1")), ("exit 9", ()), ("exec /bin/sleep 60", ()), (None, ())],
)
def test_otherwise_the_driver_lists_them(
    answer: str | None, expected: tuple, tmp_path: Path, environment, limits: Limits
):
    environment(**{VISIBLE_GPUS: None}, PATH=tmp_path)
    limits(resources, QUERY_S=0.5)
    if answer is not None:
        program(tmp_path, "nvidia-smi", answer)
    assert given_gpus() == expected
    assert resources.gpu_use() == ([{"gpu": g} for g in expected] if expected else [] if answer is None else None)


def test_use_and_memory_of_gpus_are_among_the_figures(tmp_path: Path, environment: Environment):
    def found() -> dict[tuple[str, str], float]:
        samples = [s for figure in metrics.machine_figures() for s in figure.samples if s.name.startswith("pbl_gpu")]
        return {(s.name, s.labels["gpu"]): s.value for s in samples}

    environment(PATH=tmp_path)
    assert found() == {}
    program(tmp_path, "nvidia-smi", 'echo "0, 37, 1024, 2048"\necho "1, [N/A], 0, 2048"')
    assert found() == {
        ("pbl_gpu_busy_ratio", "0"): 0.37,
        ("pbl_gpu_memory_used_bytes", "0"): 2.0**30,
        ("pbl_gpu_memory_used_bytes", "1"): 0.0,
        ("pbl_gpu_memory_size_bytes", "0"): 2.0**31,
        ("pbl_gpu_memory_size_bytes", "1"): 2.0**31,
    }


def test_processes_are_dealt_to_the_gpus_evenly():
    options = Options(processes=5, gpus=("a", "b"))
    assert [options.of_process(i).gpus for i in range(5)] == [("a",), ("b",), ("a",), ("b",), ("a",)]
    assert [options.of_process(i).processes for i in range(5)] == [3, 2, 3, 2, 3]  # that share a device
    alone = Options(processes=2, gpus=("a", "b")).of_process(1)
    assert (alone.gpus, alone.processes) == (("b",), 1)
    assert Options(processes=2).of_process(0) == Options(processes=2)
    assert [options.of_process(i).short for i in range(5)] == [*[False] * 4, True]
    lone = Options(gpus=("a", "b"), phones=True)
    here, beside = lone.of_process(0), lone.of_process(2)
    assert (here.short, beside.long, beside.once, beside.resource) == (True, True, True, "all")
    assert (here.gpus, beside.gpus, here.processes, beside.processes) == (("a",), ("a",), 2, 2)
    phone = Options(processes=2, gpus=("a", "b"), batch=128, max_jobs=9, phones=True).of_process(2)
    assert phone == Options(phones=True, phone=True)  # no GPU, all cores, one session at a time, for as long as others


def test_processes_that_fit_on_one_gpu_know_it():
    def share(resource: str, processes: int, *gpus: str) -> list[bool]:
        options = Options(resource, processes, gpus=gpus)
        return [options.of_process(i).shares_gpu for i in range(processes)]

    assert share("gpu", 3, "a", "b") == [True, False, True]
    assert share(registry.FIT, 2, "a") == [True, True]
    assert share("all", 2, "a") == [False, False]  # the other one detects
    assert share("gpu", 2) == [False, False]


def test_a_process_sees_its_own_gpu_only(monkeypatch: pytest.MonkeyPatch, environment: Environment):
    """What JAX finds in the environment of the two processes of two GPUs, of the fourth of four, and of the one for
    phones."""
    for name in ("_connected", "to_stderr", "signal.signal"):
        monkeypatch.setattr(f"pbl_workers.process.{name}", lambda *_: False)  # it ends where it would connect
    on_cpu = mock.Mock()
    monkeypatch.setattr("jax.config.update", on_cpu)  # JAX may be loaded before it has the variable
    seen = []
    for number, processes in ((0, 2), (1, 2), (3, 4), (4, 4)):
        for value in ("", None):  # put back what the process sets
            environment(**dict.fromkeys((VISIBLE_GPUS, MEMORY, *CPU), value))
        process.work(Options(processes=processes, gpus=("4", "7"), phones=True).of_process(number), mock.Mock())
        seen.append(tuple(map(os.environ.get, (VISIBLE_GPUS, MEMORY, *CPU))))
        assert on_cpu.call_count == (number == processes)
    no = (None, None)
    assert seen == [("4", None, *no), ("7", None, *no), ("7", "false", *no), (*no, "cpu", "cpu")]


def test_where_the_device_fails_the_process_ends_and_the_job_is_left_to_another(monkeypatch: pytest.MonkeyPatch):
    """A process whose GPU is gone would make an error row of each further fit."""
    lost = jax.errors.JaxRuntimeError("INTERNAL: CUDA error:\n device lost")
    counted = []

    def make(_: object) -> str:
        raise RuntimeError("the fit failed") from lost

    monkeypatch.setattr(run_job._Attempt, "make", make)
    monkeypatch.setattr(recover, "crashed", lambda *given: counted.append(given))
    job = Claim(fit.SessionFit, {"fit_set": "a"}, 5, "here", 1, 1)
    error = refused("DEVICE_UNAVAILABLE", run_job.run, job)
    assert error.found == "INTERNAL: CUDA error: device lost"
    assert counted == [(job, error.found)]
    other = jax.errors.JaxRuntimeError("INVALID_ARGUMENT: shapes differ")
    assert not run_job.device_failure(other)  # the next device would meet it too: an error row


def test_a_process_that_died_is_replaced_by_one_with_the_same_gpu(monkeypatch: pytest.MonkeyPatch, limits: Limits):
    started: list[Options] = []

    class Process(Ended):
        """The second one died."""

        def start(self) -> None:
            self.exitcode = 1 if len(started) == 1 else 0
            started.append(self.options)

    boss = Supervisor(Options(processes=2, gpus=("4", "7"), once=True))
    monkeypatch.setattr(boss, "_start", SimpleNamespace(Process=Process, Pipe=Pipe))
    limits(supervisor, RESTART_S=(0.0, 0.0))
    assert boss.run() == 0
    assert [options.gpus for options in started] == [("4",), ("7",), ("7",)]


def starts(folder: Path, gpu: str) -> int:
    return len((folder / gpu).read_text(encoding="utf-8").splitlines())


def of_gpus(folder: Path, *gpus: str, **options: Any) -> Supervisor:
    """A worker with a process for each GPU, which it ends as `gpu_by_name` says."""
    given = Options("gpu", len(gpus), gpus=gpus, selftest=False, profile=str(folder), **options)
    boss = Supervisor(given, target=gpu_by_name.work)
    boss.loaded = gpu_by_name.__name__
    return boss


def test_one_full_gpu_stops_no_other_process(tmp_path: Path, limits: Limits):
    limits(supervisor, RESTART_S=(0.05, 0.2))
    boss = of_gpus(tmp_path, "free", "full", "also free")
    told: list[str] = []

    def look() -> None:
        until(lambda: (tmp_path / "full").exists() and starts(tmp_path, "full") > HOPELESS, 60)
        told.append(str(boss._places[1]))

    assert run_until(boss, look) == 0
    assert starts(tmp_path, "free") == starts(tmp_path, "also free") == 1
    (text,) = told
    assert text.startswith("process 2 (GPU full) starts again 0.2 s after it died: its GPU does not compute")


def lives(pid: int) -> bool:
    """True unless it has ended; who inherits it may ask for its exit code later."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    return False


def test_where_the_process_with_the_libraries_is_killed_all_begin_anew(tmp_path: Path, limits: Limits):
    """They die with it: the supervisor would not hear how they end."""
    limits(supervisor, RESTART_S=(0.05, 0.2))
    gpus = ("first", "second")

    def look() -> None:
        until(lambda: all((tmp_path / gpu).exists() for gpu in gpus), 60)
        before = [int((tmp_path / gpu).read_text(encoding="utf-8")) for gpu in gpus]
        os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)  # pyright: ignore
        until(lambda: all(starts(tmp_path, gpu) == 2 for gpu in gpus), 60)
        until(lambda: not any(lives(pid) for pid in before), 10)

    assert run_until(of_gpus(tmp_path, *gpus), look) == 0


def test_a_process_that_is_told_to_end_as_it_begins_does(tmp_path: Path):
    """It may be started a moment before the worker is stopped."""
    boss = of_gpus(tmp_path, "first")
    with supervisor._copies_of("pbl_workers.loaded"):
        started = boss._launch(0).process
        os.kill(started.pid, signal.SIGTERM)
        started.join(20)
        started.kill()
        started.join()
    assert started.exitcode == -signal.SIGTERM


def test_signals_to_all_processes_do_not_end_the_one_with_the_libraries(tmp_path: Path, limits: Limits):
    """As of a terminal and of systemd: a job that runs may end."""
    limits(supervisor, RESTART_S=(0.05, 0.2))
    boss = of_gpus(tmp_path, "first")
    boss.loaded = "pbl_workers.loaded"

    def look() -> None:
        until((tmp_path / "first").exists, 60)
        with_libraries = forkserver._forkserver._forkserver_pid  # pyright: ignore
        for sent in (signal.SIGINT, signal.SIGTERM):
            os.kill(with_libraries, sent)
        os.kill(int((tmp_path / "first").read_text(encoding="utf-8")), signal.SIGKILL)
        until(lambda: starts(tmp_path, "first") == 2, 60)
        assert forkserver._forkserver._forkserver_pid == with_libraries  # pyright: ignore

    assert run_until(boss, look) == 0


def test_the_current_folder_is_not_imported_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It may hold another checkout."""
    other = tmp_path / "pbl_workers"
    other.mkdir()
    (other / "__init__.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert of_gpus(tmp_path, "idle", once=True).run() == 0
    assert (starts(tmp_path, "idle"), (tmp_path / "imported").exists()) == (1, False)


@pytest.mark.parametrize("phones", [False, True])
def test_a_worker_ends_where_no_process_can_run(
    tmp_path: Path, limits: Limits, caplog: pytest.LogCaptureFixture, phones: bool
):
    """Also beside the process for phones, which needs no GPU."""
    limits(supervisor, RESTART_S=(0.02, 0.05))
    assert of_gpus(tmp_path, "full", "wrong", phones=phones).run() == process.SELFTEST_FAILED
    assert (starts(tmp_path, "full") >= HOPELESS, starts(tmp_path, "wrong")) == (True, 1)
    (end,) = [record for record in caplog.records if record.message == "giving up"]
    assert "process 2 (GPU wrong) is not started again: its self-test failed" in log.JsonLines().format(end)


def test_jobs_of_a_process_whose_end_nobody_heard_count_no_crash(monkeypatch: pytest.MonkeyPatch):
    """The one that it was forked from died, for which no job is to blame."""
    boss, process, back = Supervisor(Options(), Metrics()), Process(), []
    monkeypatch.setattr(connection, "connect", lambda: None)
    monkeypatch.setattr("pbl_workers.queue.put_back", lambda job, reason: back.append((job.key, reason)))
    boss._children = [process.child]
    process.report(1)
    boss._listen(0.0)
    boss._settle_jobs(process.child, UNHEARD)
    assert back == [({"fit_set": "1"}, "the process that it was forked from has ended")]


def test_a_full_gpu_does_not_keep_a_worker_whose_other_processes_have_ended(tmp_path: Path, limits: Limits):
    limits(supervisor, RESTART_S=(0.02, 0.05))
    assert of_gpus(tmp_path, "full", "idle", once=True).run() == 1
    assert starts(tmp_path, "idle") == 1


def test_pauses_of_a_place_grow_until_a_process_was_healthy(limits: Limits):
    limits(supervisor, RESTART_S=(1.0, 3.0))
    place, pauses = supervisor._Place("process 1"), []
    for lived_s, over_job in ((1.0, False), (1.0, True), (1.0, False), (100.0, False), (1.0, False)):
        place.rest("exit code 1", lived_s, over_job)
        pauses.append((place.pause_s, place.deaths))
    assert pauses == [(1.0, 1), (2.0, 0), (3.0, 1), (1.0, 0), (2.0, 1)]


def test_a_process_that_lives_longer_than_those_before_it_is_no_hopeless_one():
    place = supervisor._Place("process 1")
    for _ in range(HOPELESS):
        place.lives(4.0)
        place.rest("its GPU does not compute", 5.0, over_job=False)
    place.lives(9.0)
    assert place.deaths == HOPELESS
    place.lives(11.0)
    assert place.deaths == 0
