"""Slices: frozen visits as frames, whether they are the same again, and the frames of the views."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.study import read_study, write_study
from pbl_pipeline.study_report import all_tables, plan, study_results
from pbl_schemas import fit, gait, gdi, session, study, video
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.intake.records import set_condition
from pbl_schemas.reading import frames
from pbl_schemas.review import Decision
from pbl_schemas.studies import slices
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import populate
from tests.command import pbl
from tests.rows import new_visit

from . import chain

VISITS = """subject,visit,date,role,intervention_date,population,cohort,group,included,reason,mJOA,TUG
P001,pre,2026-01-10,pre,2026-02-01,patient,dcm,surgery,yes,,11,14.5
P001,after,2026-03-15,6_weeks,2026-02-01,,dcm,,,,13,
P002,pre,2026-01-12,pre,2026-02-01,patient,dcm,surgery,yes,,12,
C001,pre,2026-01-11,baseline,,healthy,dcm,,no,moved away,,
C001,again,2026-01-20,baseline,,,dcm,,,,,
X001,,,,,patient,dcm,,no,declined,,
"""


@pytest.fixture(scope="module")
def cohort(module_tables: Path) -> Path:
    """Three visits through the whole chain, one of them with a fast trial too; one visit without a video; an excluded
    person."""
    for i, (subject, label, pace) in enumerate(
        [("P001", "pre", None), ("P001", "pre", "fast"), ("P001", "after", None), ("C001", "pre", None)]
    ):
        ingest([chain.small_video(module_tables, f"walk{i}", n=340 + i)], VisitRecord(subject, label, pace=pace))
    populate()
    sheet = module_tables / "visits.csv"
    sheet.write_text(VISITS)
    assert import_sheets([sheet]).done
    slices.freeze("first", "dcm", event="surgery", note="Two clinics.")
    return module_tables


def of(frame: Any, subject: str, visit: str) -> Any:
    return frame[(frame["subject"] == subject) & (frame["visit"] == visit)]


def test_a_slice_as_frames(cohort: Path):
    found: Any = slices.study_data("first")
    filmed: Any = of(found.visits, "P001", "pre").iloc[0]
    assert (filmed["videos"], filmed["videos_left_out"], filmed["height"]) == (2, 0, "not_stated")
    assert filmed["cameras"]
    told = found.visits[["subject", "visit", "role", "days", "group", "included", "reason"]]
    assert [tuple(None if v != v else v for v in r) for r in told.itertuples(index=False)] == [
        ("C001", "pre", "baseline", None, "healthy", False, "moved away"),
        ("C001", "again", "baseline", None, "healthy", False, "moved away"),
        ("P001", "pre", "pre", -22, "surgery", True, ""),
        ("P001", "after", "6_weeks", 42, "surgery", True, ""),
        ("P002", "pre", "pre", -20, "surgery", False, "no measures"),
    ]
    # Index and measures are those of the row of the visit.
    key = (session.Session & {"subject": "P001", "session_label": "pre"}).fetch1("KEY")
    row = (gdi.SessionGdi & (fit.FitSet & key)).fetch1()
    visit = of(found.visits, "P001", "pre").iloc[0]
    assert (visit["gdi"], visit["n_cycles"]) == (row["session_gdi"], row["session_gdi_n"])
    measures = of(found.measures, "P001", "pre").set_index(["measure", "side"])
    assert measures.at[("cadence_steps_per_min", "both"), "value"] == row["session_cadence"]
    assert measures.at[("cadence_steps_per_min", "both"), "unit"] == "steps/min"
    assert measures.at[("gdi", "left"), "value"] == row["session_gdi_left"]
    assert set(found.measures["unit"]) <= {"steps/min", "%", "s", "m", "m/s", "deg", ""}
    # Cycles of the fast trial are in none of the frames.
    slow = (video.Video & key & "video_name = 'walk0.mp4'").fetch1("KEY")
    used = (gait.GaitCycle & slow).fetch1("n_cycles_used")
    cycles = of(found.cycles, "P001", "pre")
    index = cycles[cycles["measure"] == "gdi"]
    assert len(index) == used == row["session_gdi_n"]
    # The index of the visit is of the mean curves; each cycle has its own.
    assert index["value"].mean() == pytest.approx(row["session_gdi"], abs=1.0)
    stride = cycles.loc[cycles["measure"] == "stride_time_s", "value"].mean()
    assert stride == pytest.approx(measures.at[("stride_time_s", "both"), "value"])
    curves = of(found.curves, "P001", "pre")
    assert curves.groupby("variable")["n_cycles"].sum().eq(used).all()
    expected = [c for c in gait.load_cycles((gait.GaitCycle & slow).fetch1("KEY")) if c.used and c.side == "left"]
    mean = np.mean([c.curves["knee_flexion"] for c in expected], axis=0)
    points = curves[(curves["variable"] == "knee_flexion") & (curves["side"] == "left")].iloc[0]
    np.testing.assert_allclose(points[[f"p{i}" for i in range(0, 101, 2)]].astype(float), mean, rtol=1e-5)
    # Scores and their instruments.
    assert set(map(tuple, found.scores.to_numpy())) == {
        ("P001", "pre", "mJOA", 11.0),
        ("P001", "pre", "TUG", 14.5),
        ("P001", "after", "mJOA", 13.0),
        ("P002", "pre", "mJOA", 12.0),
    }
    mjoa = found.instruments.set_index("instrument").loc["mJOA"]
    assert (mjoa["low"], mjoa["high"], mjoa["mic"], mjoa["higher_is_better"]) == (0, 18, 2, True)
    assert "Tetreault" in mjoa["source"]
    assert (found.description.name, found.description.event) == ("first", "surgery")
    absent = "1 of 4 people of the cohort have none of these visits (1 excluded: declined)."
    assert found.description.note == f"Two clinics. {absent}"
    assert found.description.methods["fit_method"] == fit.SessionFit().to_dicts()[0]["fit_method"]


def test_a_slice_and_its_folder_make_the_same_report(cohort: Path, tmp_path: Path):
    found = slices.study_data("first")
    assert ("gdi", "left") in set(zip(found.measures["measure"], found.measures["side"], strict=True))
    write_study(found, tmp_path)
    of_tables, of_folder = (study_results(s, plan(s), permutations=100) for s in (found, read_study(tmp_path)))
    assert of_tables.plan.measures[0] == "gdi"
    assert not [m for m in of_tables.plan.measures if m.startswith(("gdi ", "gdi_"))]
    assert of_tables.table["gdi"].to_list() == found.visits.loc[found.visits["included"], "gdi"].to_list()
    assert of_folder.plan == of_tables.plan
    again = all_tables(found, of_folder)
    for name, table in all_tables(found, of_tables).items():
        assert table.body.equals(again[name].body)


def test_the_same_frames_again_until_a_row_changes(cohort: Path):
    frozen = slices.freeze("second", "dcm", roles=("pre", "6_weeks"))
    assert (frozen.n, frozen.n_included) == (3, 2)
    assert frozen.hash == slices.freeze("third", "dcm", roles=("pre", "6_weeks")).hash
    assert slices.changes("second") == slices.changes("first") == []
    pre = (session.Session & {"subject": "P001", "session_label": "pre"}).fetch1("session_id")
    score = {"session_id": pre, "instrument": "mJOA"}
    study.ClinicalScore.update1({**score, "score_value": 10})
    assert slices.changes("second") == ["visit pre of P001 has other rows"]
    said: Any = slices.study_data("second", curves=False)
    assert said.description.note.endswith(" 1 of its 3 visits have other numbers than when it was frozen.")
    study.ClinicalScore.update1({**score, "score_value": 11})
    assert slices.changes("second") == []
    # A later video makes another set; the slice keeps its own.
    (extra,) = ingest([chain.small_video(cohort, "later", n=350)], VisitRecord("P001", "pre"))
    populate()
    assert slices.changes("second") == []
    again: Any = slices.study_data("second", curves=False)
    assert again.visits["n_cycles"].sum() > 0
    # Another pace: the measures of both sets are computed anew, the new set's alone, since only that is current.
    set_condition(extra.video_id or 0, pace="fast")
    assert slices.changes("second") == []
    populate()
    study.Visit.update1({"session_id": pre, "visit_days": -30})
    assert slices.changes("first") == ["visit pre of P001 has other rows"]
    study.Visit.update1({"session_id": pre, "visit_days": -22})
    after = session.Session & {"subject": "P001", "session_label": "after"}
    number = after.fetch1("session_id")
    (study.StudySliceVisit & {"study_slice": "third", "session_id": number}).delete(prompt=False)
    assert slices.changes("third") == ["a visit was deleted"]


def test_a_column_that_came_later_changes_no_slice_until_it_has_a_value(cohort: Path):
    about = {**slices.slice_row("first"), "cohort": "dcm"}
    found: Any = slices._frames(slices._frozen(about), about)
    later = ["gdi_unshrunk", "gdi_unshrunk_sd"]
    older = {**found, "visits": found["visits"].drop(columns=later)}
    before = slices._hashes(older)
    assert before != slices._hashes(found)
    upgraded = {**found, "visits": found["visits"].assign(**dict.fromkeys(later, None))}
    assert slices._hashes(upgraded) == before


def test_what_cannot_be_frozen(cohort: Path):
    for refused, code in (
        (lambda: slices.freeze("first"), "USAGE"),
        (lambda: slices.freeze("x", "no such cohort"), "DB_NOT_FOUND"),
        (lambda: slices.freeze("x", roles=("5_years",)), "DB_NOT_FOUND"),
        (lambda: slices.freeze("x", methods={"fit_method": "paper-2025-v2"}), "DB_NOT_FOUND"),
        (lambda: slices.freeze("x", methods={"solver": "a"}), "USAGE"),
        (lambda: slices.study_data("absent"), "DB_NOT_FOUND"),
        (lambda: slices.changes("absent"), "DB_NOT_FOUND"),
    ):
        with pytest.raises(PblError, match=f"^{code}: "):
            refused()
    assert not study.StudySlice & {"study_slice": "x"}


def test_the_views_of_a_study(cohort: Path):
    visits: Any = frames.visit_frame()
    assert len(visits) == 5
    one = visits[(visits["subject"] == "P001") & (visits["session_label"] == "pre")].iloc[0]
    assert (one["mJOA"], one["TUG"], one["visit_role"], one["population"]) == (11, 14.5, "pre", "patient")
    assert visits["mJOA"].notna().sum() == 3
    assert visits["session_gdi"].notna().sum() == 3
    assert frames.visit_frame({"subject": "P002"})["mJOA"].tolist() == [12]
    cycles: Any = frames.cycle_frame({"subject": "P001", "session_label": "pre"})
    assert {"fast", "unknown"} <= set(cycles["pace"])
    assert set(cycles["activity"]) == {"walking"}
    own = session.Session & {"subject": "P001", "session_label": "pre"}
    videos = (video.Video & own.proj()).proj().to_dicts()
    current = (fit.FitSelection & {"fit_current": True}).proj()
    assert len(cycles) == sum((gait.GaitCycle & current & videos).to_arrays("n_cycles_used"))


def test_a_slice_is_looked_at_before_it_is_frozen_and_can_be_withdrawn(cohort: Path):
    before = sorted(study.StudySlice().to_arrays("study_slice"))
    asked = ("study", "slice", "planned")
    assert pbl(*asked).error_code == "DB_NOT_FOUND"  # a check of a name that is not there freezes nothing
    assert pbl(*asked, "--withdraw").error_code == "DB_NOT_FOUND"
    assert pbl(*asked, "--all", "--role", "pre").code == 2
    new_visit("later")
    for more, n in ((("--cohort", "dcm"), 2), (("--all",), 3), ((), 3)):  # C001 is excluded from the cohort
        planned = pbl(*asked, *more, "--dry-run")
        assert planned.code == 0, planned.err
        lines = planned.out.splitlines()
        assert "P001 pre: counts" in lines
        assert "P002 pre: does not count: no measures" in lines
        assert "P001 later: does not count: no role is stated" in lines
        assert f"would be frozen: 5 visits, {n} count" in lines[-1]
    (session.Session & {"session_label": "later"}).delete_quick()
    assert sorted(study.StudySlice().to_arrays("study_slice")) == before
    made = pbl(*asked, "--all")
    assert made.code == 0, made.err
    digest = made.out.split()[-1]
    assert pbl(*asked).out == "planned: as it was frozen\n"
    server, rows = study.StudySlice.connection, study.StudySlice.full_table_name
    schema = rows.split(".")[0]
    refers = f"FOREIGN KEY (study_slice) REFERENCES {rows} (study_slice)"
    server.query(f"CREATE TABLE {schema}.own (study_slice VARCHAR(32), {refers})")
    try:
        server.query(f"INSERT INTO {schema}.own VALUES ('planned')")
        assert pbl(*asked, "--withdraw").error_code == "USAGE"
        assert pbl(*asked).out == "planned: as it was frozen\n"
    finally:
        server.query(f"DROP TABLE {schema}.own")
    assert pbl(*asked, "--withdraw").out == "planned: withdrawn\n"
    assert sorted(study.StudySlice().to_arrays("study_slice")) == before
    (kept,) = (Decision & {"decision_what": "slice"}).to_dicts()
    assert (kept["decision_about"], kept["decision_before"]["hash"]) == ({"study_slice": "planned"}, digest)
    assert digest in pbl("list", "decisions").out


@pytest.mark.long
def test_the_commands(cohort: Path, tmp_path: Path):
    made = pbl("study", "slice", "from-shell", "--cohort", "dcm", "--role", "pre", "--role", "6_weeks")
    assert made.code == 0, made.err
    assert "3 visits, 2 count" in made.out
    assert "as it was frozen" in pbl("study", "slice", "from-shell").out
    assert "from-shell" in pbl("study", "slice").out
    out = tmp_path / "study"
    done = pbl("study", "export", "--slice", "from-shell", "--out", out, "--keep-codes")
    assert done.code == 0, done.err
    again: Any = read_study(out)
    assert (again.n_visits, again.description.name) == (3, "from-shell")
    assert set(again.visits["subject"]) == {"P001", "P002"}
    page = pbl("study", "report", "--slice", "from-shell", "--out", tmp_path / "report")
    assert (page.code, page.err) == (0, "")
    assert "from-shell" in (tmp_path / "report" / "report.html").read_text()
    assert pbl("study", "report", "--out", tmp_path / "report").code == 2
    assert pbl("study", "report", "--slice", "absent", "--out", tmp_path / "report").error_code == "DB_NOT_FOUND"
    coded, key = tmp_path / "coded", tmp_path / "key.csv"
    assert pbl("study", "export", "--slice", "from-shell", "--out", coded, "--key", key).code == 0
    text = "".join(p.read_text() for p in coded.glob("*.csv"))
    assert "C001" not in text
    assert key.stat().st_mode & 0o077 == 0


def test_the_visits_of_a_slice_are_exported(cohort: Path, tmp_path: Path):
    done = pbl("export", "--slice", "first", "--to", "mot", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    made = {p.parent.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("export.json")}
    data = slices.study_data("first", curves=False).visits
    rows = data.to_dict("records")
    assert made == {f"{v['subject']}/{v['visit']}" for v in rows if v["included"]}
    assert 0 < len(made) < len(data)
