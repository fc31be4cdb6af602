"""`pbl demo`, the main job: the demo recording through every table to the report, by the installed script.

The truth is what a person sees in the recording (30 frames/s; frame n at n/30 s). She walks from the right edge to the
left one in the lower half of the picture; he stands on a wall above her and jumps off it. Her heels touch the ground in
the frames below, read off contact sheets of every frame around each contact: from there on the heel stands still and
the toes sink. Read so, a contact is right to about one frame. Her near arm is the left one and swings against the leg,
which tells the sides.
"""

import csv
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.cli import doctor
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait.events import load_events
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import probe
from pbl_schemas.operations import embedded
from pbl_schemas.operations.embedded import APP_USER, HOST, Folder
from tests import demo_block, without_posix
from tests.database import new_home, remove_home
from tests.german import REPORT_NAMES, english_of, english_words
from tests.html_page import Page, commands_in

pytestmark = pytest.mark.slow

CONTACTS = {"left": (41, 79, 116, 153, 188), "right": (60, 98, 135, 171)}
ALL_CONTACTS = np.sort(np.concatenate([*CONTACTS.values()]))
#: 60 s / (mean step of 18.4 frames / 30): 98 steps/min. One frame at either end of the eight steps is 1 %.
CADENCE_BY_EYE = 60 * 30 * (len(ALL_CONTACTS) - 1) / float(ALL_CONTACTS[-1] - ALL_CONTACTS[0])

#: The command as it was installed beside this Python.
PBL = Path(sys.executable).with_name("pbl")


@pytest.fixture(scope="module")
def home() -> Iterator[Path]:
    path = new_home()
    yield path
    remove_home(path)


def pbl(home: Path, *arguments: object, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PBL_HOME": str(home)}
    words = [str(PBL), *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, env=env, timeout=timeout_s, check=False)


@pytest.fixture(scope="module")
def demo(home: Path, demo_files, tmp_path_factory: pytest.TempPathFactory):
    """One run for all tests: its output and the folder of its results."""
    out = tmp_path_factory.mktemp("demo") / "result of the demo"
    return pbl(home, "demo", "--out", out, timeout_s=600), out


@pytest.fixture(scope="module")
def out(demo) -> Path:
    done, out = demo
    assert done.returncode == 0, done.stderr[-3000:]
    return out


def test_it_ends_well_and_shows_rows_paths_and_progress(demo, out):
    done, _ = demo
    for word in ("cadence", "stride time", "GDI", "QC", "VideoInfo", "SessionQc"):
        assert word in done.stdout
    for name in ("report.html", "demo.overlay.mp4", "demo.angles.csv", "metrics.json"):
        assert str(out / name) in done.stdout
    for step in ("people", "keypoints", "populate", "overlay demo"):
        assert f"{step}: 100%" in done.stderr
    # The bar names the table in hand; a file gets a line every ten seconds, so which ones depends on the machine.
    assert re.search(r"populate: .*(row/s|s/row), [A-Z]\w+\]", done.stderr)
    assert "Traceback" not in done.stdout + done.stderr
    assert "The database is stopped" in done.stdout


def test_it_prints_what_readme_shows(demo, out):
    done, _ = demo
    assert demo_block.differences(demo_block.in_readme(), demo_block.printed_by_demo(done.stdout)) == []


def test_the_walker_is_measured_not_the_man(out):
    keypoints = Keypoints.load(out / "demo.keypoints.npz")
    box, (width, height) = keypoints.box_px, keypoints.image_size_px
    seen = np.flatnonzero(np.isfinite(box[:, 0]) & (keypoints.confidence.max(axis=1) > 0))
    x, y = (box[seen, 0] + box[seen, 2]) / 2, (box[seen, 1] + box[seen, 3]) / 2
    assert len(seen) > 130
    assert x[0] > 0.75 * width
    assert x[-1] < 0.25 * width
    assert np.corrcoef(seen, x)[0, 1] < -0.99
    assert np.all(y > 0.5 * height)


def test_cadence_is_what_a_person_counts(out):
    session = json.loads((out / "metrics.json").read_text())["session"]
    assert pytest.approx(98.0, abs=0.1) == CADENCE_BY_EYE
    assert session["cadence_steps_per_min"]["mean"] == pytest.approx(CADENCE_BY_EYE, rel=0.025)
    assert session["step_time_s"]["mean"] == pytest.approx(60 / CADENCE_BY_EYE, rel=0.025)
    assert session["stride_time_s"]["mean"] == pytest.approx(120 / CADENCE_BY_EYE, rel=0.025)
    assert session["cycles"]["used"] >= 4


def test_it_has_the_digits_that_a_self_check_compares(out):
    session = json.loads((out / "metrics.json").read_text())["session"]
    found = {
        "index": session["gdi"]["mean"],
        "double support": session["double_support_percent"]["mean"],
        "cadence": session["cadence_steps_per_min"]["mean"],
    }
    assert found == pytest.approx(doctor.REFERENCE, abs=0.2 * doctor.MOST_OFF)


def test_each_foot_down_is_where_a_person_sees_it(out):
    """Every contact on its side: in full view within a frame and a half (the eye is right to one), the first, behind a
    tree, and the last, cut off by the picture's edge, within two and a half where they are found."""
    found = [e for e in load_events(out / "demo.events.csv") if e.event == "foot_down"]
    for event in found:
        assert min(abs(event.time_s - f / 30) for f in CONTACTS[event.side]) < 2.5 / 30, event
    assert len({(e.side, round(e.time_s, 1)) for e in found}) == len(found)
    inner = [(s, f) for s, frames in CONTACTS.items() for f in frames if 41 < f < 188]
    missed = [(s, f) for s, f in inner if not any(e.side == s and abs(e.time_s - f / 30) < 1.5 / 30 for e in found)]
    assert not missed
    assert min(e.probability for e in found) > 0.8


def test_the_fitted_body_lies_on_her(out):
    fit = TrialFit.load(out / "demo.fit.npz")
    # She is about 450 px tall: 6 px are about 2 cm on her.
    assert np.nanmedian(fit.residual_2d_px) < 6
    assert np.nanmedian(fit.residual_3d_m) < 0.1
    inside = np.isfinite(fit.qpos[:, 0])
    assert inside.sum() > 120
    knees = np.degrees(fit.qpos[inside][:, [fit.joint_names.index(f"knee_angle_{s}") for s in "rl"]])
    # In walking a knee bends by 60 degrees in swing and is nearly straight at contact.
    assert np.all(np.ptp(knees, axis=0) > 35)
    session = json.loads((out / "session.json").read_text())
    assert session["trials"] == ["demo"]
    assert session["loss_trace"][-1][1] < session["loss_trace"][0][1] / 2
    assert session["seconds"] > 0
    outcomes = {c["check"]: c["outcome"] for c in session["qc"]}
    assert outcomes["residual_2d_share_of_body_height"] == "PASS"


def test_angles_and_video_cover_the_recording(out, demo_files):
    source = probe(demo_files["demo_video"])
    overlay = probe(out / "demo.overlay.mp4")
    assert overlay.codec == "h264"
    assert overlay.n_frames == source.n_frames
    np.testing.assert_allclose(overlay.time_s, source.time_s, atol=0.002)
    with (out / "demo.angles.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    fit = TrialFit.load(out / "demo.fit.npz")
    assert header[0] == "time_s"
    assert {*fit.joint_names, "knee_flexion_r", "knee_flexion_l"} <= set(header)
    assert len(rows) == source.n_frames
    for side in "rl":  # positive in flexion: nearly straight at contact, well bent in swing
        flexion = np.array([float(r[header.index(f"knee_flexion_{side}")] or "nan") for r in rows])
        assert np.nanmax(flexion) > 40
        assert -20 < np.nanmin(flexion) < 25
    middle = 110
    assert float(rows[middle][0]) == pytest.approx(source.time_s[middle], abs=1e-3)
    angle = fit.qpos[middle, fit.joint_names.index("hip_flexion_l")]
    assert float(rows[middle][header.index("hip_flexion_l")]) == pytest.approx(np.degrees(angle), abs=0.01)


def test_the_report_is_one_file_with_curves_and_pictures(out):
    text = (out / "report.html").read_text()
    page = Page(text)
    assert page.problems == []
    assert "state the measured body height, or compare" in text
    assert not commands_in(text)
    # Pictures are inside, anchors lead within the page: nothing is loaded from elsewhere.
    links = [v or "" for _, a in page.tags for k, v in a.items() if k in ("src", "href")]
    assert [link[:40] for link in links if not link.startswith(("data:", "#"))] == []
    assert len(page.all("img")) >= 3
    assert page.all("svg")
    cadence = json.loads((out / "metrics.json").read_text())["session"]["cadence_steps_per_min"]["mean"]
    assert re.search(rf"\b{cadence:.0f}(\.\d)?\b", text)


def test_a_second_populate_does_nothing(home, out):
    embedded.start(folder=Folder(home / "db"))
    again = pbl(home, "populate")
    assert again.returncode == 0, again.stderr
    assert "nothing to do" in again.stdout
    assert re.findall(r"^(\w+) +([1-9]\d*) ", again.stdout, re.MULTILINE) == []
    state = json.loads(pbl(home, "status", "--json").stdout)
    assert state["videos"] == 1
    # The recording has three tracks: she, he on the wall, he on the lawn.
    assert {t["table"]: t["done"] for t in state["tables"]}["SessionQc"] == 1
    assert (state["errors"], state["waiting"]) == ([], [])


@pytest.mark.long
def test_reports_and_exports_come_from_a_named_server_without_posix(home, out, tmp_path):
    assert pbl(home, "db", "start").returncode == 0
    folder = Folder(home / "db")
    server = {"DJ_HOST": f"{HOST}:{folder.state()['port']}", "DJ_USER": APP_USER, "PBL_HOME": str(home)}
    server["DJ_PASS"] = folder.credentials().app_password
    done = without_posix.pbl("export", "--subject", "DEMO", "--to", "trc", "--out", tmp_path / "x", variables=server)
    assert done.code == 0, done.err
    assert ".trc" in {path.suffix for path in map(Path, done.out.splitlines()) if path.stat().st_size}
    done = without_posix.pbl("report", "--subject", "NOBODY", "--out", tmp_path / "r", variables=server)
    assert done.error_code == "DB_NOT_FOUND", done.err
    for command in (("report", "--subject", "DEMO"), ("demo",)):
        done_again = pbl(home, *command, "--language", "de", "--out", tmp_path / command[0])
        assert done_again.returncode == 0, done_again.stderr
        german = (tmp_path / command[0] / "report.html").read_text("utf-8")
        assert "Wie dieser Bericht zu lesen ist" in german
        assert not english_of(german, english_words(), REPORT_NAMES)
    assert pbl(home, "db", "stop").returncode == 0
