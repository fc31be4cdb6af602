"""Workbooks (.xlsx) as rows of texts; sheets that hide a value are refused.

A workbook of a few kilobytes can unpack to gigabytes, name a cell in the last row and column, or hold content that its
reader does not expect. It is measured first, then read as a stream; call `read_workbook` through `limited`, with
`READ_S` and `READ_BYTES`.
"""

from __future__ import annotations

import datetime
import functools
import io
import posixpath
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.parsers import expat

from pbl_pipeline.bounded import MAX_CELLS, MAX_TEXT, MIB, count_cells, count_rows, opened_zip, read_member
from pbl_pipeline.errors import PblError

#: Time (s, the start of the process included) and memory (bytes) to read one.
READ_S, READ_BYTES = 120.0, 768 * MIB
#: Bytes of all parts together, unpacked.
_MAX_UNPACKED = 128 * MIB
#: Elements of a part other than sheets and texts, and how deeply elements are nested.
_MAX_ELEMENTS, _MAX_DEPTH = 200_000, 32
_MAIN = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"
_hidden = functools.partial(PblError, "SHEET_FORMAT")


def read_workbook(path: Path) -> list[tuple[str, list[list[str]]]]:
    """Return title and rows of each sheet. A date is YYYY-MM-DD, a number its shortest text, an empty cell "".

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        Not a workbook, a damaged one, or one with too many rows, columns, cells or letters.
    PblError
        SHEET_FORMAT: merged cells, formulas, error values.
    """
    with opened_zip(path) as archive:
        members = archive.infolist()
        if sum(m.file_size for m in members) > _MAX_UNPACKED:
            raise ValueError(f"more than {_MAX_UNPACKED // MIB} MiB unpacked")
        # Only the measured parts are read: those of other names are left out.
        measured = io.BytesIO()
        parts = {}
        with zipfile.ZipFile(measured, "w") as copy:
            for member in members:
                if member.filename.endswith((".xml", ".rels")):
                    if member.filename in parts:
                        raise ValueError("two parts of one name")
                    content = bytes(read_member(archive, member, _MAX_UNPACKED))
                    parts[member.filename] = _Part(member.filename, content)
                    copy.writestr(member.filename, content)
    count_cells(sum(part.n_cells for part in parts.values()))
    try:
        return list(_sheets(measured, path, parts))
    except (PblError, MemoryError):
        raise
    except Exception as error:  # openpyxl raises anything for a damaged workbook
        raise ValueError(f"a workbook that makes no sense ({type(error).__name__}: {error})") from error


def _sheets(data: io.BytesIO, path: Path, parts: dict[str, _Part]) -> Iterator[tuple[str, list[list[str]]]]:
    from openpyxl import load_workbook

    room = _Room()
    book: Any = load_workbook(data, read_only=True)
    if len(book.worksheets) + len(book.chartsheets) != sum(part.n_sheets for part in parts.values()):
        raise ValueError("a sheet that is not in the file")
    for sheet in book.worksheets:
        where = f"{path.name}, sheet {sheet.title}"
        part = parts[posixpath.normpath(sheet._worksheet_path)]
        if part.merged:
            raise _hidden(
                f"merged cells {', '.join(part.merged[:5])}",
                "one value in one cell",
                "unmerge them and repeat the value in every row it is meant for",
                where,
            )
        yield sheet.title, list(_rows(sheet, where, part.n_cells, room))


def _rows(sheet: Any, where: str, n_cells: int, room: _Room) -> Iterator[list[str]]:
    """Yield the rows of a sheet with all cells of its part, without trailing rows that are only formatted."""
    from openpyxl.cell.read_only import ReadOnlyCell

    sheet.reset_dimensions()  # cells beyond the size that the sheet claims would be hidden
    empty = n_found = 0
    for row in sheet.iter_rows():
        cells = [_text(cell, where) for cell in row]
        n_found += sum(isinstance(cell, ReadOnlyCell) for cell in row)
        room.take(cells)
        if not any(cells):
            empty += 1
            continue
        for _ in range(empty):
            yield []
        empty = 0
        yield cells
    if n_found != n_cells:
        raise ValueError("cells that are out of order, or at one place")


class _Room:
    """Count of the rows, cells and letters of a workbook, which are bounded."""

    def __init__(self) -> None:
        self.rows = self.cells = self.letters = 0

    def take(self, row: list[str]) -> None:
        self.rows, self.cells = self.rows + 1, self.cells + len(row)
        self.letters += sum(map(len, row))
        count_rows(self.rows)
        count_cells(self.cells, len(row))
        if self.letters > MAX_TEXT:
            raise ValueError(f"more than {MAX_TEXT // MIB} million letters")


class _Part:
    """A part of a workbook, parsed once to check that it is well-formed, not large and without a document type.

    Attributes
    ----------
    n_sheets, n_cells, merged
        Sheets that a workbook names; cells of a sheet, also empty ones; ranges of merged cells.
    """

    def __init__(self, name: str, data: bytes) -> None:
        self.n_sheets, self.n_cells, self.merged = 0, 0, []
        self._name, self._open, self._n, self._most = name, [], 0, _MAX_ELEMENTS
        parser = expat.ParserCreate(namespace_separator="}")
        parser.StartDoctypeDeclHandler = self._refuse
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise ValueError(f"{name} is not well-formed XML: {error}") from error

    def _refuse(self, *_: object) -> None:
        raise ValueError(f"{self._name} declares a document type")

    def _start(self, element: str, attributes: dict[str, str]) -> None:
        name = f"{{{element}".removeprefix(_MAIN)
        if not self._open and name in ("worksheet", "sst"):
            self._most = 3 * MAX_CELLS  # of a cell: itself, its value, its text
        if name == "c" and self._open[-1:] == ["row"]:
            self.n_cells += 1
            count_cells(self.n_cells)
        elif name == "sheet" and self._open[-1:] == ["sheets"]:
            self.n_sheets += 1
        elif name == "mergeCell":
            self.merged.append(attributes.get("ref", "?")[:20])
        self._open.append(name)
        self._n += 1
        if self._n > self._most or len(self._open) > _MAX_DEPTH or len(self.merged) > _MAX_ELEMENTS:
            raise ValueError(f"{self._name} has too many parts, or they are nested too deeply")

    def _end(self, _: str) -> None:
        self._open.pop()


def _text(cell: Any, where: str) -> str:
    value = cell.value
    if value is None:
        return ""
    if cell.data_type in ("f", "e"):
        raise _hidden(
            "a formula" if cell.data_type == "f" else f"the error {value}",
            "a value",
            "copy the column and paste it as values, so that what is imported is what you see",
            f"{where}, cell {cell.coordinate}",
        )
    if isinstance(value, datetime.datetime) and value.time() == datetime.time():
        return value.date().isoformat()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return value.isoformat() if isinstance(value, datetime.date) else str(value)
