"""Cores and memory: those of the machine, less what a container or batch system withholds; divided by the processes."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace

import pytest

from pbl_pipeline import assets, resources
from pbl_pipeline.errors import PblError
from pbl_pipeline.limited import LimitExceeded, limited
from pbl_pipeline.resources import keep_large_blocks
from pbl_schemas.operations.embedded import process
from pbl_workers import supervisor
from pbl_workers.process import Options
from tests import Environment, Limits
from tests.command import pbl
from tests.ended_process import Ended

GB = 2**30


@pytest.fixture
def groups(tmp_path: Path, limits: Limits) -> Callable[[str, dict[str, str]], None]:
    """Writes a tree of control groups as the kernel shows it."""
    limits(resources, _GROUPS=tmp_path, _OWN=tmp_path / "own")

    def write(own: str, files: dict[str, str]) -> None:
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text + "\n")

    return write


@pytest.fixture
def sixteen(monkeypatch: pytest.MonkeyPatch, environment: Environment) -> None:
    """A process that is bound to 16 cores of a machine with 64 GB."""
    environment(**dict.fromkeys((resources.CORES, *resources._THREADS)))
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
def test_limits_of_control_groups_count(sixteen, tmp_path: Path, groups, own: str, files: dict, expected: tuple):
    groups(own, files)
    assert (resources.cores(), resources.memory_bytes()) == expected


def test_what_is_stated_counts_but_never_more_than_there_is(sixteen, tmp_path: Path, groups, environment):
    groups("0::/", {"cpu.max": "400000 100000"})
    for stated, expected in (("3", 3), ("64", 4), ("0", 1), ("many", 4)):
        environment(**{resources.CORES: stated})
        assert resources.cores() == expected


@pytest.mark.parametrize(
    ("asked", "shares"),
    [
        (("--resource", "fit"), ["16"]),
        (("--no-phones", "--processes", "5"), ["3"] * 5),
        (("--processes", "auto"), [*["1"] * 16, "16"]),  # the last one is for phones
    ],
)
def test_a_worker_divides_the_cores_by_its_processes(
    sixteen, tmp_path: Path, monkeypatch, groups, environment, asked: tuple, shares: list
):
    groups("0::/", {})
    monkeypatch.setattr("pbl_schemas.activate", lambda **_: None)
    environment(OMP_NUM_THREADS="7")  # who sets it means it
    seen: list[dict[str, str]] = []
    names = (resources.CORES, *resources._THREADS)

    class Process(Ended):
        def start(self) -> None:
            seen.append({name: os.environ[name] for name in names})

    monkeypatch.setattr("multiprocessing.get_context", lambda _: SimpleNamespace(Process=Process, Pipe=Pipe))
    monkeypatch.setattr("pbl_pipeline.resources.given_gpus", tuple)
    assert pbl("worker", *asked).code == 0
    assert seen == [dict.fromkeys(names, share) | {"OMP_NUM_THREADS": "7"} for share in shares]
    assert not {*names} - {"OMP_NUM_THREADS"} & {*os.environ}


@pytest.fixture
def worker_options(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Options]:
    """The options of `pbl worker --processes auto` on a machine with these GPUs."""
    found: list[Options] = []
    monkeypatch.setattr("pbl_schemas.activate", lambda **_: None)
    monkeypatch.setattr(supervisor.Supervisor, "run", lambda self: found.append(self.options) or 0)

    def asked_for(gpus: tuple[str, ...], *asked: str) -> Options:
        monkeypatch.setattr("pbl_pipeline.resources.given_gpus", lambda: gpus)
        assert pbl("worker", "--processes", "auto", *asked).code == 0
        return found[-1]

    return asked_for


def test_little_memory_means_fewer_processes(sixteen, tmp_path: Path, worker_options, groups):
    groups("0::/", {"memory.max": str(13 * GB)})
    assert worker_options(()).processes == 3
    assert pbl("worker", "--processes", "many").code == 2


@pytest.mark.parametrize(("gpu_detects", "n"), [(False, 16), (True, 32)])
def test_a_machine_with_gpus_is_used_whole(
    sixteen, tmp_path: Path, monkeypatch, worker_options, groups, gpu_detects: bool, n: int
):
    """A process for each core, or two where a GPU detects; of them, and for the fit alone, one for each GPU fits."""
    groups("0::/", {})
    monkeypatch.setattr(resources, "memory_bytes", lambda: 128 * GB)
    monkeypatch.setattr("pbl_pipeline.models.gpu_address.gpu_visible", lambda: gpu_detects)
    whole, fit = (worker_options(("0", "1"), *asked) for asked in ((), ("--resource", "gpu")))
    each = [whole.of_process(n) for n in range(whole.processes)]
    assert [(o.resource, o.gpus) for o in each] == [("all" if i < 2 else "cpu", (str(i % 2),)) for i in range(n)]
    assert {o.processes for o in each} == {n // 2}
    assert resources.processes_at_once(gpu_detects) == n  # also those of `pbl run`
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
def test_the_database_is_sized_to_the_machine(sixteen, tmp_path: Path, groups, limit: int, expected: int):
    groups("0::/", {"memory.max": str(limit)})
    assert process.buffer_pool_mb() == expected


# --- Pictures that are let go go back to the system.


#: After the first picture was freed: does the next one lie in the heap, where it leaves a hole?
PROGRAM = """
import sys
import numpy as np
from pbl_pipeline.resources import keep_large_blocks

if sys.argv[1:]:
    assert keep_large_blocks(sys.argv[1] == "kept")
first = np.ones(6_220_800, np.uint8)
del first
place = np.ones(6_220_800, np.uint8).ctypes.data
heap = next(line for line in open("/proc/self/maps") if line.rstrip().endswith("[heap]")).split()[0].split("-")
print(int(heap[0], 16) <= place < int(heap[1], 16))
"""


@pytest.mark.skipif(not keep_large_blocks(False), reason="another C library than glibc")
@pytest.mark.parametrize(("how", "expected"), [((), "True"), (("kept",), "True"), (("returned",), "False")])
def test_pictures_are_kept_out_of_the_heap(how: tuple[str, ...], expected: str):
    done = subprocess.run([sys.executable, "-c", PROGRAM, *how], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected


# --- A function that takes too long or too much is ended; what it raises arrives.


@pytest.mark.parametrize(
    ("function", "argument", "said"),
    [
        (time.sleep, 600.0, "more than 3 s"),
        (bytearray, 2**31, "more than 256 MiB of memory"),
        (os._exit, 3, "ended with code 3"),
    ],
    ids=["time", "memory", "death"],
)
def test_what_takes_too_much_is_ended(function, argument, said: str):
    begun = time.monotonic()
    with pytest.raises(LimitExceeded, match=said):
        limited(function, argument, seconds=3.0 if function is time.sleep else 300.0, n_bytes=2**28)
    assert time.monotonic() - begun < 300.0


def test_what_is_raised_there_is_raised_here():
    with pytest.raises(ValueError, match="invalid literal"):
        limited(int, "x", seconds=60.0, n_bytes=2**28)
    assert limited(int, "1", seconds=60.0, n_bytes=2**28) is None
    assert limited(int, "1", seconds=60.0, n_bytes=2**28, returns=True) == 1


# --- Notices of compiled libraries: that line is kept off the standard error, everything else is not.


PROBE = """
import os
from pbl_pipeline.models.tflite import without_notice
try:
    with without_notice(b"known words"):
        os.write(2, b"INFO: known words\\nERROR: other words\\n")
        raise RuntimeError("it failed")
except RuntimeError as error:
    os.write(2, f"{error}\\n".encode())
with without_notice(b"known words"):
    os.write(2, b"later: known words\\n")
"""


def said(program: str) -> str:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300).stderr


def test_all_else_is_written_also_where_the_block_fails():
    assert said(PROBE) == "ERROR: other words\nit failed\nlater: known words\n"


@pytest.mark.slow
def test_loading_a_model_says_nothing():
    try:
        path = assets.fetch("blazepose_detector")
    except PblError:
        pytest.skip("the model is not in the cache")
    name = "blazepose_detector"
    program = "from pbl_pipeline import assets\nfrom pbl_pipeline.models import LiteModel\n"
    program += f"LiteModel({str(path)!r}, assets.ASSETS[{name!r}].sha256)\n"
    assert said(program) == ""
