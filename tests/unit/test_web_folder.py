"""`pbl web --folder`: what `pbl run` wrote, shown without a database."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import gait_metrics
from tests.exported import with_markers
from tests.walking_fit import walking_fit
from workers.web import Options, ResultsFolder, Where, create_app, serve


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits, one with a recording beside it; and one whose files are not those of `pbl run`."""
    folder, body = tmp_path_factory.mktemp("results"), load_body()
    for name in ("2026-01-10", "2026-06-10 <b>"):
        out = folder / name
        out.mkdir()
        plain = walking_fit(body.joint_names, body.sha256, name="walk", n_frames=240)
        points = marker_set("blazepose_33")
        more = {"marker_set": points.name, "marker_names": points.names, "site_offset_m": np.zeros((33, 3))}
        seen = {"residual_2d_px": np.full((240, 33), 4.0), "residual_3d_m": np.full((240, 33), 0.03)}
        fit = with_markers(dataclasses.replace(plain, **more, **seen))
        fit.save(out / "walk.fit.npz")
        metrics = gait_metrics([fit])
        metrics.save(out / "metrics.json")
        (out / "session.json").write_text(json.dumps({"trials": [fit.name], "params_hash": fit.params_hash, "qc": []}))
        (out / "report.html").write_text("<!doctype html><title>report</title>")
    (folder / "2026-01-10" / "WALK.MP4").write_bytes(b"0123456789")
    (folder / "other").mkdir()
    (folder / "other" / "session.json").write_text("{")
    return folder


def browser_of(folder: ResultsFolder) -> TestClient:
    app = create_app(Options(folder=folder, roles=("reader",)))
    browser = TestClient(app, base_url="http://127.0.0.1:8484", raise_server_exceptions=False)
    assert browser.get("/visits").status_code == 401
    browser.get("/enter", params={"key": app.state.sessions.new_link("R. Viewer", "reader")})
    return browser


def test_a_folder_is_found_looked_at_and_taken_along(results):
    browser = browser_of(ResultsFolder(results))
    first = browser.get("/visits").text
    index = json.loads((results / "2026-01-10" / "metrics.json").read_text())["session"]["gdi"]["mean"]
    assert "2026-01-10" in first
    assert f"{index:.1f}" in first
    assert "FILE_MISSING" in first  # the folder without metrics keeps its line
    visit = browser.get("/visits/1").text
    assert "Cadence" in visit
    assert 'href="/recordings/1"' in visit
    assert browser.get("/visits/1/report").headers["content-security-policy"].startswith("sandbox")
    recording = browser.get("/recordings/1").text
    assert "2026-06-10 &lt;b&gt;" in first
    assert "240 frames" in recording
    movement = browser.get("/recordings/1/movement").json()
    assert len(movement["time"]) == 240
    assert {e[2] for e in movement["events"]} == {"foot_down", "foot_up"}
    assert browser.get("/recordings/1/body").content
    part = browser.get("/recordings/1/video", headers={"range": "bytes=2-4"})
    assert (part.status_code, part.content) == (206, b"234")
    files = zipfile.ZipFile(io.BytesIO(browser.get("/visits/1/export").content)).namelist()
    assert any(name.endswith(".mot") for name in files)


def test_what_is_not_there_is_said(results, monkeypatch: pytest.MonkeyPatch):
    browser = browser_of(ResultsFolder(results))
    assert "--videos" in browser.get("/recordings/2").text  # no recording beside the second visit
    assert browser.get("/recordings/2/video").status_code == 404
    for path in (
        "/visits/9",
        "/recordings/9",
        "/recordings/9/movement",
        "/visits/../../etc/passwd",
        "/recordings/2/overlay",
    ):
        assert browser.get(path).status_code == 404, path
    assert "FILE_MISSING" in browser.get("/visits/3").text
    monkeypatch.setenv("PBL_DEIDENTIFY", "blur")
    assert "PBL_DEIDENTIFY" in browser.get("/recordings/1").text
    assert browser.get("/recordings/1/video").status_code == 404


def test_nothing_is_decided_in_a_folder(results):
    browser = browser_of(ResultsFolder(results))
    for path in ("/recordings/1/person", "/visits/1/accept"):
        assert browser.post(path, data={"token": "x"}).status_code in (403, 404, 405)


def test_a_folder_without_results_and_one_for_others_are_refused(results, tmp_path):
    with pytest.raises(PblError, match="no session") as error:
        ResultsFolder(tmp_path)
    assert error.value.code == "FILE_MISSING"
    with pytest.raises(PblError, match="--folder for more than this machine"):
        serve(Where("0.0.0.0", 0, behind_proxy="127.0.0.1", hostnames=("gait.example",)), folder=ResultsFolder(results))


def test_results_are_found_again_when_they_were_made_anew(results, tmp_path):
    out = tmp_path / "again"
    out.mkdir()
    for file in (results / "2026-01-10").iterdir():
        (out / file.name).write_bytes(file.read_bytes())
    folder = ResultsFolder(out)
    before = folder.state(1)
    body = load_body()
    walking_fit(body.joint_names, body.sha256, name="walk", n_frames=200).save(out / "walk.fit.npz")
    assert folder.state(1) != before
    assert len(folder.load(1).fit.time_s) == 200
