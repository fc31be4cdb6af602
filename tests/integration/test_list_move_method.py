"""`pbl list`, `pbl move` and `pbl method add`, and short names of methods, on a chain of stand-ins."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from pbl_pipeline import texts
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS
from pbl_schemas import fit, gait, gdi, intake, keypoints, kinetics, lab, session, study, video
from pbl_schemas.decisions import review_decisions
from pbl_schemas.intake import Methods, SeveralCameras, VisitRecord, ingest
from pbl_schemas.intake.move import carry_out, plan_move
from pbl_schemas.method_names import keys_named, with_keys
from pbl_schemas.reading import visit_list
from pbl_schemas.studies import study_sheets, visit_forms
from pbl_workers.populate import populate
from tests.command import pbl
from tests.rows import everything, new_visit, outcomes, register

from . import chain, test_rigs
from .drop import twice, upload


def visits_of_fits() -> dict[str, int]:
    """Visit -> number of videos in its current fit."""
    current = fit.SessionFit * (fit.FitSelection & {"fit_current": True}) * fit.FitSet.proj("session_id", "fit_set_n")
    rows = (current * session.Session.proj("subject", "session_label")).to_dicts()
    assert len({(r["subject"], r["session_label"]) for r in rows}) == len(rows)
    return {f"{r['subject']}/{r['session_label']}": int(r["fit_set_n"]) for r in rows}


@pytest.fixture
def walks(tables: None, fill: Callable) -> dict[str, int]:
    return fill(_walks)


def _walks(folder: Path) -> dict[str, int]:
    """Two videos of one visit of P001 and one of P002, through the chain."""
    paths = [chain.small_video(folder, name, n=240 + i) for i, name in enumerate(("one", "two", "three"))]
    one, two = register(*paths[:2], session_label="2026-03-01", project="spine", population="patient")
    (three,) = register(paths[2], subject="P002", session_label="2026-03-02", population="healthy")
    populate()
    return {"one": one, "two": two, "three": three}


@pytest.mark.long
def test_lists_have_a_row_for_each_with_counts_and_filters(walks):
    people = pd.read_csv(io.StringIO(pbl("list", "subjects", "--csv").out))
    assert people[["subject", "population", "visits", "videos"]].to_numpy().tolist() == [
        ["P001", "patient", 1, 2],
        ["P002", "healthy", 1, 1],
    ]
    assert list(people["first"]) == ["2026-03-01", "2026-03-02"]
    visits = json.loads(pbl("list", "visits", "--json", "--population", "healthy").out)
    assert [(v["subject"], v["videos"], v["results"]) for v in visits] == [("P002", 1, 1)]
    videos = json.loads(pbl("list", "videos", "--json", "--session", "2026-03-01").out)
    assert [(v["video_id"], v["pace"], v["keypoints"], v["fits"]) for v in videos] == [
        (walks["one"], "unknown", 1, 1),
        (walks["two"], "unknown", 1, 1),
    ]
    assert pbl("list", "videos", "--subject", "P003").out == "none\n"
    assert json.loads(pbl("list", "videos", "--subject", "P003", "--json").out) == []
    table = pbl("list", "visits").out.splitlines()
    assert len(table) == 3
    assert "2026-03-01" in table[1]
    assert pbl("list", "visits", "--json", "--csv").code == 2
    methods = json.loads(pbl("list", "methods", "--stage", "fit", "--json").out)
    assert {m["name"] for m in methods if m["default"]} == {METHODS.default}
    assert {m["method"] for m in methods} >= {m.key for m in METHODS.values()}
    assert pbl("list", "methods", "--stage", "feet").error_code == "SOLVER_UNKNOWN"


@pytest.mark.long
def test_moved_videos_take_their_keypoints_and_plans_and_leave_the_fit(walks):
    assert visits_of_fits() == {"P001/2026-03-01": 2, "P002/2026-03-02": 1}
    made = keypoints.Keypoints().to_arrays("keypoints_computed", order_by="KEY").tolist()
    before = everything()
    shown = pbl("move", walks["two"], "--to", "P002/2026-03-02")
    assert shown.code == 0, shown.err
    assert "from P001/2026-03-01 to P002/2026-03-02" in shown.out
    assert "1 rows of" in shown.out
    assert "--yes" in shown.out
    assert everything() == before
    done = pbl("move", walks["two"], "--to", "P002/2026-03-02", "--yes")
    assert done.code == 0, done.err
    assert visits_of_fits() == {"P002/2026-03-02": 1}  # nothing is left of the set it was in
    populate()
    assert visits_of_fits() == {"P001/2026-03-01": 1, "P002/2026-03-02": 2}
    assert keypoints.Keypoints().to_arrays("keypoints_computed", order_by="KEY").tolist() == made
    # A visit that is new is made with the plans of the old.
    done = pbl("move", walks["one"], "--to", "P003/first", "--yes")
    assert "a new person" in done.out
    assert "P001/2026-03-01 keeps no video" in done.out
    populate()
    assert visits_of_fits() == {"P002/2026-03-02": 2, "P003/first": 1}
    assert len(session.Session & {"subject": "P001"}) == 1
    old, new = ((session.Session & {"subject": s}).fetch1("session_id") for s in ("P001", "P003"))
    for table in (fit.FitPlan, gait.GaitPlan, gdi.GdiPlan, kinetics.KineticsPlan):
        plans = [[{**r, "session_id": 0} for r in (table & {"session_id": n}).to_dicts()] for n in (old, new)]
        assert plans[0] == plans[1] != []


def test_what_cannot_be_moved_is_refused_and_changes_nothing(tables, tmp_path):
    (number,) = register(chain.small_video(tmp_path, "walk"), session_label="2026-03-01")
    before = everything()
    for target in ("P001/2026-03-01", "Anna Meier/1", "P001/" + "x" * 65):
        assert pbl("move", number, "--to", target, "--yes").error_code == "USAGE"
    assert pbl("move", 999, "--to", "P002/1", "--yes").error_code == "DB_NOT_FOUND"
    assert pbl("move", number, "--to", "P002").code == 2
    assert everything() == before


def test_a_fit_method_for_other_points_is_warned_of(tables, tmp_path):
    path = chain.small_video(tmp_path, "walk")
    done = pbl("ingest", path, "--subject", "P001", "--fit-method", "gauss-newton")
    assert done.code == 0
    assert "warning: gauss-newton was made for MeTRAbs' 87 points with 3D, and is asked for points of blaze" in done.err
    assert "warning" not in pbl("ingest", path, "--subject", "P001", "--fit-method", METHODS.default).err
    plan = pbl("reprocess", "--table", "SessionFit", "--new-method", "markers")
    assert "warning: markers was made for markers of a laboratory" in plan.out
    assert "warning" not in pbl("reprocess", "--table", "SessionFit", "--new-method", "paper-2025").out


def test_all_cameras_of_a_trial_move_together(tables, tmp_path):
    toml = test_rigs.calibration(tmp_path / "rig.toml")
    three = SeveralCameras(test_rigs.rig_videos(tmp_path / "three"), toml, VisitRecord("P001", "2026-03-01"))
    done = intake.register([three])
    numbers = {int(r.video_id or 0) for r in done}
    pair = test_rigs.calibration(tmp_path / "pair.toml", test_rigs.CAMERAS[:2])
    two = test_rigs.rig_videos(tmp_path / "two", "b_", 250, test_rigs.CAMERAS[:2])
    intake.register([SeveralCameras(two, pair, VisitRecord("P003", "1"))])
    assert pbl("move", max(numbers), "--to", "P003/1", "--yes").error_code == "USAGE"  # two cameras there
    assert pbl("move", max(numbers), "--to", "P002/1", "--yes").code == 0
    moved = video.Video * session.Session.proj("subject") & {"subject": "P002"}
    assert {int(v) for v in moved.to_arrays("video_id")} == numbers


def test_a_recording_of_the_archive_goes_to_the_folder_of_its_new_person(drop, archive, faults):
    content = upload(drop, "P001/1/walk.mp4").read_bytes()
    twice(drop, archive)
    number, old = video.Video.fetch1("video_id", "video_path")
    assert Path(old).is_relative_to(archive / "P001")
    plan = plan_move(int(number), "P002", "2")
    with (
        faults("pbl_schemas.intake.move", "session_ids", ZeroDivisionError()),
        pytest.raises(ZeroDivisionError),
    ):
        carry_out(plan)
    assert (video.Video.fetch1("video_path"), len(list(archive.rglob("*.mp4")))) == (old, 1)
    carry_out(plan)
    (now,) = archive.rglob("*.mp4")
    assert now.is_relative_to(archive / "P002" / "2")
    assert video.Video.fetch1("video_path") == str(now)
    assert now.read_bytes() == content
    assert not (archive / "P001").exists()
    assert {r["subject"] for r in lab.Subject().to_dicts()} == {"P001", "P002"}


def test_a_method_from_a_file_is_registered_once_and_used_by_its_name(tables, tmp_path):
    path = chain.small_video(tmp_path, "walk")
    register(path, subject="P002", session_label="2026-03-02")
    file = tmp_path / "slow.json"
    file.write_text(json.dumps({"base": METHODS.default, "max_iterations": 7}), encoding="utf-8")
    try:
        assert "slow-v1: registered as a fit method" in pbl("method", "add", file).out
        assert "slow-v1: known already" in pbl("method", "add", file).out
        file.write_text(json.dumps({"base": METHODS.default, "max_iterations": 8}), encoding="utf-8")
        assert "slow-v2: registered" in pbl("method", "add", file).out
        assert keys_named("fit_method", "slow") == ["slow-v2", "slow-v1"]
        assert outcomes(ingest([path], VisitRecord("P002", "2026-03-02"), Methods(fit="slow-v1"))) == ["updated"]
        populate()
        assert {r["fit_method"] for r in fit.SessionFit().to_dicts()} > {"slow-v1"}
        # Short: the newest version that has results, which is not the newest one.
        assert with_keys({"fit_method": "slow", "subject": "P002"}) == {"fit_method": "slow-v1", "subject": "P002"}
        out = tmp_path / "x"
        done = pbl("export", "--subject", "P002", "--fit-method", "slow", "--to", "csv", "--out", out)
        assert done.code == 0, done.err
        plan = pbl("reprocess", "--table", "SessionFit", "--method", "slow").out
        assert "1 rows of SessionFit would be deleted" in plan
        assert "--yes" in plan
        assert pbl("reprocess", "--table", "SessionFit", "--method", "slower").error_code == "SOLVER_UNKNOWN"
        with pytest.raises(PblError, match="NORM_UNKNOWN"):
            with_keys({"norm": "nobody"})
    finally:
        (fit.FitMethod & {"fit_method_name": "slow"}).delete(prompt=False)


def test_all_lists_and_filters_take_every_kind_of_row(tables: None, tmp_path: Path):
    video_id, _ = register(*(chain.small_video(tmp_path, n, n=60) for n in "ab"), session_label="2026-03-01")
    visit = new_visit("2026-04-01", "P002")  # without recordings
    kinds = [name.partition(".")[2] for name in texts.catalogue() if name.startswith("decided.")]
    assert len(kinds) > 10
    about = dict.fromkeys((*gdi.SessionGdi.primary_key, "check", "computed"), "x") | {"qc_no": 1}
    for kind in kinds:
        for of in ({"session_id": visit}, {"video_id": video_id}, {}):
            review_decisions.record(kind, "A", about, {}, {}, "", **of)
    review_decisions.mark_not_usable(video_id, "helped")
    for of, number in (("session_id", visit), ("video_id", video_id)):
        review_decisions.record_viewing(of, number, "page", "A")
    refused = study_sheets.add_instrument(
        {
            "instrument": "FAC",
            "instrument_name": "FAC",
            "instrument_unit": "points",
            "higher_is_better": "yes",
            "ordinal": "yes",
        },
        "A",
    )
    assert not refused
    form = visit_forms.scores_form(visit)
    assert not visit_forms.enter_scores(visit, {"role": "pre", "FAC": "3"}, "A", form.seen)[1]
    people = {"--subject": "P002", "--population": "unknown", "--project": "default"}
    of_visits = {**people, "--session": "2026-04-01"}
    lists = {
        "subjects": people,
        "visits": of_visits,
        "changes": people,
        "videos": {**of_visits, "--activity": "walking"},
    }
    for name, filters in {**lists, "decisions": of_visits, "looks": of_visits}.items():
        for given in ([], *([option, value] for option, value in filters.items()), ["--subject", "nobody"]):
            done = pbl("list", name, "--json", *given)
            assert done.code == 0, (name, given, done.err)
            if not given and name == "decisions":
                about = [(d["what"], d["subject"]) for d in json.loads(done.out)]
                assert {(kind, who) for kind in kinds for who in ("P001", "P002", None)} <= set(about)
                assert ("instrument", None) in about
    for role in ("", "pre"):
        for state in ("", *visit_list.STATES):
            for quality in ("", *visit_list.OUTCOMES):
                visit_list.visit_page(visit_list.Filter("P0", "", role, quality, state))
    (study.ClinicalScore & {"instrument": "FAC"}).delete(prompt=False)
    (study.ClinicalInstrument & {"instrument": "FAC"}).delete(prompt=False)  # methods and instruments stay otherwise
