"""A folder of bad videos and one good one, through the tables and through files: the real detector, the real fit.

One populate for all of them.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pbl_schemas
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait.events import load_events
from pbl_pipeline.video import probe
from pbl_schemas import fit, gait, gdi, keypoints, qc, tracking, video
from pbl_schemas.reading import frames
from tests.command import Done, pbl
from tests.rows import remove_all
from tests.videos import constant_rate, numbered_frames, write_video

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("points_seen_once")]

EMPTY = "niemand ist da, früh.mp4"


@pytest.fixture(scope="module")
def tables(database: Path) -> Iterator[None]:
    pbl_schemas.activate()
    remove_all()
    yield
    remove_all()


@pytest.fixture(scope="module")
def ingested(tables: None, folder: Path) -> dict[str, Done]:
    """Three visits: she walks, she stands, and everything that cannot work, with the walking video once more."""
    more = ("--subject", "P001")
    gone = folder.parent / "gone.mp4"
    gone.write_bytes((folder / "walking.mp4").read_bytes() + b"\0")
    bad = [*(folder / n for n in ("notes.mp4", "nothing.mp4", "truncated.mp4", EMPTY, "two.mp4", "short.mp4")), gone]
    done = {
        "walks": pbl("ingest", folder / "walking.mp4", "--session", "walks", *more),
        "stands": pbl("ingest", folder / "standing.mp4", "--session", "stands", *more),
        "bad": pbl("ingest", *bad, "--session", "bad", *more),
        "again": pbl("ingest", folder / "copy of walking.mp4", folder / "walking.mp4", "--session", "again", *more),
    }
    gone.unlink()
    return done


@pytest.fixture(scope="module")
def populated(ingested: dict[str, Done]) -> Done:
    return pbl("populate")


@pytest.fixture(scope="module")
def status(populated: Done) -> dict:
    assert populated.code == 0, populated.err
    return json.loads(pbl("status", "--json").out)


# --------------------------------------------------------------------------------------------------- the tables
def test_ingest_takes_each_file_once_and_refuses_an_empty_one(ingested):
    assert ingested["walks"].code == ingested["stands"].code == 0
    assert ingested["bad"].code == 1
    assert ingested["bad"].error_code == "VIDEO_EMPTY"
    assert ingested["bad"].out.count("registered") == 6
    assert ingested["again"].code == 0
    assert ingested["again"].out.count("known") == 2
    names = sorted(video.Video.to_arrays("video_name").tolist())
    assert names == sorted(
        ["walking.mp4", "standing.mp4", "notes.mp4", "truncated.mp4", EMPTY, "two.mp4", "short.mp4", "gone.mp4"]
    )


def test_each_failure_is_a_row_with_a_code_and_a_next_step(status, populated):
    found = {(e["about"], e["table"], e["code"]) for e in status["errors"]}
    assert found == {
        ("notes.mp4", "VideoInfo", "VIDEO_NOT_A_VIDEO"),
        ("truncated.mp4", "VideoInfo", "VIDEO_TRUNCATED"),
        ("gone.mp4", "VideoInfo", "VIDEO_MISSING"),
        ("short.mp4", "Keypoints", "TRACK_TOO_SHORT"),
    }
    printed = pbl("status")
    assert printed.code == 0
    for error in status["errors"]:
        assert error["code"] in populated.out
        assert error["code"] in printed.out
        assert len(error["next_step"]) > 10
        assert error["next_step"].splitlines()[0] in printed.out


def test_two_people_wait_for_a_choice(status):
    (waiting,) = status["waiting"]
    assert (waiting["about"], waiting["persons"]) == ("two.mp4", [1, 2])
    assert waiting["next_step"] == f"pbl choose {waiting['video_id']} 1|2"
    assert waiting["next_step"] in pbl("status").out


def test_nobody_is_no_error(status):
    key = {"video_name": EMPTY}
    choice = (tracking.SubjectChoice * video.Video.proj("video_name") & key).fetch1()
    assert choice["choice_status"] == "NO_PERSON"
    assert choice["choice_reason"]
    assert ("SubjectChoice", EMPTY) in {(e["table"], e["about"]) for e in status["empty"]}
    assert len(keypoints.Keypoints * video.Video.proj("video_name") & key) == 0


def test_the_good_video_is_finished_all_the_same(status):
    events = gait.GaitEvents * video.Video.proj("video_name") & {"video_name": "walking.mp4"}
    assert events.fetch1("events_status") == "PASS"
    # She crosses the picture: the walk tells the vertical. Standing does not.
    trials = (fit.SessionFit.Trial * video.Video.proj("video_name")).to_dicts()
    assert {t["video_name"]: t["trial_orientation"] for t in trials} == {
        "walking.mp4": "estimated: gait",
        "standing.mp4": "assumed: level",
    }
    assert all(fit.SessionFit.to_arrays("fit_converged"))
    assert len(gait.GaitCycle()) >= 1
    assert len(gdi.SessionGdi()) == len(qc.SessionQc()) == 2
    # Five contacts in 3 s; by eye in frames 4, 23, 41, 60 and 78 of this clip.
    contacts = (gait.GaitEvents.Event * video.Video.proj("video_name") & {"video_name": "walking.mp4"}).to_dicts()
    times = sorted(float(r["event_time"]) for r in contacts if r["event_kind"] == "foot_down")
    np.testing.assert_allclose(times, np.array([4, 23, 41, 60, 78]) / 30, atol=0.1)


def test_standing_is_fitted_and_has_no_gait(status):
    name = video.Video.proj("video_name") & {"video_name": "standing.mp4"}
    assert len(fit.SessionFit.Trial * name) == 1
    row = (gait.GaitEvents * name).fetch1()
    assert row["events_status"] == "EMPTY"
    assert "no walking" in row["events_reason"]
    (visit,) = frames.session_summary({"session_label": "stands"}).to_dict("records")
    assert visit["session_status"] == "EMPTY"
    assert "no walking" in visit["session_reason"]
    assert visit["qc_outcome"] == "EMPTY"
    assert pd.isna(visit["session_cadence"])
    assert visit["fit_residual_2d"] < 10
    assert ("GaitEvents", "standing.mp4") in {(e["table"], e["about"]) for e in status["empty"]}


def test_the_report_of_a_visit_without_walking(status, tmp_path):
    done = pbl("report", "--subject", "P001", "--session", "stands", "--out", tmp_path / "report")
    assert done.code == 0, done.err
    _no_gait(tmp_path / "report")


def test_without_the_models_an_error_waits_until_they_are_there(status, tmp_path, monkeypatch):
    path = write_video(tmp_path / "later.mp4", numbered_frames(40), constant_rate(40))
    assert pbl("ingest", path, "--subject", "P001", "--session", "later").code == 0
    with monkeypatch.context() as patch:
        patch.setenv("PBL_CACHE", str(tmp_path / "cache"))
        patch.setenv("PBL_OFFLINE", "1")
        done = pbl("populate", "--table", "VideoInfo", "--table", "Tracking")
        assert done.code == 0, done.err
        assert "ASSET_MISSING" in done.out
    (error,) = (e for e in json.loads(pbl("status", "--json").out)["errors"] if e["about"] == "later.mp4")
    assert (error["table"], error["code"]) == ("Tracking", "ASSET_MISSING")
    assert "pip download" in error["next_step"]
    assert "nothing to do" in pbl("populate").out
    assert pbl("populate", "--retry-errors", "--table", "Tracking").code == 0
    assert len(tracking.Tracking * video.Video.proj("video_name") & {"video_name": "later.mp4"}) == 1


def _no_gait(out: Path) -> None:
    """The files of a fit that stands, without gait, with the reason."""
    metrics = json.loads((out / "metrics.json").read_text())["session"]
    assert metrics["status"] == "EMPTY"
    assert "no walking" in metrics["reason"]
    assert metrics["cadence_steps_per_min"] is None
    assert metrics["gdi"]["mean"] is None
    assert {"cadence_steps_per_min", "gdi"} <= set(metrics["reasons"])
    assert load_events(out / "standing.events.csv") == ()
    assert "no walking" in (out / "report.html").read_text()
    assert probe(out / "standing.overlay.mp4").n_frames == 90
    body = TrialFit.load(out / "standing.fit.npz")
    assert np.nanmedian(body.residual_2d_px) < 10
    knees = body.qpos[:, [body.joint_names.index(f"knee_angle_{s}") for s in "rl"]]
    assert np.all(np.nanmax(knees, axis=0) - np.nanmin(knees, axis=0) < np.radians(15))


# ------------------------------------------------------------------------------------------------------ the files
@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("notes.mp4", "VIDEO_NOT_A_VIDEO"),
        ("nothing.mp4", "VIDEO_EMPTY"),
        ("truncated.mp4", "VIDEO_TRUNCATED"),
        ("not there.mp4", "VIDEO_MISSING"),
        (EMPTY, "TRACK_NO_PERSON"),
        ("short.mp4", "TRACK_TOO_SHORT"),
        ("two.mp4", "SUBJECT_NEEDS_CHOICE"),
    ],
)
def test_run_on_a_bad_video_ends_with_its_code(folder, tmp_path, name, code):
    done = pbl("run", folder / name, "--out", tmp_path / "out")
    assert (done.code, done.error_code) == (1, code), done.err
    assert "next:" in done.err
    assert not list(tmp_path.rglob("report.html"))
    assert bool(list(tmp_path.rglob("two.persons.png"))) == (code == "SUBJECT_NEEDS_CHOICE")


def test_run_stands_and_names_what_it_left_out(folder, tmp_path):
    """Standing, with two videos that cannot be used: they are named, and the rest is done."""
    videos = [folder / n for n in ("notes.mp4", "standing.mp4", "short.mp4")]
    done = pbl("run", *videos, "--out", tmp_path)
    assert done.code == 1, done.err  # two of the three were left out
    assert "VIDEO_NOT_A_VIDEO" in done.err
    assert "TRACK_TOO_SHORT" in done.err
    assert "EMPTY: standing: no walking" in done.out
    _no_gait(tmp_path)
    report = (tmp_path / "report.html").read_text()
    assert "VIDEO_NOT_A_VIDEO" in report
    assert "TRACK_TOO_SHORT" in report
