"""The data type of a study and its folder: what is written is read again, what is contradictory is refused."""

import dataclasses
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.study import (
    CURVE_POINTS,
    FRAMES,
    KEYS,
    StudyData,
    StudyDescription,
    classes_of,
    content_hash,
    data_dictionary,
    deidentified,
    minimal_change_at,
    read_study,
    write_study,
)
from tests.command import pbl


def small_study() -> StudyData:
    """Three persons with two visits each; the second visit of the last does not count."""
    people = [("a", "spine"), ("b", "spine"), ("c", "control")]
    keys = [
        (s, v, r, d, g)
        for s, g in people
        for v, r, d in (("2026-01-02", "pre", -3.0), ("2026-04-02", "3_months", 87.0))
    ]
    visits = pd.DataFrame(keys, columns=["subject", "visit", "role", "days", "group"]).assign(
        included=[True] * 5 + [False],
        reason=[""] * 5 + ["wore another orthosis"],
        gdi=[80.0, 85.5, 70.25, 75.0, 100.0, np.nan],
        gdi_sd=1.5,
        n_cycles=12,
        camera="phone",
    )
    rows = visits[["subject", "visit"]]
    return StudyData(
        visits=visits,
        measures=rows.assign(
            side="both",
            measure="cadence_steps_per_min",
            value=[100, 101, 90, 95, 110, 1 / 3],
            sd=2.0,
            n_cycles=12,
            unit="1/min",
        ),
        scores=rows.assign(instrument="mJOA", value=[12, 14, 11, 11, 18, 18]),
        instruments=pd.DataFrame(
            {
                "instrument": ["mJOA"],
                "unit": ["points"],
                "low": [0],
                "high": [18],
                "higher_is_better": [True],
                "ordinal": [True],
                "mic": [2],
                "source": ["Tetreault 2015"],
                "classes": ["0 severe; 12 moderate; 15 mild"],
            }
        ),
        curves=rows.assign(side="left", variable="knee_flexion", unit="deg", n_cycles=6).join(
            pd.DataFrame(np.arange(606.0).reshape(6, 101), columns=list(CURVE_POINTS))
        ),
        description=StudyDescription("spine", "abc", {"fit": "blazepose-2"}, "0.1.0", "surgery"),
    )


def test_what_is_written_is_read_again(tmp_path):
    study = small_study()
    write_study(study, tmp_path / "s")
    again = read_study(tmp_path / "s")
    for name in FRAMES:
        pd.testing.assert_frame_equal(getattr(again, name), getattr(study, name), rtol=1e-7)
    assert again.description == study.description
    assert content_hash(again) == content_hash(study)
    assert (again.n_subjects, again.n_visits) == (3, 6)
    dictionary = pd.read_csv(tmp_path / "s" / "dictionary.csv")
    for name in FRAMES:
        columns = list(pd.read_csv(tmp_path / "s" / f"{name}.csv").columns)
        assert list(dictionary.loc[dictionary["file"] == f"{name}.csv", "column"]) == columns
    assert len(data_dictionary(study)) == len(dictionary)


def test_frames_that_are_absent_are_empty(tmp_path):
    study = StudyData(small_study().visits)
    write_study(study, tmp_path)
    for name in ("curves", "cycles"):
        (tmp_path / f"{name}.csv").unlink()
    about = json.loads((tmp_path / "study.json").read_text())
    del about["files"]
    (tmp_path / "study.json").write_text(json.dumps(about))
    assert len(read_study(tmp_path).curves) == 0


def _set(frame: str, row: int, column: str, value: object):
    def change(study: StudyData) -> StudyData:
        table: Any = getattr(study, frame).astype({column: object})
        table.loc[row, column] = value
        return dataclasses.replace(study, **{frame: table})

    return change


def _again(frame: str):
    def change(study: StudyData) -> StudyData:
        table: Any = getattr(study, frame)
        return dataclasses.replace(study, **{frame: pd.concat([table, table.iloc[[0]]])})

    return change


CONTRADICTIONS = {
    "no visit": lambda s: dataclasses.replace(s, visits=s.visits.iloc[:0]),
    "no column role": lambda s: dataclasses.replace(s, visits=s.visits.drop(columns="role")),
    "unknown column": lambda s: dataclasses.replace(s, scores=s.scores.assign(date="x")),
    "a role twice": _set("visits", 1, "role", "pre"),
    "two groups": _set("visits", 1, "group", "control"),
    "no reason": _set("visits", 5, "reason", ""),
    "pre after post": _set("visits", 0, "days", 200.0),
    "an empty code": _set("visits", 0, "subject", ""),
    "a code of two lines": _set("visits", 0, "group", "a\nb"),
    "infinite": _set("visits", 0, "gdi", np.inf),
    "no number": _set("scores", 0, "value", "twelve"),
    "no flag": _set("visits", 0, "included", "perhaps"),
    "two units": _set("measures", 0, "unit", "steps/s"),
    "no side": _set("curves", 0, "side", "up"),
    "unknown score": _set("scores", 0, "instrument", "BBS"),
    "beyond the range": _set("scores", 0, "value", 19.0),
    "a visit that is not there": _set("scores", 0, "visit", "2026-02-02"),
    "range upside down": _set("instruments", 0, "low", 20.0),
    "classes without number": _set("instruments", 0, "classes", "mild; severe"),
    "classes out of order": _set("instruments", 0, "classes", "5 mild; 2 severe"),
    "the index in two places": _set("measures", 0, "measure", "gdi"),
    **{f"{name} twice": _again(name) for name in KEYS if name != "cycles"},
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_contradictions_are_refused(what):
    study = small_study()
    with pytest.raises(PblError) as error:
        CONTRADICTIONS[what](study)
    assert error.value.code == "STUDY_INVALID"
    assert error.value.key in FRAMES


def test_a_damaged_folder_is_refused(tmp_path):
    def code(change) -> str:
        write_study(small_study(), tmp_path)
        change()
        with pytest.raises(PblError) as error:
            read_study(tmp_path)
        assert str(tmp_path) in str(error.value.key)
        return error.value.code

    scores, about = tmp_path / "scores.csv", tmp_path / "study.json"

    def unsealed(**changes: object):
        content = json.loads(about.read_text())
        del content["files"]
        about.write_text(json.dumps(content | changes))

    def with_scores(text: str):
        scores.write_text(text)
        unsealed()

    assert code(lambda: scores.write_text(scores.read_text().replace("12", "13"))) == "FILE_FORMAT"
    assert code(scores.unlink) == "FILE_MISSING"
    assert code(about.unlink) == "FILE_MISSING"
    assert code(lambda: about.write_text("{")) == "FILE_FORMAT"
    assert code(lambda: about.write_text('{"format": "pbl-study-0"}')) == "FILE_FORMAT"
    assert code(lambda: unsealed(methods=3)) == "FILE_FORMAT"
    assert code(lambda: unsealed(n_visits=7)) == "STUDY_INVALID"
    assert code(lambda: with_scores('subject,visit\n"a')) == "FILE_FORMAT"
    assert code(lambda: with_scores("subject,visit,instrument,value\na,2026-01-02,mJOA,99\n")) == "STUDY_INVALID"
    assert code(lambda: with_scores("")) == "FILE_FORMAT"


def test_codes_are_new_and_nothing_else_changes():
    study = small_study()
    other, key = deidentified(study)
    assert set(other.visits["subject"]) == {"P001", "P002", "P003"}
    assert set(other.visits["visit"]) == {"V1", "V2"}
    assert "camera" not in other.visits
    text = "".join(getattr(other, name).to_csv() for name in FRAMES)
    assert "2026" not in text
    back: Any = other.scores.merge(key, left_on=["subject", "visit"], right_on=["new_subject", "new_visit"])
    merged: Any = back.merge(study.scores, left_on=["subject_y", "visit_y"], right_on=["subject", "visit"])
    assert len(merged) == 6
    assert (merged["value_x"] == merged["value_y"]).all()


def test_the_index_of_a_frame_does_not_matter():
    study = small_study()
    halves = pd.concat([study.scores.iloc[:3], study.scores.iloc[3:].reset_index(drop=True)])
    pd.testing.assert_frame_equal(dataclasses.replace(study, scores=halves).scores, study.scores)


def test_minimal_changes_by_the_score_before():
    study = small_study()
    assert [minimal_change_at(v, 2.0, "0 3; 12 2; 15 1") for v in (0.0, 11.9, 12.0, 18.0)] == [3, 3, 2, 1]
    assert minimal_change_at(-1.0, 2.0, "0 3") == 2  # below the first value
    assert (minimal_change_at(5.0, 2.0, ""), minimal_change_at(5.0, None, "")) == (2, None)
    table = study.instruments.drop(columns="mic_classes")
    assert set(dataclasses.replace(study, instruments=table).instruments["mic_classes"]) == {""}
    for text in ("0 three", "0 -1", "12 2; 0 3"):
        with pytest.raises(PblError, match="STUDY_INVALID"):
            dataclasses.replace(study, instruments=table.assign(mic_classes=text))


def test_classes():
    assert classes_of("0 high risk; 21 low risk") == [(0.0, "high risk"), (21.0, "low risk")]
    assert classes_of("") == []


def test_the_command_says_what_is_in_a_folder(tmp_path):
    write_study(small_study(), tmp_path)
    done = pbl("study", "check", tmp_path)
    assert "3 persons, 6 visits; 3 persons and 5 visits count" in done.out
    assert content_hash(small_study()) in done.out
