"""The tables, from a file to a visit's measures, on the embedded database."""

import dataclasses
import json
import os
import platform
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pymysql
import pytest
from click.testing import CliRunner

import pbl_pipeline.gait
import pbl_pipeline.keypoints
import pbl_pipeline.tracking
import pbl_pipeline.video
import pbl_schemas
import pbl_workers.populate
from docs_site import table_map
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import SessionFit, TrialFit
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.qc import Check
from pbl_pipeline.video import Camera
from pbl_schemas import fit, gait, gdi, keypoints, lab, load_visit, qc, reading, session, tracking, video
from pbl_schemas.decisions.candidates import candidates, write_sheet
from pbl_schemas.decisions.review_decisions import decide_person
from pbl_schemas.intake import Methods, VisitRecord, ingest
from pbl_schemas.method_rows import resolve_method
from pbl_schemas.plan import plan_fit_sets
from pbl_schemas.reading import frames
from pbl_schemas.reading.status import pipeline_status
from pbl_workers.populate import populate
from tests import Environment, Faults, StandIn, not_none
from tests.command import pbl
from tests.database import embedded_only
from tests.rows import register, remove_all
from tests.walking_fit import walking_fit

from . import chain
from .jobs import hold, jobs_left

ROOT = Path(__file__).resolve().parents[2]


def errors(run) -> dict[str, dict[str, int]]:
    return {t.table: t.errors for t in run.tables if t.errors}


def camera_of(number: int) -> Camera:
    """The camera that the keypoints of the session's video of this number (from 0) were computed with."""
    return not_none(load_visit({"subject": "P001"}).recordings[number].keypoints).camera


def done(run) -> dict[str, int]:
    return {t.table: t.done for t in run.tables}


def still(trial: TrialFit) -> TrialFit:
    """Return a trial as long as this one, of a person who stands."""
    return walking_fit(trial.joint_names, trial.body_sha256, name=trial.name, n_frames=len(trial.time_s), walks=False)


@pytest.fixture
def select_tracking(tables: None) -> Iterator[Callable[..., None]]:
    """A call that also selects another tracking method for the only video: its name, and what it has other."""
    names: list[dict[str, str]] = []
    (method,) = tracking.TrackingMethod.to_dicts(limit=1)

    def select(name: str, **other: int) -> None:
        params = {**method["tracking_params"], **other}
        row = {"tracking_method_name": name, "tracking_method_version": 1, "tracking_params": params}
        sha = Paramset("tracking", name, 1, params).hash
        tracking.TrackingMethod.insert1({"tracking_method": f"{name}-v1", **row, "tracking_method_sha": sha})
        (selection,) = tracking.TrackingSelection.to_dicts(limit=1)
        tracking.TrackingSelection.insert1({**selection, "tracking_method": f"{name}-v1"})
        names.append({"tracking_method_name": name})

    yield select
    remove_all()
    (tracking.TrackingMethod & names).delete(prompt=False)


# ------------------------------------------------------------------------------------------------ the whole chain
def test_a_bad_file_leaves_one_error_row_while_the_others_finish(tables: None, tmp_path: Path):
    good = [chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2", n=210)]
    (tmp_path / "notes.mp4").write_text("not a video")
    register(*good, tmp_path / "notes.mp4", session_label="2026-03-01")
    run = populate()
    assert errors(run) == {"VideoInfo": {"VIDEO_NOT_A_VIDEO": 1}}
    assert done(run) == {
        "VideoInfo": 2,
        "Tracking": 2,
        "SubjectChoice": 2,
        "Keypoints": 2,
        "TrialInput": 2,
        "SessionFit": 1,
        "GaitEvents": 2,
        "GaitCycle": 2,
        "Spatiotemporal": 2,
        "GDI": 2,
        "SessionGdi": 1,
        "SessionQc": 1,
        "Kinetics": 1,
        "KinematicError": 0,
        "Deidentified": 0,
    }
    assert fit.SessionFit.fetch1("fit_iterations", "fit_converged", "fit_result") == (7, True, "small_step")
    assert set(fit.SessionFit.Trial.to_arrays("trial_orientation")) == {"assumed: level"}
    assert [r["trial_clock_offset"] for r in fit.SessionFit.Trial.to_dicts()] == [None, None]
    (row,) = pipeline_status().errors
    assert (row.table, row.code, row.about) == ("VideoInfo", "VIDEO_NOT_A_VIDEO", "notes.mp4")
    assert row.next_step
    assert "Traceback" in row.stack
    assert jobs_left() == {"VideoInfo": {"error": 1}}
    # What was stored is what the library made: test_visit_contract.py compares all but these.
    walk = load_visit({"subject": "P001"}).fitted[0]
    tracked = reading.load_tracking({"video_id": walk.number})
    np.testing.assert_allclose(tracked.persons[1].box_px, chain.track_people(good[0]).persons[1].box_px, rtol=1e-6)
    trial = not_none(walk.fit)
    assert (trial.time_s.dtype, trial.qpos.dtype) == (np.float64, np.float32)
    # What the synthetic walker does is what the rows say: a stride of 1.1 s.
    (visit,) = frames.session_summary().to_dict("records")
    assert visit["session_stride_time"] == pytest.approx(1.1, abs=0.01)
    assert visit["session_cadence"] == pytest.approx(120 / 1.1, abs=1.0)
    assert np.isfinite(visit["session_gdi"])
    assert (visit["subject"], visit["session_label"], visit["fit_set_n"]) == ("P001", "2026-03-01", 2)
    assert visit["qc_outcome"] == "WARN"
    assert "residual_3d_cm" in visit["qc_worst"]
    assert set(frames.trial_summary()["trial_orientation"]) == {"assumed: level"}
    assert len(frames.trial_summary()) == 2
    assert set(frames.video_summary()["choice_status"]) == {"CHOSEN"}
    assert "PASS" not in set(frames.quality_summary()["qc_check_outcome"])
    again = populate()
    assert not again.did_something
    assert set(done(again).values()) == {0}
    assert not errors(again)


def test_nobody_walks_and_nobody_there(tables: None, tmp_path: Path, change_fits: Callable[..., None]):
    change_fits(lambda fits: dataclasses.replace(fits, trials=tuple(map(still, fits.trials))))
    register(chain.small_video(tmp_path, "stands"), chain.small_video(tmp_path, "empty", people="nobody"))
    run = populate()
    assert not errors(run)
    empty = {t.table: t.empty for t in run.tables if t.empty}
    of_chain = ("SubjectChoice", "GaitEvents", "Spatiotemporal", "GDI", "SessionGdi", "Kinetics")
    assert empty == dict.fromkeys(of_chain, 1)
    shown = {(e.table, e.about): e.reason for e in pipeline_status().empty}
    assert shown == {
        ("SubjectChoice", "empty_nobody.mp4"): "No person was found in the video.",
        ("GaitEvents", "stands.mp4"): gait.GaitEvents.fetch1("events_reason"),
    }
    assert gdi.SessionGdi.fetch1("session_gdi", "session_cadence") == (None, None)
    assert gdi.SessionGdi.fetch1("session_reason")
    assert qc.SessionQc.fetch1("qc_outcome") == "EMPTY"
    assert len(keypoints.Keypoints()) == 1
    assert not_none(load_visit({"subject": "P001"}).measures).status == "EMPTY"
    assert not populate().did_something


def test_one_recording_without_gait_does_not_empty_the_visit(
    tables: None, tmp_path: Path, change_fits: Callable[..., None]
):
    def one_stands(fits: SessionFit) -> SessionFit:
        walks, other = fits.trials
        return dataclasses.replace(fits, trials=(walks, still(other)))

    change_fits(one_stands)
    register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "stands", n=210))
    populate()
    assert gdi.SessionGdi.fetch1("session_status") == "PASS"
    outcome, names = qc.SessionQc.fetch1("qc_outcome", "qc_worst")
    assert outcome == "WARN"
    assert "walking" in names.split(", ")


def test_a_failed_fit_gives_no_measures_in_tables_and_files(
    tables: None, tmp_path: Path, change_fits: Callable[..., None]
):
    bad = Check("residual_3d_cm", "FAIL", 21.0, 6.0, "the body and the 3D points disagree")
    change_fits(lambda fits: dataclasses.replace(fits, qc=(bad,)))
    register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2", n=210))
    assert not errors(populate())
    why = "the fit failed its check residual_3d_cm"
    assert gdi.SessionGdi.fetch1("session_gdi", "session_cadence") == (None, None)
    assert gdi.SessionGdi.fetch1("session_gdi_reason") == why
    assert set(gait.Spatiotemporal.to_arrays("measures_reason")) == {why}
    assert set(gdi.GDI.to_arrays("gdi_reason")) == {why}
    rows = gait.GaitCycle.Cycle.to_dicts()
    assert {gait.cycle_of_row(row, "").excluded for row in rows} == {why}
    assert not any(row["cycle_used"] for row in rows)
    assert qc.SessionQc.fetch1("qc_outcome") == "FAIL"
    assert {(e.table, e.about): e.reason for e in pipeline_status().empty} == {
        ("Spatiotemporal", "walk1.mp4"): why,
        ("Spatiotemporal", "walk2.mp4"): why,
    }
    found = load_visit({"subject": "P001"})
    judged = not_none(found.judged)
    fresh = pbl_pipeline.gait.gait_metrics(
        [r.fit for r in found.fitted if r.fit is not None], fit_checks=found.fit_checks
    )
    assert judged.to_dict()["session"]["outcome"] == "FAIL"
    judging = ("outcome", "qc", "qc_before_gait")
    assert {k: v for k, v in judged.to_dict()["session"].items() if k not in judging} == {
        k: v for k, v in fresh.to_dict()["session"].items() if k not in judging
    }


# ------------------------------------------------------------------------------------------------------- ingest
def test_a_moved_file_is_computed_without_being_told(tables: None, tmp_path: Path):
    first = chain.small_video(tmp_path, "walk")
    register(first)
    populate(["VideoInfo"])
    moved = first.rename(tmp_path / "moved.mp4")
    assert errors(populate(["Tracking"])) == {"Tracking": {"VIDEO_MISSING": 1}}
    (result,) = ingest([moved], VisitRecord("P001"))
    assert result.status == "moved"
    assert video.Video.fetch1("video_path") == str(moved)
    assert not pipeline_status().errors
    assert done(populate(["Tracking"])) == {"Tracking": 1}


def test_a_registered_video_takes_a_camera_and_further_methods(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    (number,) = register(path)
    populate()
    assert camera_of(0).source.startswith("guess")
    tracked = tracking.Tracking.fetch1("tracking_computed")
    camera = chain.camera_file(tmp_path)
    (result,) = ingest([path], VisitRecord("P001", camera_file=camera, activity="running"))
    assert (result.status, result.video_id) == ("updated", number)
    assert "1 of" in result.note
    assert "keypoints" in result.note.lower()
    assert "activity is running now" in result.note
    assert len(keypoints.Keypoints()) == len(fit.SessionFit()) == len(fit.FitSet()) == len(qc.SessionQc()) == 0
    assert tracking.Tracking.fetch1("tracking_computed") == tracked
    assert not errors(populate())
    assert camera_of(0).matrix[0, 0] == 900
    assert len(qc.SessionQc()) == 1
    # The same camera again changes nothing.
    (result,) = ingest([path], VisitRecord("P001", camera_file=camera))
    assert (result.status, result.note.endswith("nothing was inserted")) == ("known", True)
    names = {r["fit_method_name"] for r in fit.FitMethod.to_dicts()}
    other = sorted(names - {(fit.FitPlan * fit.FitMethod).fetch1("fit_method_name")})[0]
    (result,) = ingest([path], VisitRecord("P001"), Methods(fit=other))
    assert result.status == "updated"
    assert f"FitPlan {other}" in result.note
    assert len(fit.FitPlan()) == 2
    assert done(populate())["SessionFit"] == 1
    assert len(fit.SessionFit()) == 2


def test_refused_files_do_not_hold_up_the_others(tables: None, tmp_path: Path):
    (tmp_path / "empty.mp4").touch()
    paths = [tmp_path / "absent.mp4", tmp_path / "empty.mp4", tmp_path, chain.small_video(tmp_path, "walk")]
    results = ingest(paths, VisitRecord("P001"))
    codes = [r.error.code if r.error else r.status for r in results]
    assert codes == ["VIDEO_MISSING", "VIDEO_EMPTY", "VIDEO_MISSING", "registered"]


@pytest.mark.parametrize("subject", ["Jane Doe", "", "x" * 33, "-p"])
def test_a_code_that_could_be_a_name_is_refused(tables: None, tmp_path: Path, subject: str):
    with pytest.raises(PblError, match="USAGE"):
        ingest([tmp_path / "a.mp4"], VisitRecord(subject))


@pytest.mark.parametrize("label", [{"session_label": "s" * 65}, {"project": "p" * 33}, {"activity": "a" * 33}])
def test_labels_that_do_not_fit_are_refused(tables: None, tmp_path: Path, label: dict):
    path = chain.small_video(tmp_path, "walk")
    with pytest.raises(PblError, match="USAGE"):
        ingest([path], VisitRecord("P001", **label))


def test_odd_tags_of_a_file_are_cut_not_an_error(tables: None, tmp_path: Path, stand_in: StandIn):
    original = pbl_pipeline.video.probe

    def odd(path):
        fields = ("container", "codec", "pixel_format", "recorded_utc", "make", "model")
        return dataclasses.replace(original(path), **dict.fromkeys(fields, "\U0001f4f1" * 300))

    stand_in(probe=odd)
    register(chain.small_video(tmp_path, "walk"))
    run = populate(["VideoInfo"])
    assert not errors(run)
    assert video.VideoInfo.fetch1("phone_model", "codec") == ("\U0001f4f1" * 64, "\U0001f4f1" * 32)


def test_one_persons_number_for_several_videos_is_refused(tables: None, tmp_path: Path):
    with pytest.raises(PblError, match="USAGE"):
        ingest([tmp_path / "a.mp4", tmp_path / "b.mp4"], VisitRecord("P001", person=2))


def test_a_registered_person_detector_becomes_a_method(tables: None, tmp_path: Path, environment: Environment):
    """Its parameters freeze the hashes of graph and spec; another spec under its name is another version."""
    environment(PBL_MODELS=tmp_path / "models")
    folder = tmp_path / "models" / "crowd"
    folder.mkdir(parents=True)
    entry = {"name": "images", "width": 416, "height": 416, "layout": "NCHW", "mean": [0, 0, 0], "std": [1, 1, 1]}
    spec = {"name": "crowd", "kind": "person_detector", "sha256": "1" * 64, "licence": "MIT", "source": "a lab"}
    spec |= {"input": {**entry, "colour": "BGR"}, "outputs": {"boxes": "rows"}}
    (folder / "model.json").write_text(json.dumps(spec))
    assert (
        resolve_method(tracking.TrackingMethod, "crowd")
        == resolve_method(tracking.TrackingMethod, "crowd")
        == "crowd-v1"
    )
    (folder / "model.json").write_text(json.dumps(spec | {"input": {**entry, "colour": "RGB"}}))
    assert resolve_method(tracking.TrackingMethod, "crowd") == "crowd-v2"
    path = chain.small_video(tmp_path, "walk")
    (row,) = ingest([path], VisitRecord("P001"), Methods(tracking="crowd"))
    assert (tracking.TrackingSelection & {"video_id": row.video_id}).fetch1("tracking_method") == "crowd-v2"
    populate(["VideoInfo", "Tracking"])
    assert len(tracking.Tracking & {"video_id": row.video_id, "tracking_method": "crowd-v2"}) == 1
    assert resolve_method(tracking.TrackingMethod, "blazepose-tiles") == "blazepose-tiles-v5"


def test_unknown_methods_are_refused_with_the_names_there_are(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    for methods in (Methods(tracking="x"), Methods(fit="x"), Methods(norm="x")):
        with pytest.raises(PblError, match=r"expected: one of \w+"):
            ingest([path], VisitRecord("P001"), methods)
    assert len(video.Video()) == 0


def test_a_calibration_is_stored_once_and_used(tables: None, tmp_path: Path):
    camera = chain.camera_file(tmp_path, k1=0.1)
    paths = chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2")
    register(*paths, camera_file=camera)
    assert lab.CameraCalibration.fetch1("camera_fx", "camera_origin") == (900.0, "measured")
    populate(["VideoInfo", "Tracking", "SubjectChoice", "Keypoints"])
    stored = camera_of(1)
    assert stored.matrix[0, 0] == 900
    assert stored.distortion.tolist() == [0.1, 0, 0, 0, 0]
    assert stored.source.startswith("measured: ")


# ------------------------------------------------------------------------------------------- who is measured
def test_two_alike_wait_for_a_choice_and_the_rest_goes_on(tables: None, tmp_path: Path):
    alike, clear = register(
        chain.small_video(tmp_path, "both", people="two alike"), chain.small_video(tmp_path, "clear")
    )
    run = populate()
    assert not errors(run)
    assert {t.table: t.waiting for t in run.tables}["SubjectChoice"] == 1
    assert keypoints.Keypoints.to_arrays("video_id").tolist() == [clear]
    state = pipeline_status()
    assert {t.table: (t.pending, t.waiting) for t in state.tables}["Keypoints"] == (0, 0)
    (waiting,) = state.waiting
    assert (waiting.video_id, waiting.persons) == (alike, [1, 2])
    assert not populate().did_something
    with pytest.raises(PblError, match="SUBJECT_UNKNOWN_PERSON"):
        decide_person(alike, 7)
    first_fit = fit.SessionFit.keys()
    decide_person(alike, 2)
    run = populate()
    assert not errors(run)
    assert keypoints.Keypoints.to_arrays("keypoints_person_id", order_by="video_id").tolist() == [2, 1]
    # Another video in the session is another set; the old fit stays, but is no longer the current one.
    assert len(fit.SessionFit()) == 2
    assert (fit.FitSelection & {"fit_current": True}).keys() != first_fit
    assert len(fit.FitSelection & {"fit_current": True}) == 1
    assert len(frames.session_summary()) == 1
    assert frames.session_summary()["fit_set_n"].tolist() == [2]


def test_the_picture_of_the_people_is_stored_where_somebody_has_to_choose(tables: None, tmp_path: Path):
    alike, clear, nobody = register(
        chain.small_video(tmp_path, "both", people="two alike"),
        chain.small_video(tmp_path, "clear"),
        chain.small_video(tmp_path, "empty", people="nobody"),
    )
    populate(["VideoInfo", "Tracking", "SubjectChoice"])
    stored = {r["video_id"]: r["contact_sheet"] is not None for r in tracking.SubjectChoice.to_dicts()}
    assert stored == {alike: True, clear: False, nobody: False}
    (about,) = candidates(alike)
    assert (about.status, about.chosen, sorted(about.scores)) == ("NEEDS_CHOICE", None, [1, 2])
    assert "A person has to choose" in about.reason
    stored_bytes = write_sheet(about, tmp_path / "people.jpg").read_bytes()
    assert cv2.imdecode(np.frombuffer(stored_bytes, np.uint8), cv2.IMREAD_COLOR) is not None
    # The stored picture does not need the video; a drawn one does.
    (tmp_path / "both_alike.mp4").rename(tmp_path / "gone.mp4")
    assert write_sheet(about, tmp_path / "again.jpg").read_bytes() == stored_bytes
    with pytest.raises(PblError, match="VIDEO_MISSING"):
        write_sheet(about, tmp_path / "again.png")
    with pytest.raises(PblError, match="FILE_UNWRITABLE"):
        write_sheet(about, tmp_path / "no folder" / "people.jpg")
    # Where the choice was clear the picture is drawn when it is asked for.
    (chosen,) = candidates(clear)
    assert (chosen.status, chosen.chosen) == ("CHOSEN", 1)
    assert cv2.imread(str(write_sheet(chosen, tmp_path / "clear.png"))) is not None
    with pytest.raises(PblError, match="TRACK_NO_PERSON"):
        write_sheet(candidates(nobody)[0], tmp_path / "nobody.jpg")
    (waiting,) = pipeline_status().waiting
    assert waiting.look == f"pbl choose {alike} --sheet persons_{alike}.jpg"
    with pytest.raises(PblError, match="DB_NOT_FOUND"):
        candidates(register(chain.small_video(tmp_path, "later"))[0])


def test_a_decision_triggers_exactly_the_rows_that_depend_on_it(tables: None, tmp_path: Path):
    first, second = register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2", n=210))
    (apart,) = register(chain.small_video(tmp_path, "other"), subject="P002")
    populate()

    def computed() -> dict[str, dict]:
        origin = {t: next(c for c in t.heading.names if c.endswith("_computed")) for t in pbl_schemas.computed_tables()}
        return {
            t.__name__: {tuple(r[k] for k in t.primary_key): r[column] for r in t.to_dicts()}
            for t, column in origin.items()
        }

    before = computed()
    decide_person(first, 2)
    left = computed()
    # Nothing of the other subject, nothing above the choice, nothing of the session's other video up to its input.
    for name in ("VideoInfo", "Tracking"):
        assert left[name] == before[name]
    for name in ("SubjectChoice", "Keypoints", "TrialInput"):
        assert {k for k in before[name] if k not in left[name]} == {k for k in before[name] if k[0] == first}, name
    gone = {n: set(before[n]) - set(left[n]) for n in before}
    assert all(gone[n] for n in ("SessionFit", "GaitEvents", "GaitCycle", "GDI", "SessionGdi", "SessionQc"))
    fits = (fit.FitSet.Video & {"video_id": apart}).to_arrays("fit_set").tolist()
    assert fits
    assert all(fits[0] not in k for keys in gone.values() for k in keys)
    run = populate()
    assert not errors(run)
    assert {n: done(run)[n] for n in ("Tracking", "SubjectChoice", "Keypoints", "SessionFit", "SessionQc")} == {
        "Tracking": 0,
        "SubjectChoice": 1,
        "Keypoints": 1,
        "SessionFit": 1,
        "SessionQc": 1,
    }
    assert second in tracking.SubjectChoice.to_arrays("video_id")


def test_a_decision_wins_and_recomputes_what_was_another_persons(tables: None, tmp_path: Path):
    (number,) = register(chain.small_video(tmp_path, "walk"))
    populate()
    old = keypoints.Keypoints.fetch1("focal_length", "keypoints_computed", "keypoints_person_id")
    assert old[2] == 1
    deleted = decide_person(number, 2)
    assert sum(deleted.values()) >= 10
    assert len(keypoints.Keypoints()) == len(fit.SessionFit()) == len(fit.FitSet()) == len(qc.SessionQc()) == 0
    assert len(tracking.Tracking()) == 1
    run = populate()
    assert done(run)["Tracking"] == 0
    assert done(run)["SessionQc"] == 1
    assert tracking.SubjectChoice.fetch1("choice_status", "chosen_person_id") == ("MANUAL", 2)
    assert keypoints.Keypoints.fetch1("keypoints_person_id") == 2
    # The same decision again changes nothing; a withdrawn one, by any route, is noticed by populate.
    assert decide_person(number, 2) == {}
    tracking.SubjectOverride.delete(prompt=False)
    run = populate()
    assert run.dropped
    assert tracking.SubjectChoice.fetch1("choice_status", "chosen_person_id") == ("CHOSEN", 1)


def test_of_two_trackings_the_one_that_is_meant_is_named(select_tracking: Callable[..., None], tmp_path: Path):
    """Each numbers the people anew: number 2 of one may be number 1 of the other."""
    (number,) = register(chain.small_video(tmp_path, "both", people="two alike"))
    selection = tracking.TrackingSelection.fetch1()
    select_tracking("other", min_hits=4)
    populate(["VideoInfo", "Tracking", "SubjectChoice"])
    with pytest.raises(PblError, match="USAGE") as caught:
        decide_person(number, 2)
    assert "other-v1" in caught.value.expected
    assert not tracking.SubjectOverride()
    asked = {w.next_step for w in pipeline_status().waiting}
    assert asked == {
        f"pbl choose {number} 1|2 --tracking-method {m}" for m in (selection["tracking_method"], "other-v1")
    }
    shown = pbl("choose", number)
    assert all(f"next: {command}" in shown.out for command in asked)
    assert pbl("choose", number, 2, "--tracking-method", "other").code == 0
    assert tracking.SubjectOverride.fetch1("tracking_method", "override_person_id") == ("other-v1", 2)
    (waiting,) = pipeline_status().waiting
    assert selection["tracking_method"] in waiting.next_step
    with pytest.raises(PblError, match="SOLVER_UNKNOWN"):
        decide_person(number, 2, "another-v1")


def test_a_decision_is_carried_to_a_tracking_that_comes_later(
    select_tracking: Callable[..., None], tmp_path: Path, stand_in: StandIn
):
    """The other method numbers the people the other way round; then it does not find the one who was chosen."""
    (number,) = register(chain.small_video(tmp_path, "walk"))
    populate(["VideoInfo", "Tracking", "SubjectChoice"])
    assert tracking.SubjectChoice.fetch1("chosen_person_id") == 1
    decide_person(number, 2)
    populate(["SubjectChoice"])
    found = chain.track_people(tmp_path / "walk.mp4")
    walks, stands = found.persons
    later = {
        "turned": (dataclasses.replace(stands, person_id=1), dataclasses.replace(walks, person_id=2)),
        "without": (walks,),
    }
    first = tracking.TrackingSelection.fetch1()
    for hits, (name, persons) in enumerate(later.items(), 4):
        select_tracking(name, min_hits=hits)
        now = dataclasses.replace(found, persons=persons)
        stand_in(track_people=lambda *a, _now=now, **k: _now)
        assert not errors(populate(["Tracking", "SubjectChoice"]))
    rows = {r["tracking_method"]: r for r in tracking.SubjectChoice.to_dicts()}
    assert (rows["turned-v1"]["choice_status"], rows["turned-v1"]["chosen_person_id"]) == ("CHOSEN", 1)
    assert f"by hand in the tracking {first['tracking_method']}" in rows["turned-v1"]["choice_reason"]
    assert (rows["without-v1"]["choice_status"], rows["without-v1"]["chosen_person_id"]) == ("NEEDS_CHOICE", None)
    assert rows["without-v1"]["contact_sheet"] is not None
    assert not populate(["Tracking", "SubjectChoice"]).did_something


def test_confirming_the_automatic_choice_deletes_nothing(tables: None, tmp_path: Path):
    (number,) = register(chain.small_video(tmp_path, "walk"))
    populate()
    assert tracking.SubjectChoice.fetch1("choice_status", "chosen_person_id") == ("CHOSEN", 1)
    computed = qc.SessionQc.fetch1("qc_computed")
    assert decide_person(number, 1) == {}
    assert tracking.SubjectChoice.fetch1("choice_status", "chosen_person_id") == ("MANUAL", 1)
    assert "by hand" in tracking.SubjectChoice.fetch1("choice_reason")
    assert qc.SessionQc.fetch1("qc_computed") == computed
    assert not populate().did_something
    # By another route than the command it is the same.
    other = register(chain.small_video(tmp_path, "other"))[0]
    populate()
    tracking.set_override({"video_id": other, "tracking_method": tracking.Tracking.to_arrays("tracking_method")[0]}, 1)
    assert not populate().did_something
    assert set(tracking.SubjectChoice.to_arrays("choice_status")) == {"MANUAL"}


def test_a_decision_given_with_the_video_is_checked_when_the_people_are_known(tables: None, tmp_path: Path):
    (number,) = register(chain.small_video(tmp_path, "walk"), person=9)
    assert errors(populate()) == {"SubjectChoice": {"SUBJECT_UNKNOWN_PERSON": 1}}
    decide_person(number, 2)
    assert not errors(populate())
    assert tracking.SubjectChoice.fetch1("choice_status") == "MANUAL"
    with pytest.raises(PblError, match="DB_NOT_FOUND"):
        decide_person(12345, 1)


def test_a_trial_that_cannot_be_fitted_does_not_hold_up_its_session(tables: None, tmp_path: Path, stand_in: StandIn):
    def half_seen(video_path, tracking, person_id, camera, params=None):
        found = chain.detect_keypoints(video_path, tracking, person_id, camera)
        if "cut" not in Path(video_path).stem:
            return found
        return dataclasses.replace(found, confidence=np.zeros_like(found.confidence))

    stand_in(detect_keypoints=half_seen)
    _, good = register(chain.small_video(tmp_path, "cut"), chain.small_video(tmp_path, "whole"))
    run = populate()
    assert errors(run) == {"TrialInput": {"FIT_INPUT": 1}}
    assert fit.SessionFit.Trial.to_arrays("video_id").tolist() == [good]


def test_a_later_video_makes_a_new_set_and_the_old_fit_stays(tables: None, tmp_path: Path):
    register(chain.small_video(tmp_path, "walk1"))
    populate()
    register(chain.small_video(tmp_path, "walk2"))
    run = populate()
    assert (done(run)["SessionFit"], run.planned) == (1, 1)
    current = {r["fit_set_n"]: r["fit_current"] for r in (fit.FitSet * fit.FitSelection).to_dicts()}
    assert current == {1: 0, 2: 1}
    assert len(fit.SessionFit()) == 2
    # Without the later video the first set is current again; nothing has to be computed.
    (video.Video & "video_name='walk2.mp4'").delete(prompt=False, part_integrity="cascade")
    run = populate()
    assert done(run)["SessionFit"] == 0
    assert fit.FitSelection.fetch1("fit_current") == 1


def test_two_planners_take_turns_and_the_second_sees_what_the_first_left(tables: None, tmp_path: Path):
    """The planner waits for another that holds the session, and then counts the trials that there are by then."""
    first, second = register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2"))
    populate(["VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput"])
    fit.FitSet.delete(prompt=False, part_integrity="cascade")  # that run planned them both
    assert len(fit.FitSelection()) == 0
    about = fit.schema.connection.conn_info
    other = pymysql.connect(host=about["host"], port=about["port"], user=about["user"], password=about["passwd"])
    order = []

    def release() -> None:
        time.sleep(1.0)
        with other.cursor() as cursor:
            cursor.execute(f"DELETE FROM {fit.TrialInput.full_table_name} WHERE video_id = {second}")
            cursor.execute(f"DELETE FROM {fit.FitPlan.full_table_name}")
        order.append("other planner done")
        other.commit()

    with other.cursor() as cursor:
        cursor.execute(f"SELECT * FROM {session.Session.full_table_name} FOR UPDATE")
    holder = threading.Thread(target=release)
    holder.start()
    (made,) = plan_fit_sets()
    order.append("planned")
    holder.join()
    other.close()
    assert order == ["other planner done", "planned"]
    assert (fit.FitSet.Video & made).to_arrays("video_id").tolist() == [first]


@pytest.mark.parametrize("waits", [False, True])
def test_several_current_sets_are_repaired(tables: None, tmp_path: Path, waits: bool):
    register(chain.small_video(tmp_path, "walk1"))
    populate()
    register(chain.small_video(tmp_path, "walk2"))
    populate()
    for key in list(fit.FitSelection.keys()):
        fit.FitSelection.update1({**key, "fit_current": True})
    with pytest.raises(PblError, match="USAGE"):
        load_visit({"subject": "P001"})
    if waits:  # a third recording that is not computed yet must not leave the visit without results
        register(chain.small_video(tmp_path, "walk3"))
    assert plan_fit_sets() == []
    assert (fit.FitSet & (fit.FitSelection & {"fit_current": True})).to_arrays("fit_set_n").tolist() == [2]
    assert len(load_visit({"subject": "P001"}).fitted) == 2


# ------------------------------------------------------------------------------------------- errors and stuck jobs
def test_a_missing_or_changed_file_is_an_error_until_it_is_back(tables: None, tmp_path: Path):
    lost, changed = chain.small_video(tmp_path, "lost"), chain.small_video(tmp_path, "changed")
    register(lost, changed)
    kept = lost.read_bytes(), changed.read_bytes()
    lost.unlink()
    changed.write_bytes(kept[1] + b"x")
    assert errors(populate()) == {"VideoInfo": {"VIDEO_MISSING": 1, "VIDEO_CHANGED": 1}}
    lost.write_bytes(kept[0])
    changed.write_bytes(kept[1])
    assert not populate().did_something  # an error row is not tried again by itself
    run = populate(retry_errors=True)
    assert run.retried == 2
    assert done(run)["VideoInfo"] == 2
    assert not pipeline_status().errors


def test_an_error_row_keeps_code_and_next_step_however_long_the_text(tables: None, tmp_path: Path, stand_in: StandIn):
    def fails(path):
        raise PblError(
            "VIDEO_DAMAGED", found="f" * 9000, expected="e" * 9000, next_step="do " + "n" * 9000, key="k" * 9000
        )

    register(chain.small_video(tmp_path, "walk"))
    stand_in(probe=fails)
    assert errors(populate()) == {"VideoInfo": {"VIDEO_DAMAGED": 1}}
    (row,) = pipeline_status().errors
    assert row.next_step.startswith("do nnn")
    assert "f" * 9000 in row.stack


def test_an_unforeseen_error_gets_a_code_too(tables: None, tmp_path: Path, stand_in: StandIn):
    def fails(path):
        raise ZeroDivisionError("somewhere deep")

    register(chain.small_video(tmp_path, "walk"))
    stand_in(probe=fails)
    assert errors(populate()) == {"VideoInfo": {"INTERNAL": 1}}
    (row,) = pipeline_status().errors
    assert "ZeroDivisionError: somewhere deep" in row.found
    assert row.next_step


@pytest.mark.parametrize("signal", [KeyboardInterrupt, SystemExit])
def test_an_interrupt_ends_the_loop_and_puts_the_job_back(
    tables: None, tmp_path: Path, signal: type[BaseException], faults: Faults
):
    register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2"))
    with faults(pbl_pipeline.video, "probe", signal("now")):
        run = populate(["VideoInfo"])
    assert run.interrupted
    counts = video.VideoInfo.jobs.progress()
    assert (counts["pending"], counts["error"], counts["reserved"]) == (2, 0, 0)
    assert done(populate(["VideoInfo"])) == {"VideoInfo": 2}


def test_reservations_of_dead_processes_are_freed_and_others_are_kept(tables: None, tmp_path: Path):
    register(*(chain.small_video(tmp_path, f"walk{i}") for i in range(4)))
    jobs = video.VideoInfo.jobs
    jobs.refresh(delay=-1)
    dead, own, alive, elsewhere = jobs.to_arrays("video_id", order_by="video_id").tolist()
    here, gone = platform.node(), 2**22 - 3
    for number, host, pid in (
        *((dead, here, gone), (own, here, os.getpid()), (alive, here, os.getppid())),
        (elsewhere, "another-host", gone),
    ):
        hold(number, host, pid)
    run = populate(["VideoInfo"])
    assert (run.freed, done(run)) == (2, {"VideoInfo": 2})
    left = jobs.reserved.to_arrays("video_id", order_by="video_id")
    assert left.tolist() == [alive, elsewhere]


def test_only_errors_that_say_nothing_about_the_video_are_tried_again(tables: None, tmp_path: Path):
    register(*(chain.small_video(tmp_path, f"walk{i}") for i in range(3)))
    jobs = video.VideoInfo.jobs
    jobs.refresh(delay=-1)
    messages = ("LostConnectionError: gone", "PblError: VIDEO_DAMAGED: ...", "DataJointError: fetch1 found nothing")
    for key, message in zip(jobs.keys(order_by="video_id"), messages, strict=True):
        jobs.update1({**key, "status": "error", "error_message": message})
    run = populate(["VideoInfo"])
    # A row that was missing may be missing for good: that is counted in its job, not tried again for ever.
    assert (run.freed, done(run)) == (1, {"VideoInfo": 1})
    assert sorted(e.code for e in pipeline_status().errors) == ["INTERNAL", "VIDEO_DAMAGED"]


def test_datajoints_own_populate_computes_the_whole_chain(tables: None, tmp_path: Path):
    """As somebody who knows DataJoint and nothing of ours would do it: no planning by hand, no worker."""
    register(chain.small_video(tmp_path, "walk1"), chain.small_video(tmp_path, "walk2"))
    for table in pbl_schemas.computed_tables():
        found = table.populate(reserve_jobs=True, suppress_errors=True)
        assert found["error_list"] == [], table.__name__
    assert len(fit.SessionFit()) == len(gdi.SessionGdi()) == 1
    assert len(fit.SessionFit.Trial()) == 2
    assert not populate().did_something
    fit.SessionFit.delete(prompt=False)
    fit.SessionFit.populate()  # without a queue too
    assert len(fit.SessionFit()) == 1


def test_limit_and_unknown_tables(tables: None, tmp_path: Path):
    register(*(chain.small_video(tmp_path, f"walk{i}") for i in range(3)))
    assert done(populate(["videoinfo"], limit=2)) == {"VideoInfo": 2}
    assert done(populate(["VideoInfo"], limit=2)) == {"VideoInfo": 1}
    with pytest.raises(PblError, match="USAGE"):
        populate(["VideoInf"])


# -------------------------------------------------------------------------------------------------- definitions
def test_every_float_column_states_its_unit(declared: None):
    missing = [
        f"{name}.{a.name}"
        for name, cls in table_map.tables().items()
        for a in cls.heading.attributes.values()
        if (a.original_type or a.type) in ("float32", "float64") and not re.search(r"\([^)]+\)", a.comment)
    ]
    assert not missing


def test_every_computed_table_states_its_origin(declared: None):
    for table in pbl_schemas.computed_tables():
        prefix = table_map.origin_prefix(table)
        assert prefix, table.__name__
        columns = {prefix + c for c in ("code_version", "method_hash", "model_sha256", "host", "seconds", "computed")}
        assert columns <= set(table.heading.names), table.__name__


def test_no_two_tables_share_a_secondary_attribute(declared: None):
    """DataJoint refuses joins of tables that do; foreign keys are shared on purpose."""
    owner: dict[str, str] = {}
    for name, cls in table_map.tables().items():
        own = {c[0] for c in table_map.columns(cls) if not c[3]}
        for column in own:
            assert column not in owner, f"{column} of {name} is in {owner.get(column)} too"
            owner[column] = name


def test_the_map_is_what_the_database_holds(declared: None):
    """The parsed references and columns are DataJoint's own."""
    everything = table_map.tables()
    by_full_name = {cls.full_table_name: name for name, cls in everything.items()}
    for name, cls in everything.items():
        parents = {by_full_name[p] for p in cls().parents()}
        assert set(table_map.references(name, cls)) == parents, name
        declared_columns = {c[0] for c in table_map.columns(cls)}
        assert declared_columns <= set(cls.heading.names), name
        inherited = {a for p in parents for a in everything[p].heading.primary_key} | set(table_map.renamed(cls))
        assert set(cls.heading.names) - declared_columns <= inherited, name


def test_the_page_of_the_tables_is_up_to_date():
    page = (ROOT / "docs" / "tables.md").read_text()
    assert page == table_map.table_map(), "run: python -m docs_site.table_map > docs/tables.md"


def test_methods_are_frozen(declared: None):
    from pbl_schemas import methods
    from pbl_schemas.method_rows import insert_methods

    before = len(tracking.TrackingMethod()), len(fit.BodyModel()), len(gdi.NormativeSet())
    methods.insert_all()
    assert (len(tracking.TrackingMethod()), len(fit.BodyModel()), len(gdi.NormativeSet())) == before
    known = pbl_pipeline.tracking.METHODS.find()
    other = dataclasses.replace(known.params, min_score=0.99)
    edited = pbl_pipeline.tracking.METHODS.make(known.name, known.version, other)
    with pytest.raises(PblError, match="new version"):
        insert_methods(tracking.TrackingMethod, [edited])


# ----------------------------------------------------------------------------------------------------- commands
@embedded_only
def test_the_demo_stops_when_it_is_interrupted(tables: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from pbl_pipeline import assets
    from pbl_workers.cli.demo import demo

    path = chain.small_video(tmp_path, "walk")
    camera = chain.camera_file(tmp_path)
    monkeypatch.setattr(assets, "fetch", lambda name: camera if name == "demo_camera" else path)
    monkeypatch.setattr(pbl_workers.populate, "populate", lambda: pbl_workers.populate.Run([], interrupted=True))
    result = CliRunner().invoke(demo, ["--out", str(tmp_path / "out")])
    assert result.exit_code == 130, result.output
    assert "[5/5]" not in result.output
    assert "interrupted" in result.output


def test_the_commands_from_file_to_summary(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "both", people="two alike")
    (tmp_path / "notes.mp4").write_text("not a video")
    first = pbl("ingest", path, tmp_path / "notes.mp4", "--subject", "P001")
    assert first.code == 0, first.err
    number = int(re.findall(r"video_id (\d+): both_alike.mp4 registered", first.out)[0])
    again = pbl("ingest", path, "--subject", "P001", "--person", "2")
    assert (again.code, f"pbl choose {number} 2" in again.out) == (0, True)
    assert pbl("ingest", tmp_path / "absent.mp4", "--subject", "P001").code == 1
    run = pbl("populate")
    assert run.code == 0, run.err
    assert "VIDEO_NOT_A_VIDEO" in run.out
    assert "pbl choose" in run.out
    shown = pbl("status").out
    assert "VIDEO_NOT_A_VIDEO" in shown
    assert f"pbl choose {number} 1|2" in shown
    assert f"pbl choose {number} --sheet persons_{number}.jpg" in shown
    look = pbl("choose", number, "--sheet", tmp_path / "people.jpg")
    assert (look.code, (tmp_path / "people.jpg").is_file()) == (0, True), look.err
    assert "person 1: score" in look.out
    assert "NEEDS_CHOICE" in look.out
    assert "deleted" not in look.out
    assert "deleted 1 rows of" in pbl("choose", number, 2).out
    assert re.search(r"SessionQc +1", pbl("populate").out)
    assert "nothing to do" in pbl("populate").out
    assert '"code": "VIDEO_NOT_A_VIDEO"' in pbl("status", "--json").out
    assert len(session.Session()) == 1
