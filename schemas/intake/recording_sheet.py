"""Videos of many people and visits from one sheet: what `pbl ingest --sheet` does (docs/files.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.progress import track

from . import lab, session
from .codes import day_of, folded
from .ingest import (
    Methods,
    Prepared,
    Visit,
    check_owner,
    check_visit,
    in_transaction,
    insert,
    prepare,
    resolve,
    with_camera,
    with_sha256,
)
from .rows import inside
from .sensors import Sensors
from .sheets import Row, date_of, needed, number_of, read_sheets, refused
from .video import CAMERA_MOTIONS

#: Columns that must have a value, and those that may.
NEEDED = ("file", "subject", "visit")
COLUMNS = (
    *NEEDED,
    *("date", "pace", "activity", "camera", "camera_motion", "attitude", "person", "population", "height_m", "project"),
)


@dataclasses.dataclass
class Line:
    """A row of the sheet: the number of its video once it is registered, what became of it in words (or would), and why
    it is refused."""

    where: str
    file: str
    video_id: int | None = None
    note: str = ""
    errors: list[PblError] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True)
class Imported:
    """Every row of the sheet. done: whether the new videos were registered, which is when no row is refused."""

    lines: list[Line]
    done: bool


@dataclasses.dataclass(frozen=True)
class _New:
    """A row whose video is not registered yet."""

    line: Line
    video: Prepared
    date: datetime.date | None


def ingest_sheet(sheet: Path, methods: Methods | None = None, dry_run: bool = False) -> Imported:
    """Register the videos of a sheet in one transaction, a row for each: all of them, or none where a row is refused.

    Paths are relative to the sheet's folder. A video that is registered already for the same visit is left as it is.
    Every file is read, also in a dry run.

    Raises
    ------
    PblError
        FILE_MISSING, SHEET_FORMAT: a sheet that cannot be read, unknown columns, no rows; SOLVER_UNKNOWN, NORM_UNKNOWN.
        What is wrong with a row is in the result.
    """
    rows = _rows(sheet)
    chosen = resolve(methods or Methods())
    lines = [Line(row.where, row.cells.get("file", "")) for row in rows]
    visits: list[tuple[Visit, datetime.date | None] | None] = [
        _read(row, line, sheet.absolute().parent) for row, line in zip(rows, lines, strict=True)
    ]
    _check_people(visits, lines)
    new: list[_New] = []
    seen: dict[str, str] = {}
    for row, line, stated in track(list(zip(rows, lines, visits, strict=True)), "reading", unit="file"):
        if stated is None or line.errors:
            continue
        with _about(line):
            one = _prepared(row, stated[0], sheet.absolute().parent)
            if one.sha256 in seen:
                found = f"the same bytes as in {seen[one.sha256]}"
                raise _conflict(found, "each recording once", "remove one of the rows")
            seen[one.sha256] = line.where
            known = with_sha256(one.sha256)
            if known is None:
                new.append(_New(line, with_camera(one), stated[1]))
                line.note = f"new: {one.visit.subject}/{one.visit.session_label}"
            else:
                _check_place(known, one)
                line.video_id, line.note = int(known["video_id"]), "registered already, left as it is"
    done = not dry_run and not any(line.errors for line in lines)
    if done:
        made = in_transaction(lambda: [_insert(one, chosen) for one in new])
        for row, (number, note) in zip(new, made, strict=True):
            row.line.video_id, row.line.note = number, f"registered ({note})"
    return Imported(lines, done)


def _insert(one: _New, chosen: dict[str, str]) -> tuple[int, str]:
    result = insert(one.video, chosen)
    label = {"subject": one.video.visit.subject, "session_label": one.video.visit.session_label}
    if one.date is not None:
        number = (session.Session & label).fetch1("session_id")
        session.Session.update1({"session_id": number, "session_date": one.date})
    return int(result.video_id or 0), result.note


def _rows(path: Path) -> list[Row]:
    """The rows of a sheet with the names of the columns as `COLUMNS` has them."""
    sheets = read_sheets(path)
    rows = []
    for sheet in sheets:
        names = {c: c.lower().replace(" ", "_") for c in sheet.columns}
        unknown = [c for c, name in names.items() if name not in COLUMNS]
        missing = [name for name in NEEDED if name not in names.values()]
        if unknown or missing or len(set(names.values())) < len(names):
            found = f"unknown column {', '.join(map(repr, unknown[:5]))}" if unknown else f"the columns {list(names)}"
            expected = f"{', '.join(NEEDED)}, and any of {', '.join(COLUMNS[len(NEEDED) :])}"
            raise refused(
                sheet.name,
                found,
                expected,
                "rename or remove columns; clinical scores and roles of visits go into a sheet of `pbl study import`",
            )
        rows += [Row(row.where, {names[c]: text for c, text in row.cells.items()}) for row in sheet.rows]
    if not rows:
        raise refused(str(path), "no rows", "a row for each video", "write them below the header")
    return rows


@contextlib.contextmanager
def _about(line: Line) -> Iterator[None]:
    """An error in the block is one of the row."""
    try:
        yield
    except PblError as error:
        key = line.where if error.key in (None, line.where) else f"{line.where}: {error.key}"
        line.errors.append(
            PblError(error.code, found=error.found, expected=error.expected, next_step=error.next_step, key=key)
        )


def _read(row: Row, line: Line, folder: Path) -> tuple[Visit, datetime.date | None] | None:
    """What a row states of its visit, and the visit's day."""
    with _about(line):
        needed(row, "file")
        cells = row.cells
        motion, person = cells.get("camera_motion"), cells.get("person")
        if motion is not None and motion not in CAMERA_MOTIONS:
            raise refused(row.where, f"camera_motion {motion!r}", f"one of {', '.join(CAMERA_MOTIONS)}", "correct it")
        if person is not None and not (person.isdecimal() and 1 <= int(person) < 1000):
            raise refused(row.where, f"person {person!r}", "the number of a person, from 1", "correct it")
        visit = Visit(
            subject=needed(row, "subject"),
            session_label=needed(row, "visit"),
            project=cells.get("project"),
            camera_file=folder / cells["camera"] if "camera" in cells else None,
            camera_motion=motion,
            activity=cells.get("activity"),
            person=None if person is None else int(person),
            population=cells.get("population"),
            pace=cells.get("pace"),
            height_m=number_of(row, "height_m", cells["height_m"]) if "height_m" in cells else None,
        )
        check_visit(visit)
        date = date_of(row, "date") if "date" in cells else None
        day = day_of(visit.session_label)
        if date is not None and day is not None and date != day:
            found = f"date {date} of the visit {visit.session_label}"
            raise _conflict(found, f"{day}, which its label says", "correct one of them")
        return visit, date
    return None


def _check_people(visits: list[Any], lines: list[Line]) -> None:
    """Rows that cannot all be true: one label for two days, one person in two groups or under two codes."""
    codes = {visit.subject for visit, _ in filter(None, visits)}
    registered = {
        (r["subject"], r["session_label"]): r["session_date"]
        for r in (session.Session & inside("subject", codes)).to_dicts()
    }
    alike: dict[str, set[str]] = defaultdict(set)
    for code in {*codes, *lab.Subject().to_arrays("subject")}:
        alike[folded(code)].add(str(code))
    first: dict[tuple[str, ...], tuple[Any, str]] = {}
    for stated, line in zip(visits, lines, strict=True):
        if stated is None:
            continue
        visit, date = stated
        key, whose = (visit.subject, visit.session_label), f"{visit.subject}, {visit.session_label}"
        with _about(line):
            if others := sorted(alike[folded(visit.subject)] - {visit.subject}):
                raise _conflict(
                    f"the codes {visit.subject} and {', '.join(others)}",
                    "one code for one person, or codes that differ by more than case, zeros and hyphens",
                    "write the same code",
                )
            if date is not None and registered.get(key) not in (None, date):
                raise _conflict(
                    f"date {date} of {whose}, registered with {registered[key]}",
                    "one day for one visit",
                    "two visits need two labels; a wrong day is corrected by `pbl study import`",
                )
            for what, value, of in (
                ("date", date, (*key, "date")),
                ("population", visit.population, (visit.subject, "population")),
                ("project", visit.project, (visit.subject, "project")),
                ("height_m", visit.height_m, (visit.subject, "height_m")),
            ):
                if value is None:
                    continue
                before, where = first.setdefault(of, (value, line.where))
                if before != value:
                    raise _conflict(
                        f"{what} {value} of {whose}, but {before} in {where}",
                        "one value; two visits need two labels",
                        "correct the row that is wrong",
                    )


def _prepared(row: Row, visit: Visit, folder: Path) -> Prepared:
    log = row.cells.get("attitude")
    return prepare((folder / row.cells["file"]).absolute(), visit, Sensors(attitude=folder / log if log else None))


def _check_place(known: dict[str, Any], one: Prepared) -> None:
    visit = one.visit
    check_owner(known, visit.subject, visit.session_label, one.path)
    if known["session_label"] != visit.session_label:
        raise _conflict(
            f"video_id {known['video_id']} of visit {known['session_label']} has these bytes",
            f"a recording of visit {visit.session_label}",
            f"correct the row, or: pbl move {known['video_id']} --to {visit.subject}/{visit.session_label}",
        )


def _conflict(found: str, expected: str, next_step: str) -> PblError:
    return PblError("SHEET_CONFLICT", found=found, expected=expected, next_step=next_step)
