"""One rule of labels at all ways into the tables: texts that read alike are one person and one visit."""

import io
import unicodedata
from pathlib import Path

import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import normalised_label
from pbl_schemas import lab, session, video
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.intake.move import carry_out, plan_move
from pbl_schemas.reading.visits import find_visit
from pbl_schemas.rows import utc_now
from pbl_schemas.studies.visit_forms import register_visit
from tests.command import pbl

from . import chain
from .drop import twice, upload

LABEL = "Vor OP \u00e9"
SAME = (f"{LABEL} ", f" {LABEL}", f"\u00a0{LABEL}\u3000", unicodedata.normalize("NFD", LABEL), "Vor  OP\u00a0 \u00e9")
OTHER = (LABEL.lower(), LABEL.replace("\u00e9", "e"), LABEL.replace(" ", ""))


def by_command(label: str, folder: Path) -> None:
    done = pbl("ingest", chain.small_video(folder, "two", n=41), "--subject", " P001 ", "--session", label)
    assert done.code == 0, done.err


def by_sheet(label: str, folder: Path) -> None:
    chain.small_video(folder, "two", n=41)
    (folder / "sheet.csv").write_text(f"file,subject,visit\ntwo.mp4, P001 ,{label}\n", encoding="utf-8")
    done = pbl("ingest", "--sheet", folder / "sheet.csv")
    assert done.code == 0, done.err


def by_study_sheet(label: str, folder: Path) -> None:
    (folder / "sheet.csv").write_text(f"subject,visit,role\n P001 ,{label},baseline\n", encoding="utf-8")
    done = pbl("study", "import", folder / "sheet.csv")
    assert done.code == 0, done.err


def by_page(label: str, folder: Path) -> None:
    number, errors = register_visit({"subject": " P001 ", "visit": label}, "a test")
    assert [e.code for e in errors.values()] == (["SHEET_CONFLICT"] if number is None else []), errors


def by_move(label: str, folder: Path) -> None:
    (result,) = ingest([chain.small_video(folder, "two", n=41)], VisitRecord("P002", "x"))
    assert result.video_id is not None
    carry_out(plan_move(result.video_id, " P001 ", label))
    with pytest.raises(PblError, match="already"):
        plan_move(result.video_id, "P001", label)


def by_drop_folder(label: str, folder: Path) -> None:
    upload(folder / "drop", f"P001 /{label}/walk.mp4")
    assert len(twice(folder / "drop", folder / "archive").registered) == 1


DOORS = (by_command, by_sheet, by_study_sheet, by_page, by_move, by_drop_folder)


def labels() -> list[str]:
    return sorted((session.Session & {"subject": "P001"}).to_arrays("session_label"))


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("label", SAME)
def test_labels_that_read_alike_are_one_visit(tables, tmp_path, environment, door, label):
    environment(PBL_ARCHIVE=tmp_path / "archive")
    ingest([chain.small_video(tmp_path, "one", n=40)], VisitRecord("P001", LABEL))
    door(label, tmp_path)
    assert labels() == [LABEL]
    assert set(lab.Subject.to_arrays("subject")) <= {"P001", "P002"}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("label", OTHER)
def test_case_accents_and_single_spaces_distinguish_visits(tables, tmp_path, environment, door, label):
    environment(PBL_ARCHIVE=tmp_path / "archive")
    ingest([chain.small_video(tmp_path, "one", n=40)], VisitRecord("P001", LABEL))
    door(label, tmp_path)
    assert labels() == sorted((LABEL, label))


@pytest.mark.parametrize("stored", SAME)
def test_a_visit_of_before_keeps_its_label_and_is_found(tables, tmp_path, stored):
    ingest([chain.small_video(tmp_path, "other", n=39)], VisitRecord("P001", "other"))
    session.Session.insert1(
        {"session_id": 77, "subject": "P001", "session_label": stored, "session_created": utc_now()}
    )
    (result,) = ingest([chain.small_video(tmp_path, "one", n=40)], VisitRecord("P001", LABEL))
    assert (video.Video & {"video_id": result.video_id}).fetch1("session_id") == 77
    by_study_sheet(LABEL, tmp_path)
    for label in (LABEL, *SAME):
        assert find_visit({"subject": " P001", "session_label": label})[0]["session_label"] == stored
        shown = pbl("list", "videos", "--subject", "P001 ", "--session", label, "--csv")
        assert list(pd.read_csv(io.StringIO(shown.out))["video_id"]) == [result.video_id]
    assert labels() == sorted((stored, "other"))


def test_a_label_of_spaces_is_refused(tmp_path):
    with pytest.raises(PblError, match="visit of 0 characters"):
        ingest([tmp_path / "any.mp4"], VisitRecord("P001", "\u00a0 "))


def test_what_is_kept():
    assert normalised_label(" a  b\u00a0c ") == "a b c"
    assert normalised_label("a\n") == "a\n"  # `check_label` refuses it
    assert normalised_label("\u212b") == "\u00c5"
    assert normalised_label("\ufb01") == "\ufb01"  # a ligature is another letter
