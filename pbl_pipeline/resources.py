"""Cores and memory that this process may use, within the limits of a container or batch system.

Memory of pictures is returned to the system as soon as they are freed.

The C library of Linux keeps blocks of up to 32 MB in one heap once the first of them was freed. A picture of a phone
video has 6 MB; small results that stay are stored between two of them, so the hole that a picture leaves is soon too
small for the next one, and the heap grows although nothing is held: tracking took 3.3 GB after two minutes of 1080p.
With a fixed limit, large blocks are mapped separately and returned when freed. A lower limit (128 KB, so that colour
planes are mapped separately, too) keeps 0.2 GB less after a recording and takes a tenth more processor time.

Where all pictures of one recording after the other are held (`video.kept`), the heap is better: those of the next one
take the places of the last, while the system clears mapped memory each time, a quarter of the time of decoding.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

#: Blocks from this size on are mapped separately (bytes), and those that the heap may hold while it keeps them.
LARGE, LARGEST_IN_HEAP = 1 << 20, 32 << 20
#: The C library's names of that limit, and of the free bytes at the heap's end that it keeps (malloc.h).
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1


@functools.cache
def _c_library() -> Any:
    """The C library if it is glibc, else None."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "mallopt") and hasattr(library, "malloc_trim") else None


def fewer_collections() -> None:
    """Let Python look for garbage in cycles at most a fifth as often: looking takes a tenth of the processor time of
    the imports, and frees little, as arrays are not in cycles."""
    gc.set_threshold(10_000)


def keep_large_blocks(keep: bool) -> bool:
    """Let the heap keep large blocks that are freed for the next ones, or have them returned to the system; True where
    the C library can do that (glibc)."""
    limit, free_at_end = (LARGEST_IN_HEAP, 2**31 - 1) if keep else (LARGE, 128 << 10)
    library = _c_library()
    return library is not None and bool(
        library.mallopt(_M_MMAP_THRESHOLD, limit) and library.mallopt(_M_TRIM_THRESHOLD, free_at_end)
    )


def return_free_memory() -> None:
    """Return what the heap keeps of freed blocks to the system."""
    if (library := _c_library()) is not None:
        library.malloc_trim(0)


#: Variable with the number of cores of each of several processes that share a machine; `pbl worker` sets it.
CORES = "PBL_CORES"
#: Variables by which numerical libraries choose their number of threads when loaded: OpenMP, XLA, OpenCV.
_THREADS = ("OMP_NUM_THREADS", "NPROC", "OPENCV_FOR_THREADS_NUM")
#: Makes the GNU C library ask the kernel for large pages: of the 1.4 ms to keep a decoded picture, page faults of 4 KB
#: took 1.1 ms (research/reports).
_LARGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
#: Makes Python not import from the current folder, which may hold another checkout.
SAFE_PATH = {"PYTHONSAFEPATH": "1"}
#: The kernel's control groups, and the file that names those of this process.
_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


#: Variable by which a process sees only some of the GPUs; batch systems set it for a job.
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
#: Time after which a driver that does not answer counts as missing (s).
QUERY_S = 30.0


def cores(stated: bool = True) -> int:
    """Number of cores that this process may use, at least 1: those that it is bound to, at most the quota of its
    control group and, with `stated`, `PBL_CORES`."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    own = os.environ.get(CORES, "") if stated else ""
    limits = [bound, *_quotas(), *([int(own)] if own.isdecimal() else [])]
    return max(1, int(min(limits)))


def memory_bytes() -> int:
    """Memory (bytes) of the machine, or the limit of this process's control group where that is less."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 1 << 32
    texts = [*_values("memory.max"), *_values("memory/memory.limit_in_bytes", "memory")]
    return min([whole, *(int(text) for text in texts if text.isdecimal())])


def share_of_memory() -> float:
    """Memory (bytes) of this process, where each core's share is equal."""
    return memory_bytes() * cores() / max(cores(stated=False), 1)


def processes_at_once(gpu_detects: bool) -> int:
    """Number of processes that use this machine fully: one for each core, or two where a GPU detects, for which a
    process waits most of the time; 4 GB for each, as a long recording takes."""
    return max(1, min((2 if gpu_detects else 1) * cores(), memory_bytes() // (4 << 30)))


def _gpus(*columns: str) -> list[list[str]] | None:
    """Index and these columns of `nvidia-smi` of each GPU of the machine, as text; none without an NVIDIA driver, None
    if it does not answer."""
    query = ["nvidia-smi", f"--query-gpu={','.join(('index', *columns))}", "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, check=True, timeout=QUERY_S)
    except OSError:
        return []
    except subprocess.SubprocessError:
        return None
    return [[cell.strip() for cell in line.split(",")] for line in done.stdout.splitlines()]


#: Figures of a GPU: the column of `nvidia-smi`, and what its values are multiplied by.
_USE = {"busy": ("utilization.gpu", 0.01), "used": ("memory.used", 2**20), "size": ("memory.total", 2**20)}


def gpu_use() -> list[dict[str, Any]] | None:
    """Return of each NVIDIA GPU of the machine its index as `gpu`, the fraction of time that it is `busy`, and its
    memory `used` and `size` (byte), without what it does not measure. None: the driver does not answer."""
    found = _gpus(*(column for column, _ in _USE.values()))
    if found is None:
        return None
    out: list[dict[str, Any]] = [{"gpu": index} for index, *_ in found]
    for one, (_, *values) in zip(out, found, strict=True):
        for (name, (_, unit)), value in zip(_USE.items(), values, strict=False):
            with contextlib.suppress(ValueError):  # "[N/A]"
                one[name] = float(value) * unit
    return out


def given_gpus() -> tuple[str, ...]:
    """Names of the GPUs, as `CUDA_VISIBLE_DEVICES` takes them: those that this variable lists, else all of the machine;
    none if there is no NVIDIA driver."""
    listed = os.environ.get(VISIBLE_GPUS)
    names = [row[0] for row in _gpus() or []] if listed is None else map(str.strip, listed.split(","))
    return tuple(itertools.takewhile(lambda name: name not in ("", "-1", "NoDevFiles"), names))


@contextlib.contextmanager
def shared_cores(processes: int) -> Iterator[dict[str, str]]:
    """Let each of several processes that are started in this block use its share of the cores only, and large pages of
    memory. Variables of the libraries that are set already stay. Yields the variables, which a forked process sets."""
    share = str(max(1, cores() // processes))
    defaults = dict.fromkeys(_THREADS, share) | _LARGE_PAGES | SAFE_PATH
    given = {name: os.environ.get(name, value) for name, value in defaults.items()} | {CORES: share}
    with variables(given):
        yield given


@contextlib.contextmanager
def variables(given: dict[str, str]) -> Iterator[None]:
    """Set environment variables for processes that are started in this block."""
    before = {name: os.environ.get(name) for name in given}
    os.environ |= given
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _quotas() -> Iterator[float]:
    """Cores by the quotas of the control groups (versions 2 and 1) above this process."""
    for text in _values("cpu.max"):
        quota, _, period = text.partition(" ")
        if quota.isdecimal() and period.isdecimal():
            yield int(quota) / int(period)
    periods = _values("cpu/cpu.cfs_period_us", "cpu")
    for quota, period in zip(_values("cpu/cpu.cfs_quota_us", "cpu"), periods, strict=False):
        if quota.isdecimal() and period.isdecimal():
            yield int(quota) / int(period)


def _values(name: str, controller: str = "") -> list[str]:
    """Contents of a file of each control group from this process's up to the root, as far as they exist. controller: of
    version 1, which has a tree for each."""
    folder, _, file = name.rpartition("/")
    own = _read(_OWN).splitlines()
    paths = [p for _, names, p in (line.split(":", 2) for line in own) if controller in names.split(",")]
    found = []
    for path in paths or ["/"]:
        group = _GROUPS / folder / path.strip("/")
        while group.is_relative_to(_GROUPS / folder):
            found.append(_read(group / file))
            group = group.parent
    return [text for text in found if text]


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
