"""A worker uses every GPU that it was given: one process each, and more processes share them evenly."""

from __future__ import annotations

import os
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest

from tests.command import program
from tests.ended_process import Ended
from workers import process
from workers.process import VISIBLE, Options, given_gpus
from workers.supervisor import Supervisor

#: Variable by which JAX does not reserve a GPU's memory for one process.
MEMORY = "XLA_PYTHON_CLIENT_PREALLOCATE"
#: Variables by which JAX and ONNX networks compute on the CPU.
CPU = ("JAX_PLATFORMS", "PBL_ONNX_DEVICE")


@pytest.mark.parametrize(
    ("listed", "expected"),
    [("2,5", ("2", "5")), ("GPU-8f3a, MIG-77", ("GPU-8f3a", "MIG-77")), ("", ()), ("-1", ()), ("NoDevFiles", ())],
)
def test_a_batch_system_says_which_gpus_are_ours(listed: str, expected: tuple, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VISIBLE, listed)
    assert given_gpus() == expected


@pytest.mark.parametrize(
    ("answer", "expected"), [("echo 0\necho 1", ("0", "1")), ("exit 9", ()), ("exec /bin/sleep 60", ()), (None, ())]
)
def test_otherwise_the_driver_lists_them(answer: str | None, expected: tuple, tmp_path: Path, monkeypatch):
    monkeypatch.delenv(VISIBLE, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(process, "QUERY_S", 0.5)
    if answer is not None:
        program(tmp_path, "nvidia-smi", answer)
    assert given_gpus() == expected


def test_processes_are_dealt_to_the_gpus_evenly():
    options = Options(processes=5, gpus=("a", "b"))
    assert [options.of_process(i).gpus for i in range(5)] == [("a",), ("b",), ("a",), ("b",), ("a",)]
    assert {options.of_process(i).processes for i in range(5)} == {3}  # that share a device, at most
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


def test_a_process_sees_its_own_gpu_only(monkeypatch: pytest.MonkeyPatch):
    """What JAX finds in the environment of the two processes of two GPUs, of the fourth of four, and of the one for
    phones."""
    for name in ("_connected", "to_stderr", "signal.signal"):
        monkeypatch.setattr(f"workers.process.{name}", lambda *_: False)  # it ends where it would connect
    seen = []
    for number, processes in ((0, 2), (1, 2), (3, 4), (4, 4)):
        for name in (VISIBLE, MEMORY, *CPU):
            monkeypatch.setenv(name, "")
            monkeypatch.delenv(name)
        process.work(Options(processes=processes, gpus=("4", "7"), phones=True).of_process(number), mock.Mock())
        seen.append(tuple(map(os.environ.get, (VISIBLE, MEMORY, *CPU))))
    no = (None, None)
    assert seen == [("4", None, *no), ("7", None, *no), ("7", "false", *no), (*no, "cpu", "cpu")]


def test_a_process_that_died_is_replaced_by_one_with_the_same_gpu(monkeypatch: pytest.MonkeyPatch):
    started: list[Options] = []

    class Process(Ended):
        """The second one died."""

        def start(self) -> None:
            self.exitcode = 1 if len(started) == 1 else 0
            started.append(self.options)

    boss = Supervisor(Options(processes=2, gpus=("4", "7"), once=True))
    monkeypatch.setattr(boss, "_start", SimpleNamespace(Process=Process, Pipe=Pipe))
    monkeypatch.setattr("workers.supervisor.time.sleep", lambda _: None)
    assert boss.run() == 0
    assert [options.gpus for options in started] == [("4",), ("7",), ("7",)]
