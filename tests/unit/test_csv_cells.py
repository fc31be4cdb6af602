"""What a spreadsheet would compute is written as a text; numbers stay numbers."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.csv_cells import frame_to_csv, quoted, unquoted, unquoted_frame
from pbl_pipeline.export.columns import Column, Labels, Table, write_csv
from tests.command import pbl

FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\uff1d1+1", "'=1", "''-x"]
PLAIN = ["P001", "", "-", "-5", "+1.5e3", "a=1", "'quoted'", "'-5", "3_months", "\u2212 5"]


@pytest.mark.parametrize("text", FORMULAS)
def test_formulas_are_texts(text: str):
    assert quoted(text) == f"'{text}"
    assert unquoted(quoted(text)) == text


@pytest.mark.parametrize("text", PLAIN)
def test_other_texts_and_numbers_stay(text: str):
    assert quoted(text) == text
    assert unquoted(text) == text


def test_a_table_as_csv():
    frame = pd.DataFrame(
        {
            "=A1": ["=1+1", "plain", None],
            "n": [-1.5, np.nan, 2.0],
            "i": [-1, 0, 1],
            "kind": pd.Categorical(["@x", "y", "@x"]),
            "mixed": pd.Series([-1, "=2", True], dtype=object),
            "day": pd.to_datetime(["2026-01-01", None, "2026-01-03"]),
        }
    )
    text = frame_to_csv(frame, "%.8g")
    assert text == (
        "'=A1,n,i,kind,mixed,day\n'=1+1,-1.5,-1,'@x,-1,2026-01-01\nplain,,0,y,'=2,\n,2,1,'@x,True,2026-01-03\n"
    )
    back = unquoted_frame(pd.read_csv(io.StringIO(text)))
    assert list(back["=A1"])[:2] == ["=1+1", "plain"]
    assert list(back["kind"]) == ["@x", "y", "@x"]
    assert list(back["n"])[::2] == [-1.5, 2.0]


def test_tables_of_a_visit(tmp_path: Path):
    trial, values = Column("trial", Labels.of(["=cmd,x", "walk"]), "", ""), Column("v", np.array([-1.5, 2.0]), "", "")
    write_csv(Table("t", (trial, values)), tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="") as file:
        (_, first, second) = csv.reader(file)
    assert (first[0], float(first[1]), second[0]) == ("'=cmd,x", -1.5, "walk")


def test_no_table_is_written_past_it():
    """Every CSV file with texts from outside goes through `csv_cells`; events have none."""
    root = Path(__file__).parents[2]
    allowed = {
        "pbl_pipeline/csv_cells.py",
        "pbl_pipeline/gait/events/types.py",
        "pbl_pipeline/export/keypoints_csv.py",
    }
    found = {
        str(path.relative_to(root))
        for package in ("pbl_pipeline", "schemas", "workers")
        for path in (root / package).rglob("*.py")
        if any(way in path.read_text("utf-8") for way in (".to_csv(", "csv.writer(", "DictWriter(", ".to_excel("))
    }
    assert found == allowed


def test_a_name_that_does_not_show_what_it_is_is_refused(tmp_path: Path):
    from pbl_pipeline.errors import PblError
    from pbl_pipeline.names import check_label

    for name in ("a\u202eb", "\u2066a", "a\u200bb", "\ufeffa", "a\u00adb", "a\x7fb", "a\nb", "\u3164", "\u2800"):
        with pytest.raises(PblError, match="USAGE"):
            check_label("session", name, 64)
    for name in ("M\u00fcller", "\u4e2d\u6587", "a b-c.d", "e\u0301", "\U0001f6b6"):
        check_label("session", name, 64)
    (tmp_path / "walk\u202e4pm.mp4").write_bytes(b"x")
    assert pbl("run", tmp_path / "walk\u202e4pm.mp4", "--out", tmp_path / "out").error_code == "USAGE"
