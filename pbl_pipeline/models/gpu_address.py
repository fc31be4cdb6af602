"""Addresses and start of the processes that own the GPU (`gpu_server`); the first that needs one starts it.

They are separate because many processes that detect share one GPU, and end by themselves after a while without
connections.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from pbl_pipeline.temporary import private_folder

from .devices import asked_device

#: The two processes, by what they own.
NETWORKS, DECODER = "networks", "decoder"
#: Time after which a GPU process that does not listen has failed (s): loading JAX and the driver takes some seconds.
START_S = 120.0
_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def gpu_visible() -> bool:
    """True if JAX would find an NVIDIA GPU, without loading it: a driver, a GPU that is not hidden, a plugin."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    hidden = listed is not None and listed.split(",")[0].strip() in ("", "-1", "NoDevFiles")
    other = os.environ.get("JAX_PLATFORMS", "")
    if hidden or (other and not {"cuda", "gpu"} & set(other.split(","))):
        return False
    driver = any(Path(p).exists() for p in ("/dev/nvidiactl", "/proc/driver/nvidia/version", "/dev/dxg"))
    return driver and any(importlib.util.find_spec(p) is not None for p in _PLUGINS)


def gpu_wanted() -> bool:
    """True if a GPU is visible and PBL_ONNX_DEVICE is not "cpu".

    Raises `PblError` USAGE: a GPU is visible and PBL_ONNX_DEVICE names an unknown device.
    """
    return gpu_visible() and asked_device() != "cpu"


def running_server(what: str) -> str:
    """Return the address of the process of the `NETWORKS` or the `DECODER`, which is started if none listens.

    Raises
    ------
    RuntimeError
        It does not start; the message is the last line that it printed.
    OSError
        The folder of its socket cannot be made.
    """
    import fcntl  # not on Windows, where JAX sees no GPU

    base = private_folder("gpu") / f"{_name()}-{what}"
    address = str(base.with_suffix(".sock"))
    with base.with_suffix(".lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _listens(address):
            _start(what, address, base.with_suffix(".log"))
    return address


def _name() -> str:
    """Name of the process for this code and the GPUs that this process may use."""
    here = Path(__file__).parent
    names = ("gpu_server.py", "network.py", "nvdec.py", "tflite_jax.py")
    code = b"".join((here / name).read_bytes() for name in names)
    seen = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
    return hashlib.sha256(code + seen.encode() + sys.executable.encode()).hexdigest()[:16]


def _listens(address: str) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(address)
        except OSError:
            return False
    return True


def _start(what: str, address: str, log: Path) -> None:
    env = dict(os.environ)
    # The fit may be another process on the same GPU.
    env.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    env["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    with log.open("wb") as out:
        # -P: do not import from the current folder, which may hold another checkout.
        command = [sys.executable, "-P", "-m", "pbl_pipeline.models.gpu_server", what, address]
        process = subprocess.Popen(
            command, env=env, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
        )
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        if _listens(address):
            return
        if process.poll() is not None:
            lines = log.read_text("utf-8", "replace").strip().splitlines()
            raise RuntimeError(lines[-1][:300] if lines else f"the GPU process ended with {process.returncode}")
        time.sleep(0.05)
    process.kill()
    raise RuntimeError(f"the GPU process did not listen within {START_S:g} s")
