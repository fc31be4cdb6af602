"""Results of a measured process, with its machine and memory."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import cores


def write_result(path: str | Path, measure: Callable[[], dict[str, Any]]) -> None:
    """Write the result of a measurement as JSON, or its error, with the machine."""
    try:
        result = measure()
    except PblError as error:
        result = {"error": error.code, "error_text": error.text()}
    except Exception as error:  # noqa: BLE001 - the table of the benchmark shows the error and continues
        result = {"error": type(error).__name__, "error_text": str(error)}
    Path(path).write_text(json.dumps(result | machine()), encoding="utf-8")


def machine() -> dict[str, Any]:
    """Device and processor of this process."""
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
