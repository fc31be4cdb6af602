"""Visits that are computed on request: in a process of their own, one at a time, and how far each is."""

from __future__ import annotations

import collections
import dataclasses
import multiprocessing
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from starlette.requests import Request

from pbl_pipeline.errors import PblError
from schemas.visit_progress import Progress

#: Visits that may wait at a time, and seconds that a process is given to put its job back.
WAITING, END_S = 50, 15.0

#: What the process runs: number of the visit, whether errors are tried again, and where its own error is sent.
Target = Callable[[int, bool, Connection], None]


def compute_visit(session_id: int, again: bool, pipe: Connection) -> None:
    """Compute what is missing of a visit, as `pbl populate --visit` does; a signal puts the running job back."""

    def end(*_: object) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    import schemas
    from workers.populate import populate

    try:
        schemas.activate()
        populate(visit=session_id, retry_errors=again)
    except PblError as error:
        pipe.send(error)


class Computing:
    """Computes visits one after the other, each in a process of its own. What it does is in the queues of the tables:
    a job that a worker has taken is not taken again, and a process that ends leaves no half of a result."""

    def __init__(self, target: Target = compute_visit) -> None:
        self._target = target
        self._waiting: collections.OrderedDict[int, bool] = collections.OrderedDict()
        self._errors: collections.OrderedDict[int, PblError] = collections.OrderedDict()
        self._running: int | None = None
        self._changed, self._stop = threading.Condition(), False
        self._process: Any = None
        self._thread: threading.Thread | None = None

    def begin(self, session_id: int, again: bool = False) -> None:
        """Have a visit computed, unless it waits already; `again`: also what failed.

        Raises
        ------
        PblError
            USAGE where too many wait.
        """
        with self._changed:
            if len(self._waiting) >= WAITING and session_id not in self._waiting:
                raise PblError(
                    "USAGE",
                    found=f"{WAITING} visits wait to be computed here",
                    expected="fewer at a time",
                    next_step="ask again when some are done, or start workers (`pbl worker`)",
                )
            self._errors.pop(session_id, None)
            self._waiting[session_id] = self._waiting.get(session_id, False) or again
            self._changed.notify_all()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="computing", daemon=True)
                self._thread.start()

    def state(self, session_id: int) -> str:
        """ "running", "waiting", or "" where it is not asked for."""
        with self._changed:
            return "running" if self._running == session_id else "waiting" if session_id in self._waiting else ""

    def error(self, session_id: int) -> PblError | None:
        """What ended the last process of a visit before its end."""
        with self._changed:
            return self._errors.get(session_id)

    def close(self) -> None:
        """End the process that runs; its job goes back into the queue."""
        with self._changed:
            self._stop = True
            process = self._process
            self._changed.notify_all()
        if process is not None:
            process.terminate()
            process.join(END_S)
            process.kill()
        if self._thread is not None:
            self._thread.join(END_S)

    def _run(self) -> None:
        context = multiprocessing.get_context("spawn")
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stop)
                if self._stop:
                    return
                session_id, again = self._waiting.popitem(last=False)
                self._running = session_id
                ours, theirs = context.Pipe(duplex=False)
                self._process = context.Process(target=self._target, args=(session_id, again, theirs))
                self._process.start()
            theirs.close()
            error = self._ended(self._process, ours, session_id)
            with self._changed:
                self._running = self._process = None
                if error is not None and not self._stop:
                    self._errors[session_id] = error
                    while len(self._errors) > WAITING:
                        self._errors.popitem(last=False)
                self._changed.notify_all()

    @staticmethod
    def _ended(process: Any, pipe: Connection, session_id: int) -> PblError | None:
        """Wait for the end of a process; what it says that went wrong."""
        try:
            return pipe.recv()
        except EOFError:
            process.join()
            if process.exitcode == 0:
                return None
            return PblError(
                "WORKER_CRASH",
                found=f"the process that computed the visit died (exit code {process.exitcode})",
                expected="a process that computes it to its end",
                next_step="compute it again, which frees what it held; the terminal of `pbl web` says more",
                key=f"session_id={session_id}",
            )
        finally:
            pipe.close()
            process.join()


@dataclasses.dataclass(frozen=True)
class Told:
    """How far a visit is. state: as `Computing.state`; error: as `Computing.error`."""

    progress: Progress
    state: str
    error: PblError | None

    @property
    def busy(self) -> bool:
        """Whether it changes by itself: the page asks again."""
        return bool(self.state or self.progress.running)


def told(request: Request, progress: Progress) -> Told:
    """How far a visit is, for a page."""
    computing: Computing = request.app.state.computing
    return Told(progress, computing.state(progress.session_id), computing.error(progress.session_id))


def queue_visit(session_id: int) -> None:
    """Queue what a decision made computable of a visit, so that pages and workers see it at once."""
    from schemas.scope import of_visit
    from workers.refresh import refresh_scope

    refresh_scope(of_visit(session_id))


def queue_visit_of(video_id: int) -> None:
    """`queue_visit` of the visit that a recording belongs to."""
    from schemas import video

    queue_visit(int((video.Video & {"video_id": video_id}).fetch1("session_id")))
