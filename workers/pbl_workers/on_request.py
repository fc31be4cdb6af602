"""What `pbl web` makes in separate processes (`process_queue`). They import no page, which takes seconds of processor
time; each function imports what it needs."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pbl_pipeline.visit import Recording, Visit


def compute_visit(session_id: int, again: bool) -> None:
    """Compute the missing results of a visit, as `pbl populate --visit` does; a signal puts the running job back."""

    def end(*_: object) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    import pbl_schemas
    from pbl_workers.populate import populate

    pbl_schemas.activate()
    populate(visit=session_id, retry_errors=again)


def draw_overlay(out: Path, recording: Recording) -> None:
    """Draw the overlay video of a recording."""
    from pbl_pipeline import pipeline

    pipeline.draw_overlay(recording, out)


def write_report(out: Path, visit: Visit, language: str) -> None:
    """Write the report of a visit, a page in itself."""
    from pbl_pipeline.pipeline import write_visit_report

    write_visit_report(out, visit, language=language)
