"""How much memory a call takes at most, and a limit that ends one which takes far more."""

import contextlib
import dataclasses
import resource
from collections.abc import Iterator
from pathlib import Path

MIB = 1 << 20
#: What a process may address beyond what it has: an allocation that is larger fails at once.
GUARD = 4 << 30


@dataclasses.dataclass
class Peak:
    """`mib`: the largest resident memory of the process; `grown_mib`: beyond what it had before."""

    mib: float = 0.0
    grown_mib: float = 0.0


@contextlib.contextmanager
def guarded() -> Iterator[Peak]:
    """Measure the memory of what runs inside, under the guard."""
    peak, before = Peak(), _status("VmRSS")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (int(_status("VmSize") * MIB) + GUARD, limits[1]))
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from now
    try:
        yield peak
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        peak.mib = _status("VmHWM")
        peak.grown_mib = peak.mib - before


def _status(name: str) -> float:
    line = next(t for t in Path("/proc/self/status").read_text().splitlines() if t.startswith(name + ":"))
    return int(line.split()[1]) / 1024
