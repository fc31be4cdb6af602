"""The chain on files, with the slow stages replaced: what is named, left out and checked first."""

import dataclasses
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from pbl_pipeline import pipeline
from pbl_pipeline.body import load_body
from pbl_pipeline.cli.run import run
from pbl_pipeline.depth import sha256_of_recording
from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import Check
from pbl_pipeline.report import write_report
from pbl_pipeline.visit import Recording, Visit
from tests import Environment, StandIn
from tests.german import REPORT_NAMES, english_of, english_words
from tests.integration import chain
from tests.walking_fit import walking_fit


def test_names_are_distinct_whatever_the_files_are_called():
    names = pipeline.distinct_names([Path(p) for p in ("a/walk.mp4", "b/walk.mp4", "walk-2.mp4", "stand.mov")])
    assert names == ["walk-1", "walk-2-2", "walk-2", "stand"]


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch, stand_in: StandIn) -> list[list[str]]:
    """Names of the trials of each fit; detection and fit are stand-ins."""
    calls: list[list[str]] = []

    def detect(*args, **options):
        return dataclasses.replace(chain.detect_keypoints(*args, **options), image_size_px=(1920, 1080))

    def fit(trials, names, paramset=None, camera_motion="static", height_m=None):
        calls.append(list(names))
        return chain.fit_session(trials, names, paramset, camera_motion, height_m)

    chain.install(monkeypatch)
    stand_in(detect_keypoints=detect, check_trial=lambda *_: None, fit_session=fit)
    return calls


def test_a_video_named_twice_counts_once(fitted: list[list[str]], tmp_path: Path):
    first = chain.small_video(tmp_path, "walk", n=120)
    copy = tmp_path / "copy.mp4"
    copy.write_bytes(first.read_bytes())
    visit, problems = pipeline.run_visit([first, copy], tmp_path / "out")
    assert fitted == [["walk"]]
    assert problems["copy"].code == "USAGE"
    assert "same bytes as walk" in problems["copy"].found
    assert [(r.name, r.fitted, r.problem) for r in visit.recordings] == [
        ("walk", True, ""),
        ("copy", False, problems["copy"].short()),
    ]


def test_an_unknown_norm_is_refused_before_the_fit(fitted: list[list[str]], tmp_path: Path):
    with pytest.raises(PblError, match=r"^NORM_UNKNOWN: "):
        pipeline.run_visit([chain.small_video(tmp_path, "walk", n=120)], tmp_path / "out", norm="no-such-norm")
    assert not fitted


@pytest.mark.slow
def test_the_report_of_a_run_is_german_where_that_is_asked_for(
    fitted: list[list[str]], tmp_path: Path, stand_in: StandIn
):
    stand_in(**chain.NO_PICTURES)
    paths = [str(chain.small_video(tmp_path, f"walk_{name}")) for name in "ab"]
    done = CliRunner().invoke(run, [*paths, "--out", str(tmp_path / "out"), "--language", "de"], catch_exceptions=False)
    assert done.exit_code == 0
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "Person im Bild (s) (walk_a)" in page
    assert not english_of(page, english_words(), REPORT_NAMES + r"|walk_[ab](\.mp4)?|Scale|stand-in|test")


@pytest.mark.slow
def test_report_and_session_name_the_depth_recording_of_a_run(
    fitted: list[list[str]], tmp_path: Path, stand_in: StandIn
):
    def detect(video_path, tracking, person_id, camera, params=None):  # of a small video
        points = chain.detect_keypoints(video_path, tracking, person_id, camera, params)
        small = points.xy_px * (128 / points.image_size_px[0])
        return dataclasses.replace(points, xy_px=small, image_size_px=(128, 72), camera=camera)

    stand_in(**chain.NO_PICTURES, detect_keypoints=detect, fit_session=chain.fit_session)
    paths = [str(chain.small_video(tmp_path, name)) for name in ("walk", "without", "wrong")]
    folders = [chain.depth_pictures(tmp_path / name, n=n) for name, n in (("deep", 240), ("few", 9))]
    given = [f"0.001={folders[0]}", "none", f"0.002={folders[1]}"]
    depths = [part for text in given for part in ("--depth", text)]
    done = CliRunner().invoke(run, [*paths, *depths, "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert "DEPTH_FILE" in done.output
    sha256 = sha256_of_recording(folders[0])
    content = json.loads((tmp_path / "out" / "session.json").read_text())
    assert content["trials"] == ["walk", "without"]
    assert {n: (d["name"], d["sha256"], d["metre"]) for n, d in content["depths"].items()} == {
        "walk": ("deep", sha256, 3.0)
    }
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert page.count(sha256) == 1
    assert "Depth recording" in page


@pytest.mark.slow
@pytest.mark.parametrize("outcome", ["PASS", "FAIL"])
def test_report_and_metrics_agree_on_the_outcome(
    fitted: list[list[str]], tmp_path: Path, outcome: str, stand_in: StandIn
):
    from pbl_pipeline.report.page import page_of

    written = []
    seen = Check("leg_confidence", outcome, 0.1, 0.5, "the legs are hidden" if outcome == "FAIL" else "")
    stand_in(check_keypoints=lambda _: (seen,))
    stand_in(**chain.NO_PICTURES, write_report=lambda _, *shown, **__: written.append(shown))
    visit, _ = pipeline.run_visit([chain.small_video(tmp_path, "walk")], tmp_path / "out")
    pipeline.write_results(tmp_path / "out", visit)
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())["session"]
    ((shown, pictures),) = written
    page = page_of(shown, pictures, "Gait report")
    assert visit.judged is not None
    assert content["outcome"] == page["verdict"]["outcome"] == visit.judged.outcome
    assert content["outcome"] == ("FAIL" if outcome == "FAIL" else "WARN")
    assert {c["check"] for c in content["qc"]} >= {"leg_confidence", "residual_3d_cm", "walking", "cycles_used"}
    assert len(page["checks"]) == len(content["qc"])


def test_a_persons_number_belongs_to_one_video(tmp_path: Path):
    paths = [str(chain.small_video(tmp_path, name, n=10)) for name in ("a", "b")]
    result = CliRunner().invoke(run, [*paths, "--out", str(tmp_path / "out"), "--person", "2"])
    assert isinstance(result.exception, PblError)
    assert result.exception.code == "USAGE"
    assert "--person" in result.exception.next_step
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["", "blur"])
def test_overlay_and_pictures_are_of_the_copy_where_the_setting_says_so(
    fitted: list[list[str]], environment: Environment, tmp_path: Path, how: str, stand_in: StandIn
):
    """The stand-in copy is another video; both the overlay and the report's pictures are made from it."""
    import pbl_pipeline.deidentify.video_copy as lib

    def copied(video, out, way, info=None):
        assert (video, way) == (recording, "blur")
        out.write_bytes(recording.read_bytes())
        return lib.Deidentified(out, out, way, 1, "CERTAIN", "", ())

    used = []
    environment(PBL_DEIDENTIFY=how)
    stand_in(
        deidentify=copied,
        render_overlay=lambda path, *_, **__: used.append(path),
        overlay_frames=lambda path, *_, **__: used.append(path) or [],
        report_indices=lambda _: [],
        write_report=lambda *_, **__: None,
    )
    recording = chain.small_video(tmp_path, "walk")
    pipeline.write_results(tmp_path / "out", pipeline.run_visit([recording], tmp_path / "out")[0])
    assert len(used) == 2
    assert all((path == recording) is (not how) for path in used)
    assert not [p for p in used if p != recording and p.exists()]


def test_the_report_of_a_visit_names_the_recordings_it_lacks(tmp_path: Path):
    dark = Recording("dark", problem="SubjectChoice: nobody was found")
    body = load_body()
    fit = walking_fit(body.joint_names, body.sha256)
    visit = pipeline.measured(Visit((Recording.of("walk", fit), dark), subject="P1", label="visit"))
    assert [r.name for r in visit.fitted] == ["walk"]
    assert {r.name: r.problem for r in visit.left_out} == {"dark": "SubjectChoice: nobody was found"}
    text = write_report(tmp_path / "report.html", visit).read_text(encoding="utf-8")
    assert "left out: SubjectChoice: nobody was found" in text
    pipeline.write_results(tmp_path, visit)
    told = {c["check"]: c["advice"] for c in json.loads((tmp_path / "metrics.json").read_text())["session"]["qc"]}
    assert told["trial dark"] == "left out: SubjectChoice: nobody was found"
