"""Visits, scores, cohorts and slices as a DataJoint user meets them."""

import math
from collections.abc import Iterator
from pathlib import Path

import datajoint as dj
import numpy as np
import pandas as pd
import pytest

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_pipeline.study import classes_of, minimal_change_at
from pbl_schemas import lab, methods, session, study
from pbl_schemas.instruments import INSTRUMENTS
from pbl_schemas.operations import forget
from pbl_schemas.rows import utc_now
from tests.rows import remove_all


@pytest.fixture
def two_people(database: Path) -> Iterator[None]:
    """P001 with sessions 1 and 2, P002 with session 3; no videos."""
    pbl_schemas.activate(methods=False)
    people = ({"subject": s, "population": "patient", "subject_created": utc_now()} for s in ("P001", "P002"))
    lab.Subject.insert(people)
    session.Session.insert(
        {"session_id": i, "subject": s, "session_label": f"2026-0{i}-01", "session_created": utc_now()}
        for i, s in ((1, "P001"), (2, "P001"), (3, "P002"))
    )
    yield
    remove_all()


def scores() -> set[tuple[int, str, float]]:
    return {(r["session_id"], r["instrument"], r["score_value"]) for r in study.ClinicalScore().to_dicts()}


def test_every_way_of_inserting_a_score(two_people: None):
    study.ClinicalScore.insert1({"session_id": 1, "instrument": "mJOA", "score_value": 14})
    study.ClinicalScore.insert([(1, "TUG", 9.5)])
    study.ClinicalScore().insert(pd.DataFrame({"session_id": [2], "instrument": ["mJOA"], "score_value": [18.0]}))
    study.ClinicalScore.insert({"session_id": 2, "instrument": n, "score_value": 0} for n in ("mRS", "BBS"))
    record = np.array([(3, "6MWT", 400.0)], [("session_id", int), ("instrument", "U8"), ("score_value", float)])
    study.ClinicalScore.insert(record)
    expected = {(1, "mJOA", 14), (1, "TUG", 9.5), (2, "mJOA", 18), (2, "mRS", 0), (2, "BBS", 0), (3, "6MWT", 400)}
    assert scores() == expected
    study.ClinicalScore.insert(study.ClinicalScore & {"session_id": 1}, skip_duplicates=True)
    study.ClinicalScore.update1({"session_id": 1, "instrument": "mJOA", "score_value": 15})
    assert (1, "mJOA", 15) in scores()
    joined = (study.ClinicalScore * study.ClinicalInstrument & "score_value >= minimal_change").to_pandas()
    assert len(joined) == 4


@pytest.mark.parametrize(
    ("name", "value"), [("mJOA", 19), ("mJOA", -1), ("BBS", 57), ("mRS", math.nan), ("TUG", 0.2), ("mJOA", "much")]
)
def test_a_score_outside_its_range_is_refused_with_all_rows_beside_it(two_people: None, name: str, value: float):
    rows = [{"session_id": 1, "instrument": "BBS", "score_value": 40}]
    with pytest.raises(PblError) as error:
        study.ClinicalScore.insert([*rows, {"session_id": 1, "instrument": name, "score_value": value}])
    assert (error.value.code, scores()) == ("SCORE_RANGE", set())
    assert error.value.key == "session_id=1"
    study.ClinicalScore.insert([{"session_id": 2, "instrument": name, "score_value": 3}])
    with pytest.raises(PblError, match="SCORE_RANGE"):
        study.ClinicalScore.update1({"session_id": 2, "instrument": name, "score_value": value})


def test_mistakes_of_the_call_are_datajoints_own_errors(two_people: None):
    with pytest.raises(dj.errors.IntegrityError):
        study.ClinicalScore.insert1({"session_id": 1, "instrument": "unheard of", "score_value": 1})
    with pytest.raises(KeyError, match="more"):
        study.ClinicalScore.insert1({"session_id": 1, "instrument": "mJOA", "score_value": 1, "more": 2})
    with pytest.raises(dj.errors.DataJointError):
        study.ClinicalScore.insert([(1, "mJOA")])
    study.ClinicalScore.insert1({"session_id": 1, "instrument": "mJOA", "score_value": 1})
    with pytest.raises(dj.errors.DuplicateError):
        study.ClinicalScore.insert1({"session_id": 1, "instrument": "mJOA", "score_value": 2})


def test_an_instrument_of_ones_own(two_people: None):
    own = {"instrument": "own", "instrument_name": "a scale", "instrument_unit": "percent"}
    try:
        study.ClinicalInstrument.insert1({**own, "instrument_low": 0, "higher_is_better": False, "ordinal": True})
        study.ClinicalScore.insert1({"session_id": 1, "instrument": "own", "score_value": 1e6})
        with pytest.raises(PblError, match="at least 0 percent"):
            study.ClinicalScore.insert1({"session_id": 2, "instrument": "own", "score_value": -1})
    finally:
        (study.ClinicalScore & {"instrument": "own"}).delete(prompt=False)
        (study.ClinicalInstrument & {"instrument": "own"}).delete(prompt=False)


def test_the_instruments_that_ship():
    for row in INSTRUMENTS:
        assert row["instrument_low"] < row["instrument_high"]
        assert bool(row["minimal_change"]) == bool(row["minimal_change_source"]), row["instrument"]
        assert all(len(row[k]) <= 255 for k in ("instrument_source", "minimal_change_source", "instrument_classes"))


def test_new_shipped_instruments_come_beside_those_of_ones_own(two_people: None):
    """Their number does not matter."""
    shipped = INSTRUMENTS
    (study.ClinicalInstrument & {"instrument": "NDI"}).delete(prompt=False)
    own = {**shipped[0], "instrument": "own"}
    study.ClinicalInstrument.insert1(own)
    methods.insert_all()
    assert set(study.ClinicalInstrument().to_arrays("instrument")) == {"own", *(r["instrument"] for r in shipped)}
    (study.ClinicalInstrument & {"instrument": "own"}).delete(prompt=False)


def test_disability_and_quality_of_life_are_those_of_their_sources():
    """Fairbank & Pynsent 2000: 21 % is moderate, 41 % severe; Vernon & Mior 1991: 35 of 50 complete; Ostelo 2008."""
    shipped = {row["instrument"]: row for row in INSTRUMENTS}
    odi, ndi = shipped["ODI"], shipped["NDI"]
    assert [c.split()[0] for c in odi["instrument_classes"].split("; ")] == ["0", "21", "41", "61", "81"]
    assert [c.split()[0] for c in ndi["instrument_classes"].split("; ")] == ["0", "5", "15", "25", "35"]
    assert (odi["minimal_change"], shipped["VAS"]["minimal_change"], odi["instrument_high"]) == (10, 15, 100)
    for name, value in (("ODI", 22.2), ("VAS", 47.5), ("EQ-5D-5L", -0.661), ("EQ-VAS", 80), ("NDI", 50)):
        study.check_score(value, shipped[name])
    for name, value in (("NDI", 12.5), ("EQ-5D-5L", 1.1), ("EQ-VAS", 80.5), ("mRS", 2.5), ("ODI", 101)):
        with pytest.raises(PblError, match="SCORE_RANGE"):
            study.check_score(value, shipped[name])


def test_instruments_are_those_of_the_paper_and_of_their_sources():
    """The paper (Datasets): a BBS of 50 and below is a fall risk, of 40 and below a high one."""
    shipped = {row["instrument"]: row for row in INSTRUMENTS}
    classes = classes_of(shipped["BBS"]["instrument_classes"])
    risk = {value: [word for lowest, word in classes if value >= lowest][-1] for value in (40, 41, 45, 50, 51, 56)}
    assert (risk[40], risk[41], risk[45], risk[50]) == ("high fall risk", *["fall risk"] * 3)
    assert risk[51] == risk[56] == "low fall risk"
    assert shipped["mRS"]["instrument_high"] == 5  # 6 is dead
    mjoa = shipped["mJOA"]
    least = [
        minimal_change_at(v, mjoa["minimal_change"], mjoa["minimal_change_classes"]) for v in (0, 11, 12, 14, 15, 17)
    ]
    assert least == [3, 3, 2, 2, 1, 1]  # severe, moderate, mild (Tetreault et al. 2015)
    assert minimal_change_at(44, shipped["BBS"]["minimal_change"], "") is None


def test_a_forgotten_person_leaves_her_cohort_to_the_others(two_people: None):
    study.Cohort.insert1({"cohort": "dcm"})
    study.CohortMember.insert({"cohort": "dcm", "subject": s, "member_included": True} for s in ("P001", "P002"))
    study.Visit.insert({"session_id": i, "visit_role": "pre", "visit_note": "limps"} for i in (1, 3))
    study.ClinicalScore.insert({"session_id": i, "instrument": "mJOA", "score_value": 12} for i in (1, 3))
    _, found = forget.find("P001")
    assert {t.split(".")[1] for t in found.rows} >= {"visit", "clinical_score", "cohort_member"}
    assert not forget.forget("P001").left
    assert len(study.Cohort()) == len(study.CohortMember()) == len(study.Visit()) == len(study.ClinicalScore()) == 1


@pytest.mark.parametrize(
    ("role", "days"), [("pre", -math.inf), ("6_weeks", 42), ("1_year", 365.25), ("3_months", 91.3125), ("late", None)]
)
def test_days_of_a_role(role: str, days: float | None):
    assert study.is_role(role)
    assert study.role_days(role) == days
