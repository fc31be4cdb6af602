"""Sheets of a study as rows of texts: CSV, and XLSX without anything that hides a value."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import datetime
import io
import math
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pbl_pipeline.bounded import MAX_ROWS, MIB, opened_zip, read_bytes
from pbl_pipeline.errors import PblError

#: Bytes of a sheet, and of all parts of a workbook unpacked.
_MAX_BYTES, _MAX_UNPACKED = 32 * MIB, 128 * MIB


@dataclasses.dataclass(frozen=True)
class Row:
    """A row: where it stands, for errors, and its cells that are not empty, by column."""

    where: str
    cells: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Sheet:
    """name: of the file, and of the sheet in a workbook of several. columns: as the header has them."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]


def read_sheets(path: Path) -> list[Sheet]:
    """The sheets of a CSV file (UTF-8; a comma, semicolon or tab between columns) or a workbook (.xlsx), empty ones
    left out. A date cell is YYYY-MM-DD, a number its shortest text.

    Raises
    ------
    PblError
        FILE_MISSING; SHEET_FORMAT: no header, a column twice or without a name, cells beside the header's columns,
        merged cells, formulas, error values, no such file format.
    """
    if not path.is_file():
        raise PblError(
            "FILE_MISSING",
            found="no such file",
            expected="a sheet, .csv or .xlsx",
            next_step="check the path",
            key=path,
        )
    try:
        tables = _workbook(path) if path.suffix.lower() in (".xlsx", ".xlsm") else [(path.name, _csv(path))]
    except (ValueError, OSError, KeyError, zipfile.BadZipFile, csv.Error) as error:
        raise refused(str(path), f"{error}"[:200], "a sheet as CSV in UTF-8 or as .xlsx", "save it anew") from error
    found = [_sheet(name, list(cells)) for name, cells in tables]
    return [sheet for sheet in found if sheet is not None]


def refused(where: str, found: str, expected: str, next_step: str) -> PblError:
    """A `PblError` SHEET_FORMAT about a sheet or row."""
    return PblError("SHEET_FORMAT", found=found, expected=expected, next_step=next_step, key=where)


def needed(row: Row, column: str) -> str:
    """The cell of a row in a column. Raises `PblError` SHEET_FORMAT where it is empty."""
    if column not in row.cells:
        raise refused(row.where, f"no {column}", f"a value in the column {column}", "write it, or remove the row")
    return row.cells[column]


def date_of(row: Row, column: str) -> datetime.date:
    """The day in a cell. Raises `PblError` SHEET_FORMAT for what is not written YYYY-MM-DD."""
    text = row.cells[column]
    if re.fullmatch(r"\d{4}-\d\d-\d\d", text):
        with contextlib.suppress(ValueError):
            return datetime.date.fromisoformat(text)
    raise refused(
        row.where,
        f"{column} {text!r}",
        "a day as YYYY-MM-DD, such as 2026-03-09, or a date cell of a workbook",
        "write it so: 03/09 is another day in other countries",
    )


def number_of(row: Row, column: str, text: str) -> float:
    """The number that `text`, the cell of a row in a column, is. Raises `PblError` SHEET_FORMAT for what is none."""
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(text)) and "_" not in text:
            return value
    raise refused(row.where, f"{column} {text!r}", "a number with a decimal point", "correct it, or leave it empty")


def _csv(path: Path) -> list[list[str]]:
    text = read_bytes(path, _MAX_BYTES).decode("utf-8-sig")
    if text.count("\n") > MAX_ROWS:
        raise ValueError(f"more than {MAX_ROWS:,} rows")
    first = text.split("\n", 1)[0]
    between = max(",;\t", key=first.count)
    return list(csv.reader(io.StringIO(text), delimiter=between, strict=True))


def _workbook(path: Path) -> list[tuple[str, list[list[str]]]]:
    from openpyxl import load_workbook
    from openpyxl.utils.exceptions import InvalidFileException

    data = read_bytes(path, _MAX_BYTES)
    with opened_zip(path) as archive:
        if sum(m.file_size for m in archive.infolist()) > _MAX_UNPACKED:
            raise ValueError(f"more than {_MAX_UNPACKED // MIB} MiB unpacked")
    try:
        book = load_workbook(io.BytesIO(data))
    except InvalidFileException as error:
        raise ValueError(str(error)) from error
    sheets = book.worksheets
    several = sum(s.max_row > 1 or s.cell(1, 1).value is not None for s in sheets) > 1
    return [(f"{path.name}, sheet {s.title}" if several else path.name, list(_cells(s, path))) for s in sheets]


def _cells(sheet: Any, path: Path) -> Iterator[list[str]]:
    where = f"{path.name}, sheet {sheet.title}"
    if merged := [str(m) for m in sheet.merged_cells.ranges]:
        raise refused(
            where,
            f"merged cells {', '.join(merged[:5])}",
            "one value in one cell",
            "unmerge them and repeat the value in every row it is meant for",
        )
    if sheet.max_row > MAX_ROWS:
        raise ValueError(f"more than {MAX_ROWS:,} rows")
    for row in sheet.iter_rows():
        for cell in row:
            if cell.data_type in ("f", "e"):
                what = "a formula" if cell.data_type == "f" else f"the error {cell.value}"
                raise refused(
                    f"{where}, cell {cell.coordinate}",
                    what,
                    "a value",
                    "copy the column and paste it as values, so that what is imported is what you see",
                )
        yield [_text(cell.value) for cell in row]


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime.datetime) and value.time() == datetime.time():
        return value.date().isoformat()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return value.isoformat() if isinstance(value, datetime.date) else str(value)


def _sheet(name: str, lines: list[list[str]]) -> Sheet | None:
    numbered = [(i, [c.strip() for c in line]) for i, line in enumerate(lines, 1)]
    numbered = [(i, line) for i, line in numbered if any(line)]
    if not numbered:
        return None
    _, header = numbered[0]
    while header and not header[-1]:
        header = header[:-1]
    twice = sorted({c for c in header if header.count(c) > 1})
    if twice:
        what = "a column without a name" if not twice[0] else f"column {twice[0]!r} twice"
        raise refused(name, what, "a header row that names each column once", "name the columns")
    if "" in header:
        raise refused(name, "a column without a name", "a header row that names each column once", "name the columns")
    rows = []
    for number, line in numbered[1:]:
        where = f"{name}, row {number}"
        if any(line[len(header) :]):
            found = f"{len(line)} cells under {len(header)} columns"
            raise refused(where, found, "no cell beside the columns", "remove them, or quote a text with commas")
        rows.append(Row(where, {c: v for c, v in zip(header, line, strict=False) if v}))
    return Sheet(name, tuple(header), tuple(rows))
