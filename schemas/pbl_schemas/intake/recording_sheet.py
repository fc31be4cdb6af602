"""Videos of many people and visits from one sheet (`pbl ingest --sheet`, docs/files.md)."""

from __future__ import annotations

import contextlib
import datetime
import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pbl_pipeline import temporary
from pbl_pipeline.depth import DepthFile
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import normalised_label, whole_number
from pbl_pipeline.progress import track
from pbl_pipeline.sensors import Given, given_sensors, named, read_samples
from pbl_pipeline.video import recorded_utc

from .. import lab, session
from ..rows import rows_inside
from ..subject_codes import day_of
from ..video import CAMERA_MOTIONS
from .records import Methods, VisitRecord
from .registration import check_owner, insert_new, read_together, registered, resolve
from .sensors import NONE, Sensors
from .sheets import (
    Imported,
    Line,
    Row,
    check_same,
    conflict,
    date_of,
    needed,
    number_of,
    read_sheets,
    refused,
    similar_codes,
)
from .videos import OneCamera

#: Columns that must have a value, and those that may.
NEEDED = ("file", "subject", "visit")
COLUMNS = (
    *NEEDED,
    *("date", "pace", "activity", "camera", "camera_motion", "attitude", "person", "population", "height_m", "project"),
    *("mass_kg", "depth", "imu"),
)
#: Columns that name files.
_FILES = ("file", "camera", "attitude", "depth", "imu")
_ONE_VISIT = "one value; two visits need two labels"
#: Copies of folders stay until their rows are inserted while so much room is left (bytes); else they are made again.
_KEPT_FREE = 10 * 10**9


def ingest_sheet(sheet: Path, methods: Methods | None = None, dry_run: bool = False) -> Imported:
    """Register the videos of a sheet in one transaction, a row for each: all of them, or none if a row is refused.

    Paths are relative to the sheet's folder. A video that is registered already for the same visit is left as it is.
    Every file is read, also in a dry run.

    Raises `PblError` FILE_MISSING, SHEET_FORMAT: a sheet that cannot be read, unknown columns, no rows; SOLVER_UNKNOWN,
    NORM_UNKNOWN. What is wrong with a row is in the result.
    """
    with contextlib.ExitStack() as copies:
        return _ingest(sheet, methods, dry_run, copies)


def _ingest(sheet: Path, methods: Methods | None, dry_run: bool, copies: contextlib.ExitStack) -> Imported:
    rows = _rows(sheet)
    chosen = resolve(methods or Methods())
    lines = [Line(row.where) for row in rows]
    visits = [_visit(row, line, sheet.absolute().parent) for row, line in zip(rows, lines, strict=True)]
    _check_people(visits, lines)
    new: list[tuple[Row, Line, OneCamera]] = []
    seen: dict[str, str] = {}
    worn: dict[tuple[str, str], tuple[set[Given], str]] = {}
    for row, line, visit in track(list(zip(rows, lines, visits, strict=True)), "reading", unit="file"):
        if "file" not in row.cells:
            continue
        with line.about():  # the file also of a row that is refused: all errors are found together
            one = _recording(row, visit or _blank(row, sheet.absolute().parent), sheet.absolute().parent)
            one.read()
            copies.callback(one.sensors.remove_copies)
            if dry_run or temporary.free_bytes() < _KEPT_FREE:
                one.sensors.remove_copies()  # those of all rows need not fit on the disk
            sha256, file = one.files[0].sha256, row.cells["file"]
            if (first := seen.setdefault(sha256, row.where)) != row.where:
                with line.about():
                    raise conflict(f"the same bytes as in {first}", "each recording once", "remove one of the rows")
            if visit is None or line.errors:
                one.complete(chosen)
                read_together(one, {})
                continue
            _check_day(one, line)
            if one.sensors.imu:
                key, text = (visit.subject, visit.session_label), row.cells["imu"]
                stated = {replace(given, file=given.file.resolve()) for given in one.sensors.imu}
                before, other = worn.setdefault(key, (stated, text))
                if before != stated:
                    check_same(other, text, "imu", ", ".join(key), "one list of all its sensors")
            if known := registered(one.files):
                _check_place(one, known)
                line.kept = f"{file}: video_id {known[sha256]['video_id']}: registered already, left as it is"
                line.kept += ", without the sensor files of this row: pbl ingest FILE --imu ..." if one.sensors else ""
            else:
                one.complete(chosen)
                read_together(one, {})
                new.append((row, line, one))
                line.changes = [f"{file}: new: {visit.subject}/{visit.session_label}"]
    done = not dry_run and not any(line.errors for line in lines)
    if done and new:
        made = insert_new([one for *_, one in new], chosen)
        for (row, line, _), result in zip(new, made, strict=True):
            line.changes = [f"{row.cells['file']}: video_id {result.video_id}: registered ({result.note})"]
    return Imported(lines, done)


def _rows(path: Path) -> list[Row]:
    """The rows of a sheet with the names of the columns as `COLUMNS` has them."""
    rows = []
    for sheet in read_sheets(path):
        names = sheet.plain_names()
        unknown = [c for c, name in names.items() if name not in COLUMNS]
        if unknown or set(NEEDED) - set(names.values()) or len(set(names.values())) < len(names):
            raise refused(
                f"unknown column {', '.join(map(repr, unknown[:5]))}" if unknown else f"the columns {list(names)}",
                f"{', '.join(NEEDED)}, and any of {', '.join(COLUMNS[len(NEEDED) :])}",
                "rename or remove columns; clinical scores and roles of visits go into a sheet of `pbl study import`",
                sheet.name,
            )
        rows += [replace(row, cells={names[c]: text for c, text in row.cells.items()}) for row in sheet.rows]
    if not rows:
        raise refused("no rows", "a row for each video", "write them below the header", path)
    return rows


def _visit(row: Row, line: Line, folder: Path) -> VisitRecord | None:
    """Return the visit that a row states; None if it is refused, with an error for each cell that is wrong."""
    if row.error is not None:
        line.errors.append(row.error)
        return None
    visit = _blank(row, folder)
    for column in dict.fromkeys((*NEEDED, *row.cells)):
        with line.about():
            text = needed(row, column)
            if column not in _FILES:
                field = "session_label" if column == "visit" else column
                replace(_blank(row, folder), **{field: (value := _value(row, column, text))}).check()
                visit = replace(visit, **{field: value})
    if line.errors:
        return None
    with line.about():
        day = day_of(visit.session_label)
        if visit.date is not None and day not in (None, visit.date):
            found = f"date {visit.date} of the visit {visit.session_label}"
            raise conflict(found, f"{day}, which its label says", "correct one of them")
        return visit
    return None


def _blank(row: Row, folder: Path) -> VisitRecord:
    """A placeholder visit with the calibration that a row names."""
    return VisitRecord("X", camera_file=folder / row.cells["camera"] if "camera" in row.cells else None)


def _value(row: Row, column: str, text: str) -> Any:
    """Return the value of a cell. Raises `PblError` SHEET_FORMAT."""
    if column == "camera_motion" and text not in CAMERA_MOTIONS:
        raise refused(f"camera_motion {text!r}", f"one of {', '.join(CAMERA_MOTIONS)}", "correct it", row.where)
    if column == "person":
        if not 1 <= (number := whole_number(text) or 0) < 1000:
            raise refused(f"person {text!r}", "the number of a person, from 1", "correct it", row.where)
        return number
    if column in ("height_m", "mass_kg"):
        return number_of(row, column, text)
    return date_of(row, column) if column == "date" else text


def _check_day(one: OneCamera, line: Line) -> None:
    """Note a doubt where the file was recorded on another day than its visit, in every time zone."""
    visit = one.visit
    day = visit.date or day_of(visit.session_label)
    try:
        said = recorded_utc(one.files[0].path) if day else None
    except PblError:  # errors of the video appear in the table of the stage that reads it
        return
    if day and said:
        at = datetime.datetime.fromisoformat(said)
        if not (at - datetime.timedelta(hours=12)).date() <= day <= (at + datetime.timedelta(hours=14)).date():
            line.doubts.append(f"{one.files[0].path.name} says that it was recorded on {at.date()}, its visit is {day}")


def _check_people(visits: Sequence[VisitRecord | None], lines: Sequence[Line]) -> None:
    """Refuse rows that cannot all be true: one label for two days, one person in two groups or under two codes."""
    codes = {visit.subject for visit in visits if visit is not None}
    stored = rows_inside(session.Session(), "subject", codes)
    dates = {key: r["session_date"] for key, r in session.by_label(stored).items()}
    similar = similar_codes(codes, map(str, lab.Subject().to_arrays("subject")))
    first: dict[tuple[str, ...], object] = {}
    for visit, line in zip(visits, lines, strict=True):
        if visit is None:
            continue
        key, whose = (visit.subject, visit.session_label), f"{visit.subject}, {visit.session_label}"
        if others := similar.get(visit.subject):
            with line.about():
                raise conflict(
                    f"the codes {visit.subject} and {', '.join(others)}",
                    "one code for one person, or codes that differ by more than case, zeros and hyphens",
                    "write the same code",
                )
        if visit.date is not None and dates.get(key) not in (None, visit.date):
            with line.about():
                raise conflict(
                    f"date {visit.date} of {whose}, registered with {dates[key]}",
                    "one day for one visit",
                    "two visits need two labels; a wrong day is corrected by `pbl study import`",
                )
        for what in ("date", "population", "project", "height_m", "mass_kg"):
            value = getattr(visit, what)
            if value is not None:
                of = (*key, what) if what in ("date", "mass_kg") else (visit.subject, what)
                with line.about():
                    check_same(first.setdefault(of, value), value, what, whose, _ONE_VISIT)


def _recording(row: Row, visit: VisitRecord, folder: Path) -> OneCamera:
    """Return the record of a row. Raises what `given_sensors` and `named` raise."""
    log, depth, imu = ("" if (text := row.cells.get(k, "")) == NONE else text for k in ("attitude", "depth", "imu"))
    read = functools.cache(read_samples)
    worn = [sensor for one in given_sensors(imu, folder) for sensor in named(one, read)] if imu else ()
    sensors = Sensors(folder / log if log else None, DepthFile.of(depth, folder) if depth else None, worn, read)
    return OneCamera(folder / row.cells["file"], visit, sensors)


def _check_place(one: OneCamera, known: Mapping[str, Mapping]) -> None:
    """Raise `PblError` where a video is registered for another person or visit."""
    check_owner(one, known)
    row, visit = known[one.files[0].sha256], one.visit
    if normalised_label(row["session_label"]) != visit.session_label:
        raise conflict(
            f"video_id {row['video_id']} of visit {row['session_label']} has these bytes",
            f"a recording of visit {visit.session_label}",
            f"correct the row, or: pbl move {row['video_id']} --to {visit.subject}/{visit.session_label}",
        )
