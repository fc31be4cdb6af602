"""The machine and the memory as a measured process sees them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from pbl_pipeline.resources import cores


def machine() -> dict[str, Any]:
    """Device and processor as this process saw them."""
    out: dict[str, Any] = {"cores": cores()}
    if "jax" in sys.modules:
        import jax

        out |= {"device": str(jax.devices()[0].device_kind), "jax": jax.__version__}
    return out


def peak_rss() -> int:
    """Peak memory (bytes) of this process so far."""
    # Linux counts ru_maxrss on from the process that forked; VmHWM belongs to this program alone.
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        return 1024 * int(next(x for x in status.splitlines() if x.startswith("VmHWM:")).split()[1])
    except (OSError, StopIteration):
        import resource  # here: Windows has neither

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
