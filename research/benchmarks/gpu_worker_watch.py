"""The working process of `gpu_worker`: the real one, which notes when it does what.

Each span is one line of the file of a process: name, begin and end on the machine's clock, how many sessions, and
what of the time its thread spent on tracing and compiling (or loading) programs.
"""

from __future__ import annotations

import functools
import json
import os
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from workers.process import Options

#: Variable that names the folder of the notes.
NOTES = "PBL_BENCH_NOTES"


def work(options: Options, pipe: Connection) -> None:
    """`workers.process.work`, watched."""
    from workers import process

    watch(Path(os.environ[NOTES]) / f"{os.getpid()}.jsonl")
    process.work(options, pipe)


def watch(path: Path) -> None:
    """Have the functions of the pipeline of batches note their spans in `path`."""
    import jax
    import numpy as np

    from pbl_pipeline.fit import per_frame, session_fit
    from schemas import fit
    from workers import queue, run_job

    notes = Notes(path)

    def waited(function: Callable) -> Callable:
        # The device has nothing left to do when the span ends: `jit` itself returns before.
        return lambda *a, **k: jax.block_until_ready(function(*a, **k))

    def number_of(*arguments: Any) -> int:
        return len(arguments[0])

    for module, name, n in (
        (queue, "claim", None),
        (run_job, "fetch_batch", number_of),
        (run_job, "compute_batch", number_of),
        (run_job, "run", None),
        (session_fit, "make_session", None),
        (session_fit, "start_of", None),
        (session_fit, "_session_fit", None),
        (per_frame, "_on_floor", None),
        (per_frame, "_solve", number_of),
        (fit.SessionFit, "_loaded", None),
        (fit.SessionFit, "make_compute", None),
        (fit.SessionFit, "make_insert", None),
        (np, "savez_compressed", None),
    ):
        setattr(module, name, notes.noted(getattr(module, name), name.strip("_"), n))
    for name in ("_one", "_many", "_finish_one", "_finish_many"):
        setattr(per_frame, name, notes.noted(waited(getattr(per_frame, name)), "device"))


class Notes:
    """Appends a line for each call of what `noted` wraps; from any thread."""

    def __init__(self, path: Path) -> None:
        import jax

        self._file, self._lock = path.open("a", buffering=1), threading.Lock()
        self._compiled = threading.local()
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def noted(self, function: Callable, name: str, n: Callable[..., int] | None = None) -> Callable:
        """The function, with a note of each call; `n` says of how many sessions."""

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            begin, compiled = time.monotonic(), self._seconds()
            try:
                return function(*args, **kwargs)
            finally:
                span = {"name": name, "begin": begin, "end": time.monotonic(), "compiling": self._seconds() - compiled}
                line = json.dumps({**span, "n": n(*args) if n is not None else 1})
                with self._lock:
                    self._file.write(line + "\n")

        return call

    def _heard(self, event: str, duration_secs: float, **_: object) -> None:
        if event.startswith("/jax/core/compile/"):
            self._compiled.seconds = self._seconds() + duration_secs

    def _seconds(self) -> float:
        return getattr(self._compiled, "seconds", 0.0)
