"""Sheets of a study: what is imported, what is refused, and that a second import changes nothing."""

import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from openpyxl import Workbook

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_schemas import lab, session, study, video
from pbl_schemas.intake import sheets
from pbl_schemas.studies import study_sheets
from tests.command import pbl
from tests.rows import everything_but_refreshes, register, remove_all

from . import chain

VISITS = """\
subject,visit,date,role,intervention,intervention_date,assistive_device,population,cohort,group,included,mJOA
P001,pre,2026-01-10,pre,surgery,2026-02-01,cane,patient,dcm,surgery,yes,11
P001,after,2026-03-15,6_weeks,surgery,2026-02-01,none,,dcm,,,13
C001,2026-01-11,,baseline,,,,healthy,dcm,control,yes,18
X001,,,,,,,,dcm,surgery,no,
"""
SCORES = "subject;visit;instrument;value\nP001;pre;10MWT_s;12.5\nP001;after;10MWT_s;10\n"


@pytest.fixture
def empty(database: Path) -> Iterator[None]:
    pbl_schemas.activate()
    yield
    remove_all()


def sheet(folder: Path, text: str, name: str = "visits.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8-sig")
    return path


def run(*paths: Path, **options: bool) -> sheets.Imported:
    return study_sheets.import_sheets(paths, **options)


def stored() -> dict[tuple[str, str], dict]:
    rows = (study.Visit * session.Session).to_dicts()
    return {(r["subject"], r["session_label"]): r for r in rows}


def test_a_study_from_two_sheets(empty: None, tmp_path: Path):
    paths = sheet(tmp_path, VISITS), sheet(tmp_path, SCORES, "scores.csv")
    before = everything_but_refreshes()
    dry = run(*paths, dry_run=True)
    assert everything_but_refreshes() == before
    done = run(*paths)
    assert (dry.done, done.done) == (False, True)
    assert [line.changes for line in dry.lines] == [line.changes for line in done.lines]
    assert done.lines[0].where == "visits.csv, row 2"
    assert done.lines[0].changes == [
        "new person P001",
        "new session pre of P001",
        "new visit pre of P001 (pre)",
        "new member P001 of cohort dcm",
        "mJOA 11",
    ]
    assert done.lines[3].changes == ["new person X001", "new member X001 of cohort dcm"]
    assert done.lines[4].changes == ["10MWT_s 12.5"]
    visit = stored()["P001", "after"]
    assert visit["visit_days"] == 42
    assert visit["session_date"] == datetime.date(2026, 3, 15)
    assert (visit["assistive_device"], visit["orthosis"], visit["visit_age"]) == ("none", "", None)
    assert stored()["C001", "2026-01-11"]["session_date"] == datetime.date(2026, 1, 11)
    members = {r["subject"]: (r["member_included"], r["member_group"]) for r in study.CohortMember().to_dicts()}
    assert members == {"P001": (1, "surgery"), "C001": (1, "control"), "X001": (0, "surgery")}
    assert len(study.ClinicalScore()) == 5
    assert (lab.Subject & {"subject": "C001"}).fetch1("population") == "healthy"
    # Again: nothing. Then one cell.
    rows = everything_but_refreshes()
    again = run(*paths)
    assert not any(line.changes for line in again.lines)
    assert everything_but_refreshes() == rows
    text = VISITS.replace("cane", "walker").replace(",13\n", ",-\n").replace(",surgery,no,", ",surgery,yes,")
    changed = run(sheet(tmp_path, text), paths[1])
    assert [line.changes for line in changed.lines if line.changes] == [
        ["assistive_device cane -> walker"],
        ["mJOA 13 -> nothing"],
        ["included no -> yes"],
    ]
    assert len(study.ClinicalScore()) == 4
    # An empty cell leaves what is stored.
    left = run(
        sheet(tmp_path, VISITS.replace("cane", "").replace(",13\n", ",\n").replace(",surgery,no,", ",surgery,,"))
    )
    assert not any(line.changes for line in left.lines)
    assert stored()["P001", "pre"]["assistive_device"] == "walker"


def test_height_and_mass_are_columns(empty: None, tmp_path: Path):
    head = "subject,visit,role,height_m,mass_kg\n"
    text = f"{head}P001,2026-01-10,pre,1.72,70.5\nP001,2026-05-10,3_months,1.72,68\n"
    assert run(sheet(tmp_path, text)).done

    def known() -> tuple[Any, list[float]]:
        masses = session.BodyMass().to_arrays("body_mass", order_by="session_id")
        return (lab.Subject & {"subject": "P001"}).fetch1("subject_height"), masses.tolist()

    assert known() == (1.72, [70.5, 68.0])
    assert not any(line.changes for line in run(sheet(tmp_path, text)).lines)
    changed = run(sheet(tmp_path, f"{head}P001,2026-01-10,pre,1.74,-\n"))
    assert [line.changes for line in changed.lines] == [["height 1.72 -> 1.74", "mass 70.5 -> nothing"]]
    assert known() == (1.74, [68.0])
    for row, code in (("P001,2026-01-10,pre,172,", "FIT_INPUT"), ("P001,2026-01-10,pre,,700", "FIT_INPUT"),
                      ("P001,2026-01-10,pre,1.7,\nP001,2026-05-10,3_months,1.8,", "SHEET_CONFLICT")):  # fmt: skip
        refused = run(sheet(tmp_path, f"{head}{row}\n"))
        assert not refused.done
        assert {e.code for line in refused.lines for e in line.errors} == {code}
    assert known() == (1.74, [68.0])


HEAD = "subject,visit,date,role,intervention_date,birth_date,record,mJOA\n"


@pytest.mark.parametrize(
    ("rows", "code", "words"),
    [
        ("P001,a,03/04/2026,pre,,,,\n", "SHEET_FORMAT", "YYYY-MM-DD"),
        ("P001,a,2026-02-30,pre,,,,\n", "SHEET_FORMAT", "YYYY-MM-DD"),
        ("P001,a,2026-01-01,pre,,2026-05-01,,\n", "SHEET_CONFLICT", "before the birth"),
        ("P001,a,1950-01-01,pre,,1960,,\n", "SHEET_CONFLICT", "before the birth"),
        ("P001,a,2026-01-01,pre,,,,19\n", "SCORE_RANGE", "at most 18"),
        ("P001,a,2026-01-01,pre,,,,12.5\n", "SCORE_RANGE", "a whole number"),
        ('P001,a,2026-01-01,pre,,,,"12,5"\n', "SCORE_RANGE", "a whole number"),
        ('P001,a,2026-01-01,pre,,,,"1,234"\n', "SHEET_FORMAT", "decimal point"),
        ("P001,a,9.13.2026,pre,,,,\n", "SHEET_FORMAT", "'9.13.2026'"),
        ("P001,a,9.3.26,pre,,,,\n", "SHEET_FORMAT", "YYYY-MM-DD"),
        ("P001,a,2026-01-01,pre,,,,12,5\n", "SHEET_FORMAT", "quote a text with commas"),
        ("P001,a,2026-01-01,pre,,,,\nP001,a,2026-01-01,pre,,,,\n", "SHEET_CONFLICT", "also in visits.csv, row 2"),
        ("P001,a,2026-05-01,pre,,,,\nP001,b,2026-01-01,6_weeks,,,,\n", "SHEET_CONFLICT", "order of their dates"),
        ("P001,a,2026-05-01,pre,2026-04-01,,,\n", "SHEET_CONFLICT", "before the intervention"),
        ("P001,a,2026-03-01,6_weeks,2026-04-01,,,\n", "SHEET_CONFLICT", "before the intervention"),
        ("P001,a,2026-01-01,pre,,,4711,\nP002,a,2026-01-01,pre,,,4711,\n", "SHEET_CONFLICT", "P001 and P002"),
        ("P001,a,2026-01-01,pre,,,,\np-1,a,2026-01-01,pre,,,,\n", "SHEET_CONFLICT", "--distinct-codes"),
        ("P001,2026-01-01,2026-01-02,pre,,,,\n", "SHEET_CONFLICT", "date of the visit"),
        ("P001,a,,Pre Op,,,,\n", "SHEET_FORMAT", "small letters"),
        ("P001,a,,,2026-01-01,,,\n", "SHEET_FORMAT", "no role"),
        ("Ann Smith,a,,pre,,,,\n", "USAGE", "pseudonymous"),
        (",a,,pre,,,,\n", "SHEET_FORMAT", "no subject"),
    ],
)
def test_a_row_that_is_refused_keeps_all_others_out(empty: None, tmp_path: Path, rows: str, code: str, words: str):
    found = run(sheet(tmp_path, HEAD + rows + "Q9,good,,pre,,,,\n"))
    assert not found.done
    assert {e.code for e in found.errors} == {code}
    assert any(words in e.text() for e in found.errors), found.errors[0].text()
    assert all("visits.csv, row " in str(e.key) for e in found.errors)
    assert not len(lab.Subject())


def test_what_is_registered_counts_as_well(empty: None, tmp_path: Path):
    assert run(sheet(tmp_path, HEAD + "P001,a,2026-05-01,pre,,1950-05-01,,\n")).done
    assert stored()["P001", "a"]["visit_age"] == 76.0
    late = run(sheet(tmp_path, HEAD + "P001,b,2026-01-01,6_weeks,,,,\n"))
    assert late.errors[0].code == "SHEET_CONFLICT"
    alike = HEAD + "P-001,b,2026-06-01,6_weeks,,,,\n"
    assert run(sheet(tmp_path, alike)).errors[0].code == "SHEET_CONFLICT"
    assert run(sheet(tmp_path, alike), distinct_codes=True).done
    text = str(everything_but_refreshes())
    assert "1950" not in text


def test_activity_and_pace_from_a_sheet(empty: None, tmp_path: Path):
    a, b = chain.small_video(tmp_path, "a"), chain.small_video(tmp_path, "b")
    first, second = register(a, b, session_label="pre")
    text = f"video,subject,visit,activity,pace\na.mp4,P001,pre,,fast\n{second},,,TUG,\n"
    done = run(sheet(tmp_path, text))
    assert done.done, done.errors
    assert [line.changes for line in done.lines] == [["pace unknown -> fast"], ["activity walking -> tug"]]
    assert {k: (c.activity, c.pace) for k, c in video.conditions(True).items()} == {
        first: ("walking", "fast"),
        second: ("tug", "unknown"),
    }
    assert not any(line.changes for line in run(sheet(tmp_path, text)).lines)
    assert run(sheet(tmp_path, "video,pace\nabsent.mp4,fast\n")).errors[0].code == "DB_NOT_FOUND"


def book(path: Path, change=None) -> Path:
    made = Workbook()
    page = made.active
    assert page is not None
    page.append(["subject", "visit", "date", "role", "mJOA"])
    page.append(["P001", "pre", datetime.date(2026, 1, 10), "pre", 12])
    if change is not None:
        change(made, page)
    made.save(path)
    return path


def test_a_workbook(empty: None, tmp_path: Path):
    def more(made: Workbook, _: object) -> None:
        scores = made.create_sheet("scores")
        scores.append(["subject", "visit", "instrument", "value"])
        scores.append(["P001", "pre", "TUG", 9.25])
        made.create_sheet("empty")

    done = run(book(tmp_path / "study.xlsx", more))
    assert done.done, done.errors
    assert [line.where for line in done.lines] == ["study.xlsx, sheet Sheet, row 2", "study.xlsx, sheet scores, row 2"]
    assert stored()["P001", "pre"]["session_date"] == datetime.date(2026, 1, 10)
    assert {(r["instrument"], r["score_value"]) for r in study.ClinicalScore().to_dicts()} == {
        ("mJOA", 12),
        ("TUG", 9.25),
    }


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda _, page: page.merge_cells("A2:A3"), "A2:A3"),
        (lambda _, page: page.cell(2, 5, "=6*2"), "cell E2"),
        (lambda _, page: page.cell(2, 5, "#N/A"), "#N/A"),
    ],
    ids=["merged", "formula", "error"],
)
def test_workbooks_that_hide_values(tmp_path: Path, change, words: str):
    with pytest.raises(PblError, match="SHEET_FORMAT") as error:
        sheets.read_sheets(book(tmp_path / "study.xlsx", change))
    assert words in error.value.text()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"subject,visit,subject\n", "twice"),
        ("a.csv", b"subject,,visit\nP,1,2\n", "without a name"),
        ("a.csv", b"subject,visit\n\xff\xfe\n", "UTF-8"),
        ("a.csv", b'subject,visit\n"P001,a\n', "CSV"),
        ("a.xlsx", b"subject,visit\n", "zip"),
        ("b.xlsx", b"PK\5\6" + bytes(18), "xlsx"),
    ],
)
def test_files_that_are_no_sheet(tmp_path: Path, name: str, content: bytes, words: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PblError, match="SHEET_FORMAT") as error:
        sheets.read_sheets(tmp_path / name)
    assert words in error.value.text()


def test_columns_that_are_unknown(empty: None, tmp_path: Path):
    found = run(sheet(tmp_path, "subject,visit,mJOAA,mJOA\nP001,a,3,44\n"))
    assert [e.code for e in found.errors] == ["SHEET_FORMAT", "SCORE_RANGE"]
    assert "'mJOAA'" in found.errors[0].found
    assert not found.done
    with pytest.raises(PblError, match="FILE_MISSING"):
        run(tmp_path / "absent.csv")


def test_all_errors_of_all_rows_at_once(empty: None, tmp_path: Path):
    """Wrong, empty, too long, out of range, of another language, twice, contradicting, of one row and of several."""
    head = "subject,visit,date,role,intervention_date,birth_date,record,population,note,mJOA,height\n"
    rows = {
        "Ann Smith,a,03/04/2026,Pre Op,30.2.2026,1950-13-01,,,,44,": "USAGE SCORE_RANGE" + 4 * " SHEET_FORMAT",
        "P002,,,pre,,,,,,,": "SHEET_FORMAT",
        "P003,a,,pre,,,,,,x,": "SHEET_FORMAT",
        f'{"P" * 33},{"v" * 65},,{"r" * 33},,,{"n" * 256},{"x" * 33},{"y" * 1001},"1,234",': "USAGE " * 5
        + 2 * "SHEET_FORMAT ",
        "P004,a,2026-01-01,pre,,1950,4711,healthy,,12,": "",
        "P004,a,2026-01-02,6_weeks,,1960,4712,patient,,12.5,": "SCORE_RANGE" + 5 * " SHEET_CONFLICT",
        "P004,a,2026-01-01,pre,,,,,,12,": "SHEET_CONFLICT " * 2,
        "P005,a,2026-01-01,pre,2025-12-01,,4711,,,,": "SHEET_CONFLICT",
        "P006,a,2026-01-01,pre,,2027-01-01,,,,,": "SHEET_CONFLICT",
        "P007,a,2026-01-01,pre,,,,,,1,2,3": "SHEET_FORMAT",
        "p-8,b,2026-01-01,pre,,,,,,,": "SHEET_CONFLICT",
    }
    scores = {
        ",,,": None,
        ",,TUG,0": "SHEET_FORMAT SHEET_FORMAT SCORE_RANGE",
        "P008,a,ABC,1": "SHEET_FORMAT SHEET_CONFLICT",
        "P008,a,TUG,9": "",
        "P008,a,TUG,10": "SHEET_CONFLICT",
        f"P008,{'v' * 65},TUG,'9'": "USAGE SHEET_FORMAT",
    }
    long = "subject,visit,instrument,value\n" + "\n".join(scores)
    found = run(sheet(tmp_path, head + "\n".join(rows)), sheet(tmp_path, long, "b.csv"))
    assert not found.done
    expected = {"visits.csv": ["SHEET_FORMAT"]}
    for name, of_sheet in (("visits.csv", rows), ("b.csv", scores)):
        codes = {f"{name}, row {i}": code for i, code in enumerate(of_sheet.values(), 2)}
        expected |= {where: sorted(code.split()) for where, code in codes.items() if code is not None}
    assert {line.where: sorted(e.code for e in line.errors) for line in found.lines} == expected
    assert all(str(e.key).startswith(line.where) for line in found.lines for e in line.errors)
    assert not len(lab.Subject())


def test_days_and_decimals_in_the_german_form(empty: None, tmp_path: Path):
    text = "subject;visit;date;role;birth_date;TUG\nP001;a;9.3.2026;pre;01.05.1950;9,25\n"
    text += "P001;b;2026-06-01;6_weeks;1950-05-01;-\n"
    done = run(sheet(tmp_path, text))
    assert done.done, done.errors
    assert stored()["P001", "a"]["session_date"] == datetime.date(2026, 3, 9)
    assert study.ClinicalScore().to_arrays("score_value").tolist() == [9.25]
    assert not any(line.changes for line in run(sheet(tmp_path, text)).lines)


@pytest.mark.parametrize(
    ("scores", "words"),
    [
        ({"mJOA": 12, "mJOA-UE": 3, "mJOA-LE": 5, "mJOA-S": 2, "mJOA-B": 3}, "mJOA 13, the sum of its parts"),
        ({"mJOA": 13, "mJOA-UE": 3, "mJOA-LE": 5, "mJOA-S": 2, "mJOA-B": 3}, ""),
        ({"mJOA": 4, "mJOA-LE": 5}, "mJOA 5 to 16"),
        ({"mJOA": 16, "mJOA-LE": 5}, ""),
        ({"10MWT_s": 8, "10MWT_m_per_s": 1}, "1.25 m/s, or 0.75"),
        ({"10MWT_s": 8, "10MWT_m_per_s": 1.25}, ""),
        ({"10MWT_s": 8, "10MWT_m_per_s": 0.75}, ""),
    ],
)
def test_scores_that_contradict_each_other(empty: None, tmp_path: Path, scores: dict[str, float], words: str):
    """In one sheet, and the last of them against those that are stored."""
    head = "subject,visit,instrument,value\n"
    rows = [f"P001,a,{name},{value}\n" for name, value in scores.items()]
    together = run(sheet(tmp_path, head + "".join(rows)), dry_run=True)
    assert run(sheet(tmp_path, head + "".join(rows[:-1]))).done
    later = run(sheet(tmp_path, head + rows[-1]))
    for found in (together, later):
        assert [e.code for e in found.errors] == (["SHEET_CONFLICT"] if words else [])
        assert words in "".join(e.expected for e in found.errors)
    assert later.done == (not words)


def test_the_template_is_a_sheet(empty: None, tmp_path: Path):
    for name in ("new.csv", "new.xlsx"):
        path = tmp_path / name
        assert pbl("study", "import", "--template", path).code == 0
        (made,) = sheets.read_sheets(path)
        assert set(made.columns) == {*study_sheets.COLUMNS, *study.ClinicalInstrument().to_arrays("instrument")}
        assert run(path).done
        assert pbl("study", "import", "--template", path).error_code == "FILE_UNWRITABLE"
    assert pbl("study", "import").code == 2


def test_the_command_says_row_by_row(empty: None, tmp_path: Path):
    visits = sheet(tmp_path, VISITS)
    dry = pbl("study", "import", visits, "--dry-run")
    assert (dry.code, len(lab.Subject())) == (0, 0)
    assert "visits.csv, row 4: new person C001" in dry.out
    assert "4 rows would be imported, 0 unchanged, 0 refused" in dry.out
    assert "4 rows imported" in pbl("study", "import", visits).out
    wrong = pbl("study", "import", sheet(tmp_path, VISITS.replace(",11\n", ",44\n")))
    assert (wrong.code, wrong.error_code) == (1, "SCORE_RANGE")
    assert "0 rows not imported, 3 unchanged, 1 refused" in wrong.out
