"""A queue of functions, each run in a process of its own, one after the other, with progress, limits and a result.

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
import shutil
import tempfile
import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError

from .limited import LimitExceeded, limited

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Task:
    """A function to run, and how.

    Attributes
    ----------
    function, args
        Importable by name; arguments that can be pickled.
    broken
        The error to report where the process died or exceeded a limit, from a description of what happened.
    file
        Name of the file that the function writes, if any: the path of the file is then its first argument.
    open_files
        Closed when the function has ended.
    seconds, n_bytes
        Limits of `limited`.
    end_s
        Seconds that the process is given to end when the queue is closed.
    """

    function: Callable[..., object]
    args: tuple[Any, ...]
    broken: Callable[[str], PblError]
    file: str = ""
    open_files: contextlib.ExitStack = dataclasses.field(default_factory=contextlib.ExitStack)
    seconds: float = math.inf
    n_bytes: int | None = None
    end_s: float = 0.0


@dataclasses.dataclass
class Work:
    """A task in the queue."""

    task: Task
    state: str = "waiting"  # then "running" and "ended"
    path: Path | None = None  # the file, once it is complete
    error: PblError | None = None  # why the function did not succeed
    _done: Any = dataclasses.field(default_factory=lambda: multiprocessing.get_context("spawn").Value("d", 0.0))

    @property
    def share(self) -> float:
        """Fraction that is done, 0 to 1."""
        return 1.0 if self.path is not None else self._done.value

    @property
    def ended(self) -> bool:
        """True once it succeeded or failed."""
        return self.state == "ended"

    def run(self, folder: Path, stop: threading.Event) -> None:
        """Run the task to its end; failures are reported by `error`."""
        task, args, part = self.task, self.task.args, folder / f"part-{self.task.file}"
        try:
            if task.file:
                folder.mkdir()
                args = (part, *args)
            limits = {"seconds": task.seconds, "n_bytes": task.n_bytes, "end_s": task.end_s}
            limited(_reporting, self._done, task.function, args, **limits, stop=stop)
            if task.file:
                self.path = part.rename(folder / task.file)
        except PblError as error:
            self.error = error
        except (LimitExceeded, OSError) as error:
            self.error = task.broken(str(error))
        except Exception as error:
            log.exception("running %s", task.function.__name__)
            self.error = PblError(
                "INTERNAL",
                found=f"{type(error).__name__}: {error}",
                expected="a result",
                next_step="report the text that is in the terminal of `pbl web`",
            )
        if self.error is not None:
            shutil.rmtree(folder, ignore_errors=True)


class ProcessQueue:
    """Runs tasks one after the other, and keeps what the last ones produced until it is closed.

    Parameters
    ----------
    most
        Number of tasks that may wait.
    kept
        Number of works that are kept; the oldest that have ended are forgotten, with their files.
    """

    def __init__(self, most: int, kept: int) -> None:
        self._most, self._kept = most, kept
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-web-")
        self._works: collections.OrderedDict[Hashable, Work] = collections.OrderedDict()
        self._waiting: collections.deque[Work] = collections.deque()
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._thread: threading.Thread | None = None

    def find(self, key: Hashable) -> Work | None:
        """Return the work of a key; None where nothing was begun, or it is no longer kept."""
        with self._changed:
            if key in self._works:
                self._works.move_to_end(key)
            return self._works.get(key)

    def drop(self, key: Hashable) -> None:
        """Forget a work that failed, so that it can be begun again."""
        with self._changed:
            if key in self._works and self._works[key].error is not None:
                del self._works[key]

    def begin(self, key: Hashable, task: Task) -> Work:
        """Return the work of a key: the earlier one where it waits, runs or has a file, else a new one.

        Raises
        ------
        PblError
            USAGE where too many wait.
        """
        with self._changed:
            earlier = self._works.get(key)
            if earlier is not None and (not earlier.ended or earlier.path is not None):
                task.open_files.close()
                return earlier
            if len(self._waiting) >= self._most:
                task.open_files.close()
                raise PblError(
                    "USAGE",
                    found=f"{self._most} tasks are waiting",
                    expected="fewer at a time",
                    next_step="load this page again when some of them are done",
                )
            work = self._works[key] = Work(task)
            self._works.move_to_end(key)
            self._waiting.append(work)
            self._forget()
            self._changed.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="process queue", daemon=True)
                self._thread.start()
            return work

    def close(self) -> None:
        """End what is running and remove the files."""
        self._stop.set()
        with self._changed:
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
        for work in self._waiting:
            work.task.open_files.close()
        self._folder.cleanup()

    def _forget(self) -> None:
        ended = [key for key, work in self._works.items() if work.ended]
        for key in ended[: max(0, len(self._works) - self._kept)]:
            path = self._works.pop(key).path
            if path is not None:
                shutil.rmtree(path.parent, ignore_errors=True)

    def _run(self) -> None:
        number = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stop.is_set())
                if self._stop.is_set():
                    return
                work = self._waiting.popleft()
                work.state = "running"
            number += 1
            with work.task.open_files:
                work.run(Path(self._folder.name) / str(number), self._stop)
            work.state = "ended"


def _reporting(done: Any, function: Callable[..., object], args: tuple[Any, ...]) -> None:
    """Run in the process: call the function; what `progress.track` counts goes into `done`."""
    progress.tell(functools.partial(_tell, done))
    function(*args)


def _tell(done: Any, n: int, total: int | None) -> None:
    done.value = n / total if total else 0.0
