"""What is still to be computed of a visit: what waits, what runs where, what failed and what helps."""

from __future__ import annotations

import dataclasses

from .. import computed_tables
from ..job_errors import error_code, error_found, error_next_step
from ..operations.catalog import quote
from ..video import Video
from .scope import of_visit
from .status import queue_counts, queue_name


@dataclasses.dataclass(frozen=True)
class Failed:
    """A computation that failed: of which table, the code of its error, what was found and what to do."""

    table: str
    code: str
    found: str
    next_step: str


@dataclasses.dataclass(frozen=True)
class Progress:
    """The jobs of a visit. running: table and computer of each that is being computed."""

    session_id: int
    queued: int
    running: tuple[tuple[str, str], ...]
    failed: tuple[Failed, ...]

    @property
    def pending(self) -> bool:
        """Whether something waits or runs."""
        return self.queued > 0 or bool(self.running)


def visit_progress(session_id: int) -> Progress:
    """Of the usable recordings of a visit and its current sets, as far as it is queued."""
    scope, server = of_visit(session_id), Video.connection
    counts = queue_counts(server)
    queued, running, failed = 0, [], []
    for table in computed_tables():
        if not any(counts[table.__name__].values()):
            continue
        where = scope.where(table)
        if where is None:
            continue
        rows = server.query(
            f"SELECT status, host, error_message FROM {quote(*queue_name(table))} WHERE {where}"  # noqa: S608
        ).fetchall()
        for status, host, message in rows:
            queued += status == "pending"
            if status == "reserved":
                running.append((table.__name__, str(host)))
            elif status == "error":
                said = str(message)
                failed.append(Failed(table.__name__, error_code(said), error_found(said), error_next_step(said)))
    return Progress(int(session_id), queued, tuple(running), tuple(failed))
