"""Cores and memory: those of the machine, less what a container or batch system withholds; divided by the processes."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace

import pytest

from pbl_pipeline import resources
from schemas.operations.embedded import process
from tests.command import pbl
from tests.ended_process import Ended
from workers import supervisor
from workers.process import Options

GB = 2**30


def groups(folder: Path, patch: pytest.MonkeyPatch, own: str, files: dict[str, str]) -> None:
    """A tree of control groups as the kernel shows it."""
    patch.setattr(resources, "_GROUPS", folder)
    (folder / "own").write_text(own)
    patch.setattr(resources, "_OWN", folder / "own")
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text + "\n")


@pytest.fixture
def sixteen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is bound to 16 cores of a machine with 64 GB."""
    for name in (resources.CORES, *resources._THREADS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 16 * 2**20}.__getitem__)


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/", {}, (16, 64 * GB)),
        ("0::/", {"cpu.max": "max 100000", "memory.max": "max"}, (16, 64 * GB)),
        ("0::/", {"cpu.max": "250000 100000", "memory.max": str(8 * GB)}, (2, 8 * GB)),  # a container
        ("0::/", {"cpu.max": "50000 100000"}, (1, 64 * GB)),
        ("0::/slice/job", {"slice/cpu.max": "400000 100000", "slice/job/cpu.max": "max 100000"}, (4, 64 * GB)),
        ("0::/slice/job", {"slice/memory.max": str(GB), "slice/job/memory.max": str(2 * GB)}, (16, GB)),
        (
            "4:memory:/docker/a\n3:cpu,cpuacct:/docker/a",
            {
                "cpu/docker/a/cpu.cfs_quota_us": "300000",
                "cpu/docker/a/cpu.cfs_period_us": "100000",
                "cpu/cpu.cfs_quota_us": "-1",
                "cpu/cpu.cfs_period_us": "100000",
                "memory/docker/a/memory.limit_in_bytes": str(4 * GB),
            },
            (3, 4 * GB),
        ),
    ],
)
def test_limits_of_control_groups_count(sixteen, tmp_path: Path, monkeypatch, own: str, files: dict, expected: tuple):
    groups(tmp_path, monkeypatch, own, files)
    assert (resources.cores(), resources.memory_bytes()) == expected


def test_what_is_stated_counts_but_never_more_than_there_is(sixteen, tmp_path: Path, monkeypatch):
    groups(tmp_path, monkeypatch, "0::/", {"cpu.max": "400000 100000"})
    for stated, expected in (("3", 3), ("64", 4), ("0", 1), ("many", 4)):
        monkeypatch.setenv(resources.CORES, stated)
        assert resources.cores() == expected


@pytest.mark.parametrize(
    ("asked", "shares"),
    [
        (("--resource", "fit"), ["16"]),
        (("--no-phones", "--processes", "5"), ["3"] * 5),
        (("--processes", "auto"), [*["2"] * 8, "16"]),  # the last one is for phones
    ],
)
def test_a_worker_divides_the_cores_by_its_processes(sixteen, tmp_path: Path, monkeypatch, asked: tuple, shares: list):
    groups(tmp_path, monkeypatch, "0::/", {})
    monkeypatch.setattr("schemas.activate", lambda **_: None)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")  # who sets it means it
    seen: list[dict[str, str]] = []
    names = (resources.CORES, *resources._THREADS)

    class Process(Ended):
        def start(self) -> None:
            seen.append({name: os.environ[name] for name in names})

    monkeypatch.setattr("multiprocessing.get_context", lambda _: SimpleNamespace(Process=Process, Pipe=Pipe))
    monkeypatch.setattr("workers.process.given_gpus", tuple)
    assert pbl("worker", *asked).code == 0
    assert seen == [dict.fromkeys(names, share) | {"OMP_NUM_THREADS": "7"} for share in shares]
    assert not {*names} - {"OMP_NUM_THREADS"} & {*os.environ}


def test_little_memory_means_fewer_processes(sixteen, tmp_path: Path, monkeypatch):
    groups(tmp_path, monkeypatch, "0::/", {"memory.max": str(13 * GB)})
    monkeypatch.setattr("schemas.activate", lambda **_: None)
    monkeypatch.setattr("workers.process.given_gpus", tuple)
    found: list[Options] = []
    monkeypatch.setattr(supervisor.Supervisor, "run", lambda self: found.append(self.options) or 0)
    assert pbl("worker", "--processes", "auto").code == 0
    assert [o.processes for o in found] == [3]
    assert pbl("worker", "--processes", "many").code == 2


def test_a_machine_with_gpus_is_used_whole(sixteen, tmp_path: Path, monkeypatch):
    """A process for each core, of which one for each GPU fits; for the fit alone one for each GPU."""
    groups(tmp_path, monkeypatch, "0::/", {})
    monkeypatch.setattr("schemas.activate", lambda **_: None)
    monkeypatch.setattr("workers.process.given_gpus", lambda: ("0", "1"))
    found: list[Options] = []
    monkeypatch.setattr(supervisor.Supervisor, "run", lambda self: found.append(self.options) or 0)
    for asked in ((), ("--resource", "gpu")):
        assert pbl("worker", "--processes", "auto", *asked).code == 0
    whole, fit = found
    each = [whole.of_process(n) for n in range(whole.processes)]
    assert [(o.resource, o.gpus) for o in each] == [("all" if n < 2 else "cpu", (str(n % 2),)) for n in range(16)]
    assert {o.processes for o in each} == {8}
    assert [fit.of_process(n).resource for n in range(fit.processes)] == ["gpu", "gpu"]


def test_the_numerical_library_keeps_to_its_share():
    """XLA makes a thread for each core it may use; with a share of one core it makes one."""
    program = (
        "import os, jax.numpy as j; x = j.ones((300, 300)); (x @ x).block_until_ready()\n"
        "names = [open(f'/proc/self/task/{t}/comm').read() for t in os.listdir('/proc/self/task')]\n"
        "print(sum('XLAEigen' in name for name in names))"
    )
    with pytest.MonkeyPatch.context() as patch:
        for name in (resources.CORES, *resources._THREADS):
            patch.setenv(name, "x")
            patch.delenv(name)
        with resources.shared_cores(1000):
            done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"


@pytest.mark.parametrize(("limit", "expected"), [(GB, 256), (16 * GB, 2048), (64 * GB, 8192)])
def test_the_database_is_sized_to_the_machine(sixteen, tmp_path: Path, monkeypatch, limit: int, expected: int):
    groups(tmp_path, monkeypatch, "0::/", {"memory.max": str(limit)})
    assert process.buffer_pool_mb() == expected
