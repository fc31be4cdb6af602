"""Registering very many recordings at once: an archive, or what arrived in a drop folder."""

from __future__ import annotations

import dataclasses
import datetime
import functools
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from . import lab, session, video
from .codes import check_subject, day_of
from .ingest import METHOD_FIELDS, Methods, check_owner, in_transaction, next_id, resolve, selections, video_row
from .rows import utc_now

#: Rows in one transaction.
CHUNK = 5000


@dataclasses.dataclass(frozen=True)
class Recording:
    """A file whose bytes are known: `sha256` was computed when it was taken over."""

    path: str
    sha256: str
    size: int
    subject: str
    session_label: str = session.UNLABELLED
    activity: str = "walking"
    camera_motion: str = "static"


@dataclasses.dataclass
class Registered:
    """How many were new, and how many had been registered before."""

    new: int = 0
    known: int = 0


def register_many(recordings: Iterable[Recording], methods: Methods | None = None) -> Registered:
    """Register recordings with the methods they go through, some thousand in a transaction.

    The same bytes are registered once. The files are not opened: what is wrong with one is found when it is computed.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name; SOLVER_UNKNOWN, NORM_UNKNOWN; VIDEO_DUPLICATE where another
        subject has the same bytes (earlier transactions stay).
    """
    chosen = resolve(methods or Methods())
    out = Registered()
    for chunk in _chunks(recordings):
        for one in chunk:
            check_subject(one.subject, "give the person such a code", one.path)
        new = in_transaction(functools.partial(_insert, chunk, chosen))
        out.new += new
        out.known += len(chunk) - new
    return out


def _chunks(recordings: Iterable[Recording]) -> Iterator[list[Recording]]:
    rest = iter(recordings)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk


def _insert(chunk: list[Recording], chosen: dict[str, str]) -> int:
    here = [{"video_sha256": r.sha256} for r in chunk]
    owned = video.Video * session.Session.proj("subject", "session_label") & here
    known = {row["video_sha256"]: row for row in owned.proj("video_sha256", "subject", "session_label").to_dicts()}
    for r in chunk:
        if r.sha256 in known:
            check_owner(known[r.sha256], r.subject, r.session_label, r.path)
    new = {r.sha256: r for r in chunk if r.sha256 not in known}
    if not new:
        return 0
    now = utc_now()
    subjects = (
        {"subject": s, "population": "unknown", "subject_created": now} for s in {r.subject for r in new.values()}
    )
    lab.Subject.insert(subjects, skip_duplicates=True)
    sessions = _sessions({(r.subject, r.session_label) for r in new.values()}, now)
    first = next_id(video.Video, "video_id", len(new))
    rows: list[dict[str, Any]] = [
        video_row(
            first + i, sessions[r.subject, r.session_label], r.path, r.sha256, r.size, r.activity, r.camera_motion
        )
        for i, r in enumerate(new.values())
    ]
    video.Video.insert(rows)
    for table, selected in selections([r["video_id"] for r in rows], [*set(sessions.values())], chosen, METHOD_FIELDS):
        table.insert(selected, skip_duplicates=True)  # a session may have its plans already
    return len(rows)


def _sessions(wanted: set[tuple[str, str]], now: datetime.datetime) -> dict[tuple[str, str], int]:
    """session_id of each (subject, label); those that are missing are made."""
    asked = [{"subject": s, "session_label": label} for s, label in wanted]
    found = {(r["subject"], r["session_label"]): int(r["session_id"]) for r in (session.Session & asked).to_dicts()}
    missing = sorted(wanted - set(found))
    first = next_id(session.Session, "session_id", len(missing))
    session.Session.insert(
        {
            "session_id": first + i,
            "subject": subject,
            "session_label": label,
            "session_date": day_of(label),
            "session_created": now,
        }
        for i, (subject, label) in enumerate(missing)
    )
    return found | {pair: first + i for i, pair in enumerate(missing)}
