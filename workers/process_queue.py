"""Files that are made when somebody asks for them: one after the other, each in a process of its own.

The loop that answers browsers and the thread that asks the tables go on meanwhile. A file is served when it is whole.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import logging
import multiprocessing
import shutil
import tempfile
import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError

from ..limited import LimitExceeded, limited

log = logging.getLogger(__name__)

#: Files that are kept, and works that may wait, at a time.
KEPT, WAITING = 8, 20
#: Seconds and memory (byte) that one may take: a minute of 4K video is drawn in a few minutes.
_SECONDS, _BYTES = 3600.0, 8 * 2**30


@dataclasses.dataclass
class Work:
    """A file that is made. path: set once it is whole; error: why there is none."""

    name: str
    path: Path | None = None
    error: PblError | None = None
    _done: Any = dataclasses.field(default_factory=lambda: multiprocessing.get_context("spawn").Value("d", 0.0))

    @property
    def share(self) -> float:
        """How much of it is done, 0..1."""
        return 1.0 if self.path is not None else self._done.value

    @property
    def ended(self) -> bool:
        """Whether it is there, or failed."""
        return self.path is not None or self.error is not None

    def make(self, path: Path, task: Task, stop: threading.Event) -> None:
        """Make the file. What goes wrong is told by `error`."""
        path.parent.mkdir()
        part = path.with_name(f"part-{path.name}")
        try:
            limited(_call, self._done, task.function, part, task.args, seconds=_SECONDS, n_bytes=_BYTES, stop=stop)
            self.path = part.rename(path)
        except PblError as error:
            self.error = error
        except (LimitExceeded, OSError) as error:
            self.error = PblError(
                "WEB_NOT_MADE",
                found=f"{task.name}: {error}",
                expected="a file that is written to its end",
                next_step="load the page again to have it made anew; `pbl report` writes it without limits",
            )
        except Exception as error:
            log.exception("making %s", task.name)
            self.error = PblError(
                "INTERNAL",
                found=f"{type(error).__name__}: {error}",
                expected="a file",
                next_step="report the text that is in the terminal; `pbl report` writes the same files",
            )
        if self.path is None:
            shutil.rmtree(path.parent, ignore_errors=True)


@dataclasses.dataclass(frozen=True)
class Task:
    """How a file is made: `function(path, *args)` writes it and can be imported by name; `open_files` is closed when
    that has ended."""

    name: str
    function: Callable[..., object]
    args: tuple[Any, ...]
    open_files: contextlib.ExitStack


class Making:
    """Makes files and keeps the last ones until the page ends."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-web-")
        self._works: collections.OrderedDict[Hashable, Work] = collections.OrderedDict()
        self._waiting: collections.deque[tuple[Work, Task]] = collections.deque()
        self._lock, self._stop = threading.Condition(), threading.Event()
        self._number = 0
        self._thread: threading.Thread | None = None

    def find(self, key: Hashable) -> Work | None:
        """The work of a key; None where nothing was begun, or nothing is kept any more."""
        with self._lock:
            if key in self._works:
                self._works.move_to_end(key)
            return self._works.get(key)

    def drop(self, key: Hashable) -> None:
        """Forget a work that failed, so that asking again begins it again."""
        with self._lock:
            if key in self._works and self._works[key].error is not None:
                del self._works[key]

    def begin(self, key: Hashable, task: Task) -> Work:
        """Have a file made under a key, unless it is there or on its way.

        Raises
        ------
        PblError
            USAGE where too many wait.
        """
        with self._lock:
            if key in self._works or len(self._waiting) >= WAITING:
                task.open_files.close()
                if key in self._works:
                    return self._works[key]
                raise PblError(
                    "USAGE",
                    found=f"{WAITING} files wait to be made",
                    expected="fewer at a time",
                    next_step="load this page again when some are done",
                )
            work = self._works[key] = Work(task.name)
            self._waiting.append((work, task))
            self._forget()
            self._lock.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="making", daemon=True)
                self._thread.start()
            return work

    def close(self) -> None:
        """End what is being made and remove what was."""
        self._stop.set()
        with self._lock:
            self._lock.notify()
        if self._thread is not None:
            self._thread.join()
        for _, task in self._waiting:
            task.open_files.close()
        self._folder.cleanup()

    def _forget(self) -> None:
        ended = [key for key, work in self._works.items() if work.ended]
        for key in ended[: max(0, len(self._works) - KEPT)]:
            path = self._works.pop(key).path
            if path is not None:
                shutil.rmtree(path.parent, ignore_errors=True)

    def _run(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._waiting or self._stop.is_set())
                if self._stop.is_set():
                    return
                work, task = self._waiting.popleft()
                self._number += 1
                path = Path(self._folder.name) / str(self._number) / task.name
            with task.open_files:
                work.make(path, task, self._stop)


def _call(done: Any, function: Callable[..., object], path: Path, args: tuple[Any, ...]) -> None:
    """In the process of its own."""
    from pbl_pipeline import progress

    progress.tell(functools.partial(_tell, done))
    function(path, *args)


def _tell(done: Any, n: int, total: int | None) -> None:
    done.value = n / total if total else 0.0
