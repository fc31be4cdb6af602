"""How far the tables are: counts, errors with their next step, videos that wait for a choice."""

from __future__ import annotations

import dataclasses
from typing import Any

from . import computed_tables, tracking, video
from ._base import error_code, error_found, error_next_step

#: Columns that say "ran well, nothing to produce": table -> (status, values, reason or None where a table above says).
EMPTY_COLUMNS: dict[str, tuple[str, tuple[str, ...], str | None]] = {
    "SubjectChoice": ("choice_status", ("NO_PERSON",), "choice_reason"),
    "GaitEvents": ("events_status", ("EMPTY",), "events_reason"),
    "Spatiotemporal": ("measures_status", ("EMPTY",), "measures_reason"),
    "GDI": ("gdi_status", ("EMPTY",), None),
    "SessionGdi": ("session_status", ("EMPTY",), None),
}


@dataclasses.dataclass(frozen=True)
class TableStatus:
    """One computed table. pending: keys without a result, a reservation or an error; empty is part of done."""

    table: str
    done: int
    empty: int
    pending: int
    reserved: int
    error: int
    waiting: int


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """One error row. `about`: file name where the key has a video."""

    table: str
    key: dict[str, Any]
    about: str
    code: str
    found: str
    next_step: str
    stack: str


@dataclasses.dataclass(frozen=True)
class EmptyRow:
    """A video for which a stage ran well and found nothing to go on with."""

    table: str
    video_id: int
    about: str
    reason: str


@dataclasses.dataclass(frozen=True)
class Waiting:
    """A video that needs a person's choice, with the command that decides."""

    video_id: int
    about: str
    reason: str
    persons: list[int]
    next_step: str


@dataclasses.dataclass(frozen=True)
class Status:
    """The whole state."""

    videos: int
    tables: list[TableStatus]
    errors: list[ErrorRow]
    empty: list[EmptyRow]
    waiting: list[Waiting]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return dataclasses.asdict(self)


def pipeline_status() -> Status:
    """Query the state of all computed tables. `schemas.activate()` must have been called."""
    tables, errors = [], []
    for table in computed_tables():
        counts = table.jobs.progress()
        remaining, _ = table().progress()
        waiting = len(table & {"choice_status": "NEEDS_CHOICE"}) if table is tracking.SubjectChoice else 0
        pending = max(0, remaining - counts["reserved"] - counts["error"] - counts["ignore"])
        done, empty = len(table()), len(empty_rows(table))
        tables.append(TableStatus(table.__name__, done, empty, pending, counts["reserved"], counts["error"], waiting))
        errors += _errors(table)
    return Status(len(video.Video()), tables, errors, _empty(), _waiting())


def empty_rows(table: Any) -> Any:
    """Rows of a computed table that say "ran well, nothing to produce"."""
    if table.__name__ not in EMPTY_COLUMNS:
        return table & False
    column, values, _ = EMPTY_COLUMNS[table.__name__]
    return table & [{column: v} for v in values]


def _empty() -> list[EmptyRow]:
    out: list[EmptyRow] = []
    for table in computed_tables():
        reason = EMPTY_COLUMNS.get(table.__name__, ("", (), None))[2]
        if reason is None:
            continue
        said = {e.video_id for e in out}  # the first table that has nothing knows why
        for row in (empty_rows(table) * video.Video.proj("video_name")).to_dicts(order_by="video_id"):
            if int(row["video_id"]) in said:
                continue
            out.append(EmptyRow(table.__name__, int(row["video_id"]), row["video_name"], row[reason]))
    return out


def _errors(table: Any) -> list[ErrorRow]:
    out = []
    for row in table.jobs.errors.to_dicts():
        key = {k: row[k] for k in table.jobs.primary_key}
        message = row["error_message"]
        out.append(
            ErrorRow(
                table=table.__name__,
                key=key,
                about=_file_of(key),
                code=error_code(message),
                found=error_found(message),
                next_step=error_next_step(message),
                stack=str(row["error_stack"] or ""),
            )
        )
    return out


def _file_of(key: dict[str, Any]) -> str:
    if "video_id" not in key:
        return ""
    names = (video.Video & {"video_id": key["video_id"]}).to_arrays("video_name")
    return str(names[0]) if len(names) else ""


def _waiting() -> list[Waiting]:
    out = []
    rows = (tracking.SubjectChoice & {"choice_status": "NEEDS_CHOICE"}) * video.Video.proj("video_name")
    for row in rows.to_dicts(order_by="video_id"):
        key = {k: row[k] for k in ("video_id", "tracking_method")}
        persons = sorted(int(p) for p in (tracking.Tracking.Person & key).to_arrays("person_id"))
        out.append(
            Waiting(
                video_id=int(row["video_id"]),
                about=row["video_name"],
                reason=row["choice_reason"],
                persons=persons,
                next_step=f"pbl choose {row['video_id']} {'|'.join(map(str, persons))}",
            )
        )
    return out
