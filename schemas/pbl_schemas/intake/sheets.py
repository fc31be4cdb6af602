"""Sheets as rows of text (CSV, and XLSX without hidden values), and the outcome of each row."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import datetime
import functools
import io
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.bounded import MAX_TEXT, count_cells, count_rows, read_bytes
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.limited import LimitExceeded, limited
from pbl_pipeline.workbook import READ_BYTES, READ_S, read_workbook

from ..subject_codes import day_of, folded, iso_label

#: A `PblError` SHEET_CONFLICT about rows that cannot all be true.
conflict = functools.partial(PblError, "SHEET_CONFLICT")

#: A `PblError` SHEET_FORMAT about a sheet or row.
refused = functools.partial(PblError, "SHEET_FORMAT")


@dataclasses.dataclass(frozen=True)
class Row:
    where: str  # for errors
    cells: dict[str, str]  # those that are not empty, by column
    error: PblError | None = None  # of the row as a whole


@dataclasses.dataclass(frozen=True)
class Sheet:
    """name: of the file, and of the sheet in a workbook of several. columns: as the header has them."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]

    def plain_names(self) -> dict[str, str]:
        """Return the name of each column in lower case, with underscores for spaces."""
        return {column: column.lower().replace(" ", "_") for column in self.columns}


@dataclasses.dataclass
class Line:
    """The outcome for a row of a sheet."""

    where: str
    changes: list[str] = dataclasses.field(default_factory=list)  # in words; none: it is stored already
    errors: list[PblError] = dataclasses.field(default_factory=list)  # why it is refused
    doubts: list[str] = dataclasses.field(default_factory=list)  # in words; the row is not refused for them
    kept: str = ""  # what is stored already, in words

    @contextlib.contextmanager
    def about(self) -> Iterator[Line]:
        """Record an error of the block as one of this row; its key begins with the row."""
        try:
            yield self
        except PblError as error:
            key = str(error.key if error.key is not None else self.where)
            key = key if key.startswith(self.where) else f"{self.where}: {key}"
            self.errors.append(error.with_key(key))


@dataclasses.dataclass(frozen=True)
class Imported:
    """The outcome for every row of the sheets."""

    lines: list[Line]
    done: bool  # whether the changes were made, which is when no row is refused and it is not a dry run

    @property
    def errors(self) -> list[PblError]:
        """Errors of all rows."""
        return [e for line in self.lines for e in line.errors]


def read_sheets(path: Path) -> list[Sheet]:
    """The sheets of a CSV file (UTF-8; a comma, semicolon or tab between columns) or a workbook (.xlsx), empty ones
    left out. A date cell is YYYY-MM-DD, a number its shortest text.

    Raises `PblError` FILE_MISSING; SHEET_FORMAT: no header, a column twice or without a name, merged cells, formulas,
    error values, no such file format. Cells beside the header's columns are an error of their row.
    """
    if not path.is_file():
        raise PblError("FILE_MISSING", "no such file", "a sheet, .csv or .xlsx", "check the path", key=path)
    try:
        tables = _workbook(path) if path.suffix.lower() in (".xlsx", ".xlsm") else [(path.name, _csv(path))]
    except (ValueError, OSError, csv.Error) as error:
        raise refused(f"{error}"[:200], "a sheet as CSV in UTF-8 or as .xlsx", "save it anew", path) from error
    found = [_sheet(name, list(cells)) for name, cells in tables]
    return [sheet for sheet in found if sheet is not None]


def check_same(first: Any, value: Any, what: str, whose: str, expected: str = "one value") -> None:
    """Raise `PblError` SHEET_CONFLICT unless a value is the one that was stated first."""
    if first != value:
        raise conflict(f"{what} {first} and {value} of {whose}", expected, "correct the row that is wrong")


def similar_codes(stated: Iterable[str], registered: Iterable[str]) -> dict[str, list[str]]:
    """Return the stated codes of people that differ from others only in case, zeros or hyphens, with those others;
    codes that are all registered are different people."""
    stated, registered = set(stated), set(registered)
    alike: dict[str, set[str]] = defaultdict(set)
    for code in stated | registered:
        alike[folded(code)].add(code)
    found = {code: alike[folded(code)] for code in stated}
    return {code: sorted(same - {code}) for code, same in found.items() if len(same) > 1 and not same <= registered}


def needed(row: Row, column: str) -> str:
    """The cell of a row in a column. Raises `PblError` SHEET_FORMAT if it is empty."""
    if column not in row.cells:
        raise refused(f"no {column}", f"a value in the column {column}", "write it, or remove the row", row.where)
    return row.cells[column]


def date_of(row: Row, column: str) -> datetime.date:
    """The day in a cell. Raises `PblError` SHEET_FORMAT for what is written neither YYYY-MM-DD nor D.M.YYYY."""
    text = iso_label(row.cells[column])
    if re.fullmatch(r"\d{4}-\d\d-\d\d", text) and (day := day_of(text)) is not None:
        return day
    raise refused(
        f"{column} {row.cells[column]!r}",
        "a day as YYYY-MM-DD, such as 2026-03-09, or as 9.3.2026, or a date cell of a workbook",
        "write it so: 03/09 is another day in other countries",
        row.where,
    )


def number_of(row: Row, column: str, text: str) -> float:
    """The number that `text`, the cell of a row in a column, is. Raises `PblError` SHEET_FORMAT for what is none."""
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(with_point(text))) and "_" not in text:
            return value
    expected = "a number with a decimal point, or with a comma that cannot divide thousands"
    raise refused(f"{column} {text!r}", expected, "correct it, or leave it empty", row.where)


def with_point(text: str) -> str:
    """Return a number with a decimal comma with a point; as it is where the comma could divide thousands (1,234)."""
    decimal = re.fullmatch(r"[+-]?\d+,\d+", text) and not re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", text)
    return text.replace(",", ".") if decimal else text


def write_template(path: Path, columns: Sequence[str]) -> None:
    """Write an empty sheet (.csv or .xlsx) with these columns. Raises `PblError` FILE_UNWRITABLE, also for a file that
    exists."""
    expected = "a file, .csv or .xlsx, that does not exist yet"
    with os_errors_as("FILE_UNWRITABLE", expected, "pass another path", path), path.open("xb") as out:
        if path.suffix.lower() == ".xlsx":
            from openpyxl import Workbook

            book = Workbook()
            book.worksheets[0].append(list(columns))
            book.save(out)
        else:
            import pandas as pd

            out.write(frame_to_csv(pd.DataFrame(columns=list(columns))).encode())


def _csv(path: Path) -> list[list[str]]:
    text = read_bytes(path, MAX_TEXT).decode("utf-8-sig")
    first = text.split("\n", 1)[0]
    between = max(",;\t", key=first.count)
    n_rows = text.count("\n")
    count_rows(n_rows)
    count_cells(n_rows + text.count(between), first.count(between))
    return list(csv.reader(io.StringIO(text), delimiter=between, strict=True))


def _workbook(path: Path) -> list[tuple[str, list[list[str]]]]:
    """Raises ValueError, OSError, and the `PblError` of a workbook that hides values."""
    try:
        sheets = limited(read_workbook, path, seconds=READ_S, n_bytes=READ_BYTES, returns=True)
    except LimitExceeded as error:
        raise ValueError(f"a workbook that takes too much to read: {error}") from error
    several = sum(bool(rows) for _, rows in sheets) > 1
    return [(f"{path.name}, sheet {title}" if several else path.name, rows) for title, rows in sheets]


def _sheet(name: str, lines: list[list[str]]) -> Sheet | None:
    numbered = [(i, [c.strip() for c in line]) for i, line in enumerate(lines, 1)]
    numbered = [(i, line) for i, line in numbered if any(line)]
    if not numbered:
        return None
    _, header = numbered[0]
    while header and not header[-1]:
        header = header[:-1]
    if wrong := sorted(c for c, n in Counter(header).items() if not c or n > 1):
        what = f"column {wrong[0]!r} twice" if wrong[0] else "a column without a name"
        raise refused(what, "a header row that names each column once", "name the columns", name)
    rows = []
    for number, line in numbered[1:]:
        where = f"{name}, row {number}"
        error = None
        if any(line[len(header) :]):
            found = f"{len(line)} cells under {len(header)} columns"
            error = refused(found, "no cell beside the columns", "remove them, or quote a text with commas", where)
        rows.append(Row(where, {c: v for c, v in zip(header, line, strict=False) if v}, error))
    return Sheet(name, tuple(header), tuple(rows))
