"""The GPUs that this worker was given, found without the numerical library, which would take them."""

from __future__ import annotations

import os
import subprocess

#: Variable by which a process sees only some of the GPUs; batch systems set it for a job.
VISIBLE = "CUDA_VISIBLE_DEVICES"
#: After so long a driver that does not answer counts as none.
QUERY_S = 30.0


def given_gpus() -> tuple[str, ...]:
    """Names of the GPUs, as `CUDA_VISIBLE_DEVICES` takes them: those that this variable lists, else all of the machine;
    none where there is no NVIDIA driver."""
    listed = os.environ.get(VISIBLE)
    if listed is None:
        query = ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"]
        try:
            done = subprocess.run(query, capture_output=True, text=True, check=True, timeout=QUERY_S)
            listed = ",".join(done.stdout.split())
        except (OSError, subprocess.SubprocessError):
            return ()
    return tuple(name for name in map(str.strip, listed.split(",")) if name not in ("", "-1", "NoDevFiles"))
