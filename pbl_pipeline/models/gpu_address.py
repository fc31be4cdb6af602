"""Addresses and start of the processes that own the GPUs (`gpu_server`); the first that needs one starts it.

They are separate because many processes that detect share a GPU, and end by themselves after a while without
connections. Each GPU has its own; a process that sees several GPUs uses the one whose turn it is.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from pbl_pipeline.resources import VISIBLE_GPUS, given_gpus
from pbl_pipeline.temporary import private_folder

from .devices import asked_device

#: The two processes, by what they own.
NETWORKS, DECODER = "networks", "decoder"
#: Time after which a GPU process that does not listen has failed (s): loading JAX and the driver takes some seconds.
START_S = 120.0
#: Time for which a process does not try again to start one that failed (s).
AGAIN_S = 300.0
_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def gpu_visible() -> bool:
    """True if JAX would find an NVIDIA GPU, without loading it: a driver, a GPU that is not hidden, a plugin."""
    hidden = VISIBLE_GPUS in os.environ and not given_gpus()
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
    """Return the address of the process of the `NETWORKS` or the `DECODER` of a GPU, which is started if none listens:
    of the GPU whose turn it is for this process, or of the next one where that fails.

    Raises
    ------
    RuntimeError
        It starts on no GPU; the message is the last line that it printed.
    OSError
        The folder of its socket cannot be made.
    """
    error = RuntimeError("no GPU")
    seen, turn = _in_turn(os.environ.get(VISIBLE_GPUS))
    for gpu in (*seen[turn:], *seen[:turn]):
        at, failed = _FAILED.get((what, gpu), (-AGAIN_S, error))
        if time.monotonic() - at < AGAIN_S:
            error = failed
            continue
        try:
            return _running(what, gpu)
        except RuntimeError as found:
            error = found
            _FAILED[what, gpu] = time.monotonic(), error
    raise error


#: When the processes that could not be started were tried, and why they failed.
_FAILED = dict[tuple[str, str], tuple[float, RuntimeError]]()


@functools.cache
def _in_turn(_visible: str | None) -> tuple[tuple[str, ...], int]:
    """The GPUs of this process, "" for an unknown one, and the number of that whose turn it is: each process takes the
    next one."""
    seen = given_gpus() or ("",)
    if len(seen) == 1 or sys.platform == "win32":
        return seen, 0
    import fcntl  # not on Windows

    with (private_folder("gpu") / "turn").open("a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        turn = int(file.read() or 0) % len(seen)
        file.truncate(0)
        file.write(b"%d" % (turn + 1))
    return seen, turn


def gpu_number() -> int:
    """Number of the GPU whose turn it is for this process, among those that it sees."""
    return _in_turn(os.environ.get(VISIBLE_GPUS))[1]


def _running(what: str, gpu: str) -> str:
    import fcntl  # not on Windows, where JAX sees no GPU

    base = private_folder("gpu") / f"{_name(gpu)}-{what}"
    address = str(base.with_suffix(".sock"))
    with base.with_suffix(".lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _listens(address):
            _start(what, gpu, address, base.with_suffix(".log"))
    return address


def _name(gpu: str) -> str:
    """Name of the process for this code and a GPU."""
    here = Path(__file__).parent
    names = ("gpu_server.py", "network.py", "nvdec.py", "tflite_jax.py")
    code = b"".join((here / name).read_bytes() for name in names)
    return hashlib.sha256(code + gpu.encode() + sys.executable.encode()).hexdigest()[:16]


def _listens(address: str) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(address)
        except OSError:
            return False
    return True


def _start(what: str, gpu: str, address: str, log: Path) -> None:
    env = os.environ | ({VISIBLE_GPUS: gpu} if gpu else {})
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
