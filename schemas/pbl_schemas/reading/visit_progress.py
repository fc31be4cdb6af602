"""Pending computations of a visit: queued, running and failed jobs."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from .. import computed_tables, fit, video
from ..job_errors import stored_error
from ..operations.catalog import quote
from ..video import Video
from .status import queue_counts, queue_name


@dataclasses.dataclass(frozen=True)
class Scope:
    """Recordings and sessions. current: of their sets only those that count."""

    videos: list[int]
    sessions: list[int]
    current: bool = False

    def where(self, table: Any) -> str | None:
        """Return the condition on the first column of a table's key; None if no row can belong to these."""
        if "fit_set" in table.heading.primary_key:
            return self._of_sets
        return f"video_id in ({','.join(map(str, self.videos))})" if self.videos else None

    @functools.cached_property
    def _of_sets(self) -> str | None:
        """The condition on `fit_set`, of the sets that there are when it is first asked for."""
        rows: Any = fit.FitSet & f"session_id in ({','.join(map(str, self.sessions))})" if self.sessions else None
        if rows is not None and self.current:
            rows = rows & fit.current().proj()
        sets = [] if rows is None else [str(s) for s in rows.to_arrays("fit_set")]
        return "fit_set in (" + ",".join(f"'{s}'" for s in sets) + ")" if sets else None


def of_visit(session_id: int) -> Scope:
    """The usable recordings of a visit and its current sets."""
    usable = (video.Video & {"session_id": int(session_id)}) - video.NotUsable
    return Scope(sorted(int(v) for v in usable.to_arrays("video_id")), [int(session_id)], current=True)


@dataclasses.dataclass(frozen=True)
class Failed:
    """A failed computation: its table, the code of the error, what was found, the remedy, and its recording if any."""

    table: str
    code: str
    found: str
    next_step: str
    recording: int | None


@dataclasses.dataclass(frozen=True)
class Progress:
    """The jobs of a visit. running: table and computer of each that is being computed."""

    session_id: int
    queued: int
    running: tuple[tuple[str, str], ...]
    failed: tuple[Failed, ...]

    @property
    def pending(self) -> bool:
        """True if a job waits or runs."""
        return self.queued > 0 or bool(self.running)


def visit_progress(session_id: int) -> Progress:
    """Return the queued computations of the usable recordings of a visit and its current sets."""
    scope, server = of_visit(session_id), Video.connection
    counts = queue_counts(server)
    queued, running, failed = 0, [], []
    for table in computed_tables():
        if not any(counts[table.__name__].values()):
            continue
        where = scope.where(table)
        if where is None:
            continue
        of = "video_id" if "video_id" in table.heading.primary_key else "NULL"
        rows = server.query(
            f"SELECT status, host, error_message, {of} FROM {quote(*queue_name(table))} WHERE {where}"  # noqa: S608
        ).fetchall()
        for status, host, message, recording in rows:
            queued += status == "pending"
            if status == "reserved":
                running.append((table.__name__, str(host)))
            elif status == "error":
                error = stored_error(str(message))
                failed.append(Failed(table.__name__, error.code, error.found, error.next_step, recording))
    return Progress(int(session_id), queued, tuple(running), tuple(failed))
