"""Repeated computations: error rows on request, and results of an older method or code, behind all new work."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pbl_pipeline.errors import CODES, MACHINE, PblError
from pbl_schemas import computed_tables, fit, gait, gdi, keypoints, kinetics, tracking, video
from pbl_schemas.datajoint_setup import columns_read_once, dj
from pbl_schemas.intake import Methods
from pbl_schemas.intake.registration import resolve as resolve_ingest
from pbl_schemas.jobs import jobs_of, keys_of
from pbl_schemas.method_names import keys_named
from pbl_schemas.method_rows import resolve_method
from pbl_schemas.plan import default_fit, plan_fits, unsuited
from pbl_schemas.reading.status import error_counts, queue_counts
from pbl_schemas.rows import delete_below, inside, parts

from . import queue
from .registry import AGAIN, table_named

#: Codes of the machine that the same program and limits meet again.
_STAY = ("INTERNAL", "TIME_LIMIT")
#: Rows deleted in one transaction, and most of which the dependent ones are counted before.
CHUNK = 200


def retry_outside() -> dict[str, int]:
    """Make error rows pending again whose cause lies in the machine or its services (`errors.CODES`) and may be gone
    tomorrow; code -> how many."""
    server = video.Video.connection
    there = {code for _, code in error_counts(server, queue_counts(server))} - {*_STAY}
    return {code: sum(retry(code).values()) for code in sorted(there) if CODES[code].cause == MACHINE}


def retry(
    code: str | None = None,
    table: str | None = None,
    video_id: int | None = None,
    key: Mapping[str, Any] | None = None,
) -> dict[str, int]:
    """Make error rows pending again, of one code, one table, one video, one key of that table if asked; table -> how
    many. Raises `PblError` USAGE for an unknown table or code."""
    tables = [table_named(table)] if table else computed_tables()
    out = {}
    for one in tables:
        keys = None if video_id is None else _of_video(one, video_id)
        if key is not None:  # compared here: the server takes "1 x" for 1
            keys = [k for k in queue.errors_of(one, code).keys() if k == key]  # noqa: SIM118  a query
        n = queue.reset_to_new(queue.errors_of(one, code, keys)) if keys is None or keys else 0
        if n:
            out[one.__name__] = n
    return out


def _of_video(table: Any, video_id: int) -> list[dict[str, Any]]:
    """Keys of the error rows of a table that belong to a video or its trial, or to the set it is fitted in."""
    names = jobs_of(table).primary_key
    if "video_id" in names:
        trial = fit.trial_of(video_id)
        return (jobs_of(table).errors & inside("video_id", {video_id, trial})).keys()
    sets = (fit.FitSet.Video & {"video_id": video_id}).to_arrays("fit_set").tolist()
    return (jobs_of(table).errors & inside("fit_set", sets)).keys()


# ---------------------------------------------------------------------------------------------------------- reprocess
@dataclasses.dataclass(frozen=True)
class Reprocess:
    """Plan of repeated computations, whose rows the server counts until it is carried out."""

    table: str
    add: Any = ()  # query of the selections that lack a method
    chosen: dict[str, str] = dataclasses.field(default_factory=dict)  # the columns that name it
    fit_method: str | None = None  # that which fits it where it is one of the keypoints
    outdated: Any = ()  # query of the results that are deleted
    below: dict[str, int] = dataclasses.field(default_factory=dict)  # rows that go with them, where they are few
    # How many are not computed again now: recordings that are marked as not usable, or of another selection by now.
    unasked: int = 0


#: Where a method is selected: table -> (prefix of its columns, selection, method table).
_SELECTIONS: dict[str, tuple[str, Any, Any]] = {
    "Tracking": ("tracking", tracking.TrackingSelection, tracking.TrackingMethod),
    "Keypoints": ("keypoint", keypoints.KeypointSelection, keypoints.KeypointMethod),
    "SessionFit": ("fit", fit.FitPlan, fit.FitMethod),
    "GaitEvents": ("gait", gait.GaitPlan, gait.GaitEventMethod),
    "GDI": ("gdi", gdi.GdiPlan, gdi.GdiModel),
    "Kinetics": ("kinetics", kinetics.KineticsPlan, kinetics.KineticsMethod),
}


def plan_new_method(table: str, method: str, since: datetime.date | None = None) -> Reprocess:
    """Return what selecting a method for everything that went through another method of that table would add.

    Old rows stay: a method is part of the key. `since`: only videos registered from that day on.

    Raises `PblError` USAGE for a table without methods, SOLVER_UNKNOWN for an unknown method; what `plan.default_fit`
    raises.
    """
    name = table_named(table).__name__
    if name not in _SELECTIONS:
        raise PblError(
            "USAGE",
            found=f"--new-method with table {name}",
            expected="one of " + ", ".join(_SELECTIONS),
            next_step="name the table whose method changed; what follows from it is computed by itself",
        )
    prefix, selection, methods = _SELECTIONS[name]
    column = f"{prefix}_method"
    chosen = resolve_method(methods, method)
    recorded = video.Video & (True if since is None else f"video_created >= '{since:%Y-%m-%d}'")
    rows = selection & recorded
    if prefix == "kinetics":  # also visits that were registered before forces could be planned
        rows = dj.U("session_id") & (gait.GaitPlan & recorded)
    others = [k for k in rows.primary_key if k != column]
    lacking = (dj.U(*others) & rows) - (selection & {column: chosen}).proj()
    # The choice of the subject follows the tracking: that of this version, not of the older row.
    beside = {"subject_method": resolve_ingest(Methods())["subject_method"]} if prefix == "tracking" else {}
    return Reprocess(name, lacking, {column: chosen, **beside}, default_fit(chosen) if name == "Keypoints" else None)


def plan_again(
    table: str,
    method: str | None = None,
    since: datetime.datetime | None = None,
    before: datetime.datetime | None = None,
) -> Reprocess:
    """Return the results of a table that would be deleted and computed again: of a method, computed since or before a
    time. Raises `PblError` USAGE for an unknown table."""
    one = table_named(table)
    rows = one()
    prefix = next(n.removesuffix("_computed") for n in one.heading.names if n.endswith("_computed"))
    if method is not None:
        columns = [n for n in one.heading.names if n.endswith("_method")]
        rows = rows & [{c: key} for c, key in _named(columns, method)]
    if since is not None:
        rows = rows & f"{prefix}_computed >= '{since:%Y-%m-%d %H:%M:%S}'"
    if before is not None:
        rows = rows & f"{prefix}_computed < '{before:%Y-%m-%d %H:%M:%S}'"
    below = {}
    if 0 < len(rows) <= CHUNK:
        with columns_read_once():
            counts = dj.Diagram.cascade(one & rows.keys(), part_integrity="cascade").counts()
        below = {n: c for n, c in counts.items() if c}
    unasked = len(rows.proj().restrict(dj.Not(keys_of(one)), semantic_check=False))
    return Reprocess(one.__name__, outdated=rows, below=below, unasked=unasked)


def _named(columns: Sequence[str], name: str) -> list[tuple[str, str]]:
    """(column, key) of every method, and version of it, that has this key or short name. Raises SOLVER_UNKNOWN."""
    out, problem = [], None
    for column in columns:
        try:
            out += [(column, key) for key in keys_named(column, name)]
        except PblError as error:
            problem = error
    if not out and problem is not None:
        raise problem
    return out


def carry_out(plan: Reprocess) -> Iterator[int]:
    """Carry out a plan in small transactions, queued behind new work; yield how many are done so far."""
    one = table_named(plan.table)
    if plan.add:
        _, selection, _ = _SELECTIONS[plan.table]
        done = 0
        for part in parts({**row, **plan.chosen} for row in plan.add.to_dicts()):
            selection.insert(part, skip_duplicates=True)
            if plan.fit_method is not None:
                plan_fits(part, plan.fit_method)
            yield (done := done + len(part))
        # A new plan of fits makes keys computable of the table before it, which plans the sets.
        queue.fill(table_named("TrialInput") if one is fit.SessionFit else one, None, AGAIN)
    keys = plan.outdated.keys() if plan.outdated else ()
    for i in range(0, len(keys), CHUNK):
        part = keys[i : i + CHUNK]
        delete_below(one, part)
        queue.fill(one, part, AGAIN)
        yield min(i + CHUNK, len(keys))


def parse_time(text: str | None) -> datetime.datetime | None:
    """A day or time of the command line, UTC. Raises USAGE."""
    if text is None:
        return None
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise PblError(
            "USAGE", found=repr(text), expected="YYYY-MM-DD or YYYY-MM-DDTHH:MM:SS (UTC)", next_step="correct the time"
        ) from error


def summary(plan: Reprocess) -> Sequence[str]:
    """Return the effects of a plan in words."""
    out = []
    if plan.add:
        out.append(f"{len(plan.add)} selections would be added for {plan.table}; nothing is deleted")
        if method := plan.chosen.get("fit_method"):
            of_points = sorted((dj.U("keypoint_method") & plan.add).to_arrays("keypoint_method"))
            out += [f"warning: {said}" for points in of_points if (said := unsuited(method, points))]
    if plan.outdated:
        out.append(f"{len(plan.outdated)} rows of {plan.table} would be deleted and computed again")
        out += [f"  with it: {n} rows of {name}" for name, n in plan.below.items()]
        if plan.unasked:
            out.append(f"  {plan.unasked} of them only when they are asked for again (recordings marked as not usable)")
    return out or [f"nothing of {plan.table} is to be done again"]
