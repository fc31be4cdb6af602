"""Queue what became computable: after single jobs, and over all tables."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from pbl_schemas import chain, fit, review, tracking, video, worker
from pbl_schemas.decisions.review_decisions import QUEUE
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading.visit_progress import Scope, of_visit
from pbl_schemas.rows import exist, inside
from pbl_schemas.worker import installation_lock

from . import queue, recover
from .queue import Claim
from .registry import NEW, base_priority

#: Days in which something from outside counts as recent, and seconds after which a worker looks at everything again.
RECENT_DAYS, ALL_EVERY_S = 2, 3600.0
#: Name of a look at all rows in `worker.Look`.
ALL = "all"
#: With fewer videos every look is at everything: it takes no time.
FEW = 10_000


@dataclasses.dataclass
class Refreshed:
    """Outcome of a refresh: table -> queued jobs; deleted jobs, freed reservations, planned fits, dropped rows."""

    queued: Counter[str] = dataclasses.field(default_factory=Counter)
    swept: int = 0
    freed: int = 0
    planned: int = 0
    dropped: Counter[str] = dataclasses.field(default_factory=Counter)

    def add(self, other: Refreshed) -> None:
        """Also count what another one did."""
        for field in dataclasses.fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))


def after(done: Sequence[Claim], failed: Sequence[Claim] = ()) -> Refreshed:
    """Queue what these jobs made computable, by their keys only: milliseconds however large the tables are."""
    out = Refreshed()
    touched: list[dict[str, Any]] = []
    for table in {c.table for c in done}:
        of_table = [c for c in done if c.table is table]
        for follower in chain.followers(table):
            for priority in {base_priority(c.priority) for c in of_table}:
                keys = [c.key for c in of_table if base_priority(c.priority) == priority]
                if follower is fit.TrialInput:
                    keys = fit.TrialInput.with_trials(keys)
                out.queued[follower.__name__] += queue.fill(follower, keys, priority)
        if table in (tracking.SubjectChoice, fit.TrialInput):
            touched += [c.key for c in of_table]
    # A failure before the fit decides that a trial does not take part in it.
    touched += [c.key for c in failed if c.table in chain.before(fit.SessionFit)]
    if touched:
        out.planned = plan(sessions_of(touched), min(base_priority(c.priority) for c in (*done, *failed)))
    return out


def sessions_of(keys: Iterable[dict[str, Any]]) -> list[int]:
    """The sessions of the videos in these keys."""
    ids = sorted({int(k["video_id"]) for k in keys if "video_id" in k})
    if not ids:
        return []
    return sorted({int(s) for s in (video.Video & inside("video_id", ids)).to_arrays("session_id")})


def plan(sessions: Sequence[int] | None = None, priority: int = NEW) -> int:
    """Plan the fits of sessions (None: of all) whose trials are decided, and queue them; returns how many."""
    from pbl_schemas.plan import plan_fit_sets

    made = plan_fit_sets(sessions)
    queue.fill(fit.SessionFit, made, priority)
    return len(made)


def refresh(everything: bool | None = None) -> Refreshed | None:
    """Look for computable keys: free dead reservations, drop results that a decision made outdated, queue missing ones.

    Followers of finished jobs are queued immediately (`after`), so a look is for changes from outside: new recordings,
    choices, methods, deleted rows. Comparing whole tables takes long with 300,000 videos, so most looks are at the
    recordings that were registered or decided about in the last `RECENT_DAYS`, and one an hour at all.

    Returns None while another process is looking.

    `everything`: look at all rows; None if the last such look is an hour ago, or where there are few videos.
    """
    server = video.Video.connection
    with installation_lock("refresh", server) as had:
        if not had:
            return None
        if everything is None:
            some = server.query(f"SELECT 1 FROM {video.Video.full_table_name} LIMIT {FEW}").fetchall()  # noqa: S608
            everything = len(some) < FEW or _age_of_full_look() > ALL_EVERY_S
        lately = None if everything else recent()
        out = _queue_missing(lately)
        if lately is None:
            server.query(
                f"INSERT INTO {worker.Look.full_table_name} (look, look_time) VALUES (%s, CURRENT_TIMESTAMP(3))"  # noqa: S608
                " ON DUPLICATE KEY UPDATE look_time = CURRENT_TIMESTAMP(3)",
                args=(ALL,),
            )
        return out


def recent() -> Scope | None:
    """Recordings that something from outside may have happened to lately, and their sessions: registered, or decided
    about by a person, in the last `RECENT_DAYS`; None if they are many, as of an archive that was just registered."""
    since = f">= CURRENT_TIMESTAMP - INTERVAL {RECENT_DAYS} DAY"
    new = video.Video & f"video_created {since}"
    if len(new) > FEW:
        return None
    ids = {int(v) for v in new.to_arrays("video_id")}
    ids |= {int(v) for v in (tracking.SubjectOverride & f"override_created {since}").to_arrays("video_id")}
    decided = review.Decision & f"decision_at {since}" & "video_id is not null"
    ids |= {int(v) for v in decided.to_arrays("video_id")}
    return None if len(ids) > FEW else Scope(sorted(ids), sessions_of([{"video_id": v} for v in ids]))


def refresh_scope(scope: Scope) -> Refreshed:
    """Refresh some recordings alone, also while another process looks at all: queue what can be computed of them, and
    remove obsolete jobs of them."""
    return _queue_missing(scope, own=True)


QUEUE.append(lambda session_id: refresh_scope(of_visit(session_id)))


def _queue_missing(scope: Scope | None, own: bool = False) -> Refreshed:
    """Queue what can be computed of a scope (None: of all). `own`: other recordings stay untouched; otherwise outdated
    choices are dropped, and all queues are swept."""
    from pbl_schemas.tracking import drop_outdated_choices

    out, tables = Refreshed(), chain.computed_tables()
    in_use = [*itertools.compress(tables, exist(*map(jobs_of, tables)))]  # the others have nothing to free or sweep
    for table in in_use:
        out.freed += recover.free_dead(table)
    if not own:
        out.dropped = Counter(drop_outdated_choices())
    for table in tables:
        if table is fit.SessionFit:
            out.planned = plan(None if scope is None else scope.sessions)
            out.queued += Counter({table.__name__: out.planned})
        where = None if scope is None else scope.where(table)
        if where is not None or scope is None:
            if table in in_use:
                out.swept += queue.sweep(table, *([f"status != 'reserved' AND {where}"] if own else []))
            out.queued += Counter({table.__name__: queue.fill(table, where=where)})  # without zeros
        elif not own and table in in_use:
            out.swept += queue.sweep(table, "status = 'error'")  # few: those of a deleted row go immediately
    return out


def _age_of_full_look() -> float:
    """Seconds since the last look at all rows; infinite if there was none."""
    table = worker.Look.full_table_name
    row = video.Video.connection.query(
        f"SELECT TIMESTAMPDIFF(SECOND, look_time, CURRENT_TIMESTAMP(3)) FROM {table} WHERE look=%s",  # noqa: S608
        args=(ALL,),
    ).fetchone()
    return float("inf") if row is None or row[0] < 0 else float(row[0])  # negative: the clock was set back
