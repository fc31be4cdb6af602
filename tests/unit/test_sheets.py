"""Sheets that ask for much or are no sheet: refused with a code, in little memory and time."""

import contextlib
import datetime
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from openpyxl import Workbook

from pbl_pipeline import name_pattern
from pbl_pipeline.errors import PblError
from pbl_pipeline.workbook import read_workbook
from pbl_schemas.intake.sheets import read_sheets, write_template
from tests import Limits
from tests.guard import guarded

SHEET = "xl/worksheets/sheet1.xml"
HEAD = b'<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">'
DTD = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'


def book(path: Path) -> Path:
    made = Workbook()
    page = made.active
    assert page is not None
    page.append(["subject", "visit", "date", "mJOA", "TUG", "note"])
    page.append(["P001", "pre", datetime.date(2026, 1, 10), 12, 9.25, None])
    page.append([])
    page.append(["P002", "pre", datetime.datetime(2026, 1, 10, 9, 30), True, -3.0, "a < b"])
    page["H9"].number_format = "0.00"  # formatted and empty
    made.create_sheet("empty")
    made.save(path)
    return path


def with_part(path: Path, name: str, change: Callable[[bytes], bytes]) -> Path:
    """A workbook with a part changed."""
    with zipfile.ZipFile(book(path)) as archive:
        parts = {m.filename: archive.read(m) for m in archive.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, content in (parts | {name: change(parts.get(name, b""))}).items():
            archive.writestr(part, content)
    return path


def rows(begin: bytes, part: bytes = b"", times: int = 0, end: bytes = b"") -> Callable[[bytes], bytes]:
    """A sheet of these bytes, of which the long ones are made where they are wanted, not where tests are found."""
    return lambda _: HEAD + b"<sheetData>" + begin + part * times + end + b"</sheetData></worksheet>"


def check_rows(path: Path) -> None:
    """Raise the first error of the sheets in a file, also one of a row."""
    for error in [row.error for sheet in read_sheets(path) for row in sheet.rows if row.error]:
        raise error


def test_a_workbook_as_rows_of_texts(tmp_path: Path):
    (sheet,) = read_sheets(book(tmp_path / "a.xlsx"))
    assert (sheet.name, sheet.columns) == ("a.xlsx", ("subject", "visit", "date", "mJOA", "TUG", "note"))
    assert [(row.where, list(row.cells.values())) for row in sheet.rows] == [
        ("a.xlsx, row 2", ["P001", "pre", "2026-01-10", "12", "9.25"]),
        ("a.xlsx, row 4", ["P002", "pre", "2026-01-10T09:30:00", "yes", "-3", "a < b"]),
    ]


def test_a_cell_beyond_what_the_sheet_claims_of_its_size_is_read(tmp_path: Path):
    def claim(data: bytes) -> bytes:
        assert b'ref="A1:H9"' in data
        return data.replace(b'ref="A1:H9"', b'ref="A1:B2"')

    (sheet,) = read_sheets(with_part(tmp_path / "a.xlsx", SHEET, claim))
    assert (len(sheet.columns), len(sheet.rows)) == (6, 2)


WIDE = rows(b'<row r="1"><c r="A1"><v>1</v></c></row><row r="499999"><c r="XFD499999"><v>1</v></c></row>')
HOSTILE = {
    "a cell at the end": (SHEET, WIDE, "without a name|beside"),
    "a cell beyond the end": (SHEET, rows(b'<row r="1"><c r="ZZZZ1"><v>1</v></c></row>'), "columns|invalid|sense"),
    "a row beyond the end": (SHEET, rows(b'<row r="9999999999"><c r="A1"><v>1</v></c></row>'), "500,000 rows"),
    "wide rows": (
        SHEET,
        rows(b"".join(b'<row r="%d"><c r="XFD%d"/></row>' % (i, i) for i in range(1, 5000))),
        "2,000,000 cells",
    ),
    "three million cells in a row": (SHEET, rows(b'<row r="1">', b"<c/>           ", 3_000_000, b"</row>"), "cells"),
    "a text in every cell": (
        SHEET,
        rows(b"", b'<row><c t="inlineStr"><is><t>' + b"x" * 32_000 + b"</t></is></c></row>", 2000),
        "million letters",
    ),
    "cells out of order": (SHEET, rows(b'<row r="1"><c r="B1"><v>1</v></c><c r="A1"><v>2</v></c></row>'), "order"),
    "rows out of order": (SHEET, rows(b'<row r="2"><c><v>1</v></c></row><row r="1"><c><v>2</v></c></row>'), "order"),
    "a document type": (SHEET, lambda data: data.replace(HEAD, DTD + HEAD), "document type"),
    "a document type elsewhere": ("xl/styles.xml", lambda data: DTD + data, "document type"),
    "mismatched tags": (SHEET, lambda data: data.replace(b"</row>", b"</roe>", 1), "not well-formed"),
    "a part cut off": ("xl/workbook.xml", lambda data: data[: len(data) // 2], "not well-formed"),
    "an absent text": (SHEET, rows(b'<row><c t="s"><v>99</v></c></row>'), "makes no sense"),
    "no number": (SHEET, rows(b"<row><c><v>x</v></c></row>"), "makes no sense"),
    "many styles": (
        "xl/styles.xml",
        lambda d: d.replace(b"<cellXfs", b"<a/>" * 300_000 + b"<cellXfs"),
        "too many parts",
    ),
    "nested": (SHEET, rows(b"<row>" * 500 + b"</row>" * 500), "nested"),
    "not the sheet it names": (
        "xl/_rels/workbook.xml.rels",
        lambda d: d.replace(b"sheet1.xml", b"sheet1.bin"),
        "not in the file",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_workbooks(tmp_path: Path, what: str):
    part, change, words = HOSTILE[what]
    path = with_part(tmp_path / "a.xlsx", part, change)
    start = time.monotonic()
    with guarded() as peak, pytest.raises(PblError, match="SHEET_FORMAT") as error:
        check_rows(path)
    assert any(w in error.value.text() for w in words.split("|"))
    assert time.monotonic() - start < 90.0
    assert peak.grown_mib < 640
    with guarded() as peak, contextlib.suppress(PblError, ValueError):  # what its process takes
        read_workbook(path)
    assert peak.grown_mib < 768  # and 256 MiB of a process that has read nothing: a gibibyte, whatever ran here before


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a," * 1_000_000 + b"b\n", "16,384 columns"),
        (b"a\n" + b"," * 3_000_000, "2,000,000 cells"),
        (b"a\n" * 600_000, "500,000 rows"),
        (b"a,b\n" + b'"' * 1_000_001, ""),
        (b"," * 16_000 + b"x\n", "without a name"),
    ],
    ids=["columns", "cells", "rows", "quotes", "nameless columns"],
)
def test_hostile_csv(tmp_path: Path, content: bytes, words: str):
    (tmp_path / "a.csv").write_bytes(content)
    start = time.monotonic()
    with guarded() as peak, pytest.raises(PblError, match="SHEET_FORMAT") as error:
        read_sheets(tmp_path / "a.csv")
    assert words in error.value.found
    assert time.monotonic() - start < 20.0
    assert peak.grown_mib < 256


def test_the_largest_csv_takes_less_than_a_gibibyte(tmp_path: Path):
    names = ",".join(f"c{i}" for i in range(1000))
    line = ",".join(f"{i:04}" for i in range(1000))
    (tmp_path / "a.csv").write_text("\n".join([names, *[line] * 1990]))
    with guarded() as peak:
        (sheet,) = read_sheets(tmp_path / "a.csv")
    assert len(sheet.rows) == 1990
    assert peak.grown_mib < 768  # and 256 MiB of a process that has read nothing: a gibibyte, whatever ran here before


# ------------------------------------------------------------------------------------------------------ names of files
@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        pytest.param("(?P<subject>(a+)+)$", "takes too much", marks=pytest.mark.slow),
        ("(?P<subject>a{99999999999})", "overflow|too large"),
        ("(" * 5000 + ")" * 5000, "recursion|missing|nested|without named"),
    ],
    ids=["years", "repetitions", "nested"],
)
def test_a_pattern_that_takes_too_much(pattern: str, words: str, limits: Limits):
    limits(name_pattern, LONGEST_S=6.0)
    start = time.monotonic()
    with pytest.raises(PblError, match="USAGE") as error:
        name_pattern.read_names(pattern, [Path("a" * 60 + "!.mp4")])
    assert any(w in error.value.found for w in words.split("|"))
    assert time.monotonic() - start < 30.0


@pytest.mark.parametrize("name", ["a.csv", "a.xlsx"])
def test_a_template_has_the_columns_that_were_asked_for(tmp_path: Path, name: str):
    columns = ["subject", "TUG, fast", 'FAC "own"']
    write_template(tmp_path / name, columns)
    assert [*read_sheets(tmp_path / name)[0].columns] == columns
    with pytest.raises(PblError, match="FILE_UNWRITABLE"):
        write_template(tmp_path / name, columns)
