"""Cores and memory that this process may use: those of the machine, less what a container or batch system withholds."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

#: Variable with the number of cores of each of several processes that share a machine; `pbl worker` sets it.
CORES = "PBL_CORES"
#: Variables by which numerical libraries choose their number of threads when they are loaded: OpenMP, BLAS, XLA, OpenCV.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NPROC", "OPENCV_FOR_THREADS_NUM")
#: Where the kernel shows control groups, and to which of them a process belongs.
_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cores() -> int:
    """Number of cores that this process may use, 1 at least: what `PBL_CORES` states, at most those that the process is
    bound to and the quota of its control group."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    stated = os.environ.get(CORES, "")
    limits = [bound, *_quotas(), *([int(stated)] if stated.isdecimal() else [])]
    return max(1, int(min(limits)))


def memory_bytes() -> int:
    """Memory (bytes) of the machine, or the limit of this process's control group where that is less."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 1 << 32
    texts = [*_values("memory.max"), *_values("memory/memory.limit_in_bytes", "memory")]
    return min([whole, *(int(text) for text in texts if text.isdecimal())])


def divide_cores(processes: int) -> None:
    """Let each of several processes that are started from now on use its share of the cores only. Variables that are
    set already stay."""
    share = str(max(1, cores() // processes))
    os.environ[CORES] = share
    for name in _THREADS:
        os.environ.setdefault(name, share)


@contextlib.contextmanager
def shared_cores(processes: int) -> Iterator[None]:
    """As `divide_cores`, for processes that are started in this block."""
    before = {name: os.environ.get(name) for name in (CORES, *_THREADS)}
    divide_cores(processes)
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
    """Contents of a file of each control group from this process's own up to the root, as far as they are there.
    controller: of version 1, which has a tree for each."""
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
