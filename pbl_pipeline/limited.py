"""Run a function in a separate process, which is killed when it takes too much time or memory.

On Linux it is a copy of a process that has only imported ("forkserver"): a second of imports happens once. A module
named to `multiprocessing.set_forkserver_preload` may not set the environment when it is imported: copies lose that.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from .resources import SAFE_PATH, variables

_BEGINS = threading.Lock()  # of the process that is copied


class LimitExceeded(Exception):
    """The function took more time or memory than it was given, or its process died."""


def limited(
    function: Callable[..., object],
    *args: Any,
    seconds: float = math.inf,
    n_bytes: int | None = None,
    returns: bool = False,
    stop: threading.Event | None = None,
    end_s: float = 0.0,
) -> Any:
    """Call a function for its exceptions, or for its result. A script that calls this needs the guard
    `if __name__ == "__main__":`.

    Parameters
    ----------
    function, args
        Importable by name; arguments and exceptions that can be pickled.
    seconds
        Time it may take. The first call waits for imports before that; elsewhere than on Linux they are included.
    n_bytes
        Memory the process may allocate in addition to what its imports take; None: any amount.
    returns
        Return the result, which can be pickled, instead of None.
    stop
        Ends the process when it is set.
    end_s
        Time from SIGTERM, when the process is stopped, until it is killed (s).

    Raises
    ------
    LimitExceeded
        Too much time or memory, or the process was stopped or died. Exceptions of `function` are raised here.
    """
    context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
    ours, theirs = context.Pipe(duplex=False)
    try:
        environment = _begun()
        how = (theirs, environment, n_bytes, seconds, returns, function, args)
        process = context.Process(target=_call, args=how, daemon=True)
        process.start()
    except (EOFError, OSError) as error:  # the process that is copied was killed, or the machine is full
        raise LimitExceeded(f"its process did not start: {error}") from error
    finally:
        theirs.close()
    try:
        end = time.monotonic() + seconds
        while not ours.poll(min(0.2, max(0.0, end - time.monotonic()))):
            if stop and stop.is_set():
                if end_s:
                    process.terminate()
                    process.join(end_s)
                raise LimitExceeded("it was stopped")
            if time.monotonic() >= end:
                raise LimitExceeded(f"more than {seconds:g} s")
        try:
            error, result = ours.recv()
        except EOFError:
            process.join(5.0)
            raise LimitExceeded(f"its process ended with code {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
        ours.close()
    if isinstance(error, MemoryError):
        limit = "there is" if n_bytes is None else f"{n_bytes / 2**20:.0f} MiB"
        raise LimitExceeded(f"more than {limit} of memory")
    if error is not None:
        raise error
    return result


def _begun() -> dict[str, str]:
    """Start the process that is copied, unless it runs; return the environment."""
    with _BEGINS:
        environment = dict(os.environ)
        if sys.platform == "linux":
            copied: Any = forkserver._forkserver  # pyright: ignore - whether it runs has no public name
            pid, options = copied._forkserver_pid, os.WEXITED | os.WNOHANG | os.WNOWAIT
            if pid is None or os.waitid(os.P_PID, pid, options):
                with variables(SAFE_PATH):
                    forkserver.ensure_running()
        return environment


def _call(
    pipe: Connection,
    environment: dict[str, str],
    n_bytes: int | None,
    seconds: float,
    returns: bool,
    function: Callable[..., object],
    args: tuple,
) -> None:
    os.environ.clear()  # a copy has that of the first one
    os.environ.update(environment)
    if n_bytes is not None:
        _limit_memory(n_bytes)
    if math.isfinite(seconds):
        _limit_time(seconds)
    try:
        result = function(*args)
        pipe.send((None, result if returns else None))
    except Exception as error:  # noqa: BLE001  raised where the function was called
        error.add_note(traceback.format_exc())
        pipe.send((error, None))


def _limit_time(seconds: float) -> None:
    """End the process where its caller was killed and cannot."""
    try:
        import resource

        most = math.ceil(seconds) * max(1, os.cpu_count() or 1)  # of all threads together
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
    except (ImportError, OSError, ValueError):
        pass


def _limit_memory(n_bytes: int) -> None:
    try:
        import resource

        # The memory of imports does not count: with many cores numpy alone reserves a gigabyte for its threads.
        pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[5])
        most = pages * resource.getpagesize() + n_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    except (ImportError, OSError, ValueError):  # another system than Linux, or a lower limit that may not be raised
        pass
