"""What became computable: after single jobs, and over all tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

from schemas import computed_tables, video
from schemas.connection import schema_name

from . import queue, recover
from .queue import Claim
from .registry import NEW, stage_of, table_named

#: A failure here decides that a trial does not take part in the fit of its session.
DECIDES = ("VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput")


@dataclasses.dataclass
class Refreshed:
    """What a refresh did: table -> queued jobs; deleted jobs, freed reservations, planned fits, dropped rows."""

    queued: dict[str, int] = dataclasses.field(default_factory=dict)
    swept: int = 0
    freed: int = 0
    planned: int = 0
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)


def after(done: Sequence[Claim], failed: Sequence[Claim] = ()) -> int:
    """Queue what these jobs made computable, by their keys only: milliseconds however large the tables are."""
    n = 0
    touched: list[dict[str, Any]] = []
    for table in {c.table for c in done}:
        of_table = [c for c in done if c.table is table]
        for name in stage_of(table).followers:
            follower = table_named(name)
            for priority in {c.priority for c in of_table}:
                n += queue.fill(follower, [c.key for c in of_table if c.priority == priority], priority)
        if table.__name__ in ("SubjectChoice", "TrialInput"):
            touched += [c.key for c in of_table]
    touched += [c.key for c in failed if c.table.__name__ in DECIDES]
    if touched:
        priority = min(c.priority for c in (*done, *failed))
        n += plan(sessions_of(touched), priority)
    return n


def sessions_of(keys: Iterable[dict[str, Any]]) -> list[int]:
    """The sessions of the videos in these keys."""
    ids = sorted({int(k["video_id"]) for k in keys if "video_id" in k})
    if not ids:
        return []
    return sorted({int(s) for s in (video.Video & [{"video_id": i} for i in ids]).to_arrays("session_id")})


def plan(sessions: Sequence[int] | None = None, priority: int = NEW) -> int:
    """Plan the fits of sessions (None: of all) whose trials are decided, and queue them; returns how many."""
    from schemas.plan import plan_fit_sets

    made = plan_fit_sets(sessions)
    queue.fill(table_named("SessionFit"), made, priority)
    return len(made)


def refresh(tables: Sequence[Any] | None = None) -> Refreshed | None:
    """Look at everything: free dead reservations, drop what a person's decision made outdated, queue what is missing.

    One process at a time: None where another one is at it. Workers and `pbl cron refresh` call it now and then; what
    workers finish themselves is queued at once by `after`.
    """
    chosen = list(tables) if tables is not None else computed_tables()
    connection = chosen[0].connection
    lock = schema_name("refresh")  # of this installation: locks are the server's
    if connection.query("SELECT GET_LOCK(%s, 0)", args=(lock,)).fetchone()[0] != 1:
        return None
    try:
        return _refresh(chosen)
    finally:
        connection.query("SELECT RELEASE_LOCK(%s)", args=(lock,))


def _refresh(tables: Sequence[Any]) -> Refreshed:
    from schemas.tracking import drop_outdated_choices

    out = Refreshed()
    for table in tables:
        out.freed += recover.free_dead(table)
    out.dropped = drop_outdated_choices()
    for table in tables:
        if table.__name__ == "SessionFit":
            out.planned = plan()
        out.swept += queue.sweep(table)
        n = queue.fill(table)
        if n:
            out.queued[table.__name__] = n
    return out
