"""A queue of functions, each run in a separate process, one after the other, with progress, limits and a result.

`pbl web` has two: files that are made on request, and visits that are computed on request, which take far longer. The
loop that answers browsers and the thread that reads the tables continue meanwhile.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import logging
import math
import multiprocessing
import secrets
import shutil
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError
from pbl_pipeline.limited import LimitExceeded, limited
from pbl_pipeline.temporary import new_folder

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Task:
    """A function to run, and how."""

    function: Callable[..., object]  # importable by name
    args: tuple[Any, ...]
    broken: Callable[[str], PblError]  # makes the error of a process that died or exceeded a limit
    file: str = ""  # name of the file that the function writes: its path is the first argument then
    open_files: contextlib.ExitStack = dataclasses.field(default_factory=contextlib.ExitStack)  # closed at the end
    seconds: float = math.inf  # limits of `limited`
    n_bytes: int | None = None
    end_s: float = 0.0  # time that the process has to end when the queue is closed (s)


class Work:
    """A task in the queue."""

    def __init__(self, begin: Callable[[Any], Future[Path | None]]) -> None:
        # A lock would start a process, which imports from the current folder.
        self._done = multiprocessing.get_context("spawn").Value("d", 0.0, lock=False)
        self._future = begin(self._done)

    @property
    def state(self) -> str:
        """ "waiting", "running" or "ended"."""
        return "ended" if self._future.done() else "running" if self._future.running() else "waiting"

    @property
    def ended(self) -> bool:
        """True once it succeeded, failed, or was given up because the queue was closed."""
        return self._future.done()

    @property
    def share(self) -> float:
        """Fraction that is done, 0 to 1."""
        return 1.0 if self.path is not None else self._done.value

    @property
    def error(self) -> PblError | None:
        """Error of a failed task, else None."""
        found = self._future.exception() if self.ended and not self._future.cancelled() else None
        return found if isinstance(found, PblError) else None

    @property
    def path(self) -> Path | None:
        """The file, once it is complete."""
        return self._future.result() if self.ended and not self._future.cancelled() and self.error is None else None


class ProcessQueue:
    """Runs tasks one after the other, and keeps the files of the last ones until it is closed.

    `most`: number of tasks that may wait. `kept`: number of works that are kept; the oldest that have ended are
    forgotten, with their files.
    """

    def __init__(self, most: int, kept: int) -> None:
        self._most, self._kept = most, kept
        self._folder = new_folder()
        self._works: collections.OrderedDict[Hashable, Work] = collections.OrderedDict()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="process queue")
        self._lock, self._stop = threading.Lock(), threading.Event()

    def find(self, key: Hashable) -> Work | None:
        """Return the work of a key; None if nothing was begun, or it is no longer kept."""
        with self._lock:
            if key in self._works:
                self._works.move_to_end(key)
            return self._works.get(key)

    def drop(self, key: Hashable) -> None:
        """Forget a work that failed, so that it can be begun again."""
        with self._lock:
            if key in self._works and self._works[key].error is not None:
                del self._works[key]

    def begin(self, key: Hashable, task: Task) -> Work:
        """Return the work of a key: the earlier one where it waits, runs or has a file, else a new one. Raises
        `PblError` USAGE where too many wait."""
        with self._lock:
            earlier = self._works.pop(key, None)
            if earlier is None or (earlier.ended and earlier.path is None):
                if sum(w.state == "waiting" for w in self._works.values()) >= self._most:
                    task.open_files.close()
                    raise PblError(
                        "USAGE",
                        found=f"{self._most} tasks are waiting",
                        expected="fewer at a time",
                        next_step="load this page again when some of them are done",
                    )
                earlier = Work(functools.partial(self._submit, task))
            else:
                task.open_files.close()
            self._works[key] = earlier
            self._forget()
            return earlier

    def close(self) -> None:
        """End what is running and remove the files."""
        self._stop.set()
        self._thread.shutdown(cancel_futures=True)
        self._folder.cleanup()

    def _submit(self, task: Task, done: Any) -> Future[Path | None]:
        future = self._thread.submit(_run, task, done, self._folder.path, self._stop)
        future.add_done_callback(lambda _: task.open_files.close())
        return future

    def _forget(self) -> None:
        ended = [key for key, work in self._works.items() if work.ended]
        for key in ended[: max(0, len(self._works) - self._kept)]:
            path = self._works.pop(key).path
            if path is not None:
                shutil.rmtree(path.parent, ignore_errors=True)


def _run(task: Task, done: Any, root: Path, stop: threading.Event) -> Path | None:
    """Run a task to its end; return the file that it made, if it makes one. Raises the error that the function raised,
    `task.broken`, or INTERNAL for any other exception."""
    folder = root / secrets.token_hex(8)
    folder.mkdir()
    part = folder / f"part-{task.file}"
    args = (part, *task.args) if task.file else task.args
    limits = {"seconds": task.seconds, "n_bytes": task.n_bytes, "end_s": task.end_s}
    try:
        limited(_reporting, done, task.function, args, **limits, stop=stop)
        return part.rename(folder / task.file) if task.file else None
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, PblError):
            raise
        if isinstance(error, LimitExceeded | OSError):
            raise task.broken(str(error)) from error
        log.exception("running %s", task.function.__name__)
        raise PblError(
            "INTERNAL",
            found=f"{type(error).__name__}: {error}",
            expected="a result",
            next_step="report the text that is in the terminal of `pbl web`",
        ) from error


def _reporting(done: Any, function: Callable[..., object], args: tuple[Any, ...]) -> None:
    """Call the function, in the process; `done` gets the fraction that `progress.track` counts."""

    def tell(n: int, total: int | None) -> None:
        done.value = n / total if total else 0.0

    progress.tell(tell)
    function(*args)
