"""`pbl web --folder`: what `pbl run` wrote, shown without a database."""

import dataclasses
import datetime
import io
import json
import os
import re
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from starlette.testclient import TestClient

from pbl_pipeline.body import marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.visit import load_visit, save_beside
from pbl_workers.web import ResultsFolder, Where, serve
from pbl_workers.web.pages import plain
from tests import Environment, not_none
from tests.exported import with_markers
from tests.integration import web
from tests.walking_fit import walking_fit


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits, one with a recording beside it; one whose files are not those of `pbl run`; one whose measures are
    missing; and one of a run that was ended."""
    folder = tmp_path_factory.mktemp("results")
    for name in ("2026-01-10", "2026-06-10 <b>"):
        out = folder / name
        out.mkdir()
        plain = walking_fit(name="walk", n_frames=240)
        points = marker_set("blazepose_33")
        more = {"marker_set": points.name, "marker_names": points.names, "site_offset_m": np.zeros((33, 3))}
        seen = {"residual_2d_px": np.full((240, 33), 4.0), "residual_3d_m": np.full((240, 33), 0.03)}
        fit = with_markers(dataclasses.replace(plain, **more, **seen))
        fit.save(out / "walk.fit.npz")
        metrics = gait_metrics([fit])
        metrics.save(out / "metrics.json")
        save_beside(metrics.trials, [out / "walk.fit.npz"], out / "metrics.json")
        (out / "session.json").write_text(json.dumps({"trials": [fit.name], "params_hash": fit.params_hash, "qc": []}))
        (out / "report.html").write_text("<!doctype html><title>report</title>")
    (folder / "2026-01-10" / "WALK.MP4").write_bytes(b"0123456789")
    (folder / "other").mkdir()
    (folder / "other" / "session.json").write_text("{")
    for name, files in (("unmeasured", ("walk.fit.npz", "session.json")), ("was ended", ("walk.fit.npz",))):
        (folder / name).mkdir()
        for file in files:
            (folder / name / file).write_bytes((folder / "2026-01-10" / file).read_bytes())
    return folder


@pytest.fixture
def browser(results: Path) -> TestClient:
    return web.client("reader", folder=ResultsFolder(results))


def test_a_folder_is_found_looked_at_and_taken_along(results, browser):
    first = browser.get("/visits").text
    index = json.loads((results / "2026-01-10" / "metrics.json").read_text())["session"]["gdi"]["mean"]
    assert "2026-01-10" in first
    assert f"{index:.1f}" in first
    assert "FILE_FORMAT" in first  # the folder whose files cannot be read keeps its line
    assert first.count("files are missing") == 2  # and so do those without measures
    visit = browser.get("/visits/1").text
    assert "Cadence" in visit
    assert "film the next visit alike: " in " ".join(visit.split())
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


def test_a_visit_shows_curves_peaks_and_ranges_of_both_sides_beside_the_norm(results, browser):
    page = " ".join(browser.get("/visits/1").text.split())
    assert "compares with 166 typically developing children" in page
    assert page.count('<svg viewBox="0 0 280 200"') == 4
    assert "138 able-bodied adults (21 to 86 years)" in page
    shown = browser.get("/visits/1.json").json()["curves"]
    metrics = not_none(load_visit(results / "2026-01-10").measures)
    for angle in shown["angles"]:
        for side, (low, high) in angle["ranges"].items():
            curves = [c.curves[angle["name"]] for c in metrics.cycles if c.used and c.side == side]
            mean = np.mean(curves, axis=0)
            assert (low, high) == pytest.approx((mean.min(), mean.max())), (angle["name"], side)
            assert f"{high - low:.0f}" in page
    far = next(c.far_leg for c in metrics.cycles if c.used)
    assert shown["far"] == far == "right"  # walks from right to left: the camera saw the left side
    assert "The right leg was behind the left one" in page
    row = not_none(re.search(r"Step time.*?</tr>", page))
    assert row[0].count("*</td>") == 2  # both sides of a measure of one leg are marked
    assert "*" not in re.findall(r"Cadence.*?</tr>", page)[0]


def test_what_is_not_there_is_said(browser, environment: Environment):
    # The second visit has no recording beside it.
    assert "copy the recording beside its results" in browser.get("/recordings/2").text
    assert browser.get("/recordings/2/video").status_code == 404
    for path in ("/visits/9", "/recordings/9", "/recordings/9/movement", "/recordings/2/overlay"):
        assert browser.get(path).status_code == 404, path
    assert "FILE_FORMAT" in browser.get("/visits/3").text
    environment(PBL_DEIDENTIFY="blur")
    assert "PBL_DEIDENTIFY" in browser.get("/recordings/1").text
    assert browser.get("/recordings/1/video").status_code == 404


@pytest.mark.parametrize(("number", "file"), [(4, "metrics.json"), (5, "session.json")])
def test_a_visit_without_all_of_its_files_shows_what_is_there_and_names_what_is_missing(browser, number, file):
    visit = browser.get(f"/visits/{number}").text
    assert f"no {file}" in visit
    assert "This visit has no measures yet" in visit
    assert "/report" not in visit
    files = zipfile.ZipFile(io.BytesIO(browser.get(f"/visits/{number}/export").content)).namelist()
    assert any(name.endswith(".mot") for name in files)  # the movement, which is there
    assert ("whether the body lies on the person is not known" in visit) is (file == "session.json")
    recording = browser.get("/recordings/" + re.findall(r"/recordings/(\d+)", visit)[0]).text
    assert "240 frames" in recording


def test_the_list_as_json(browser):
    """The other pages: tests/integration/test_visit_contract.py."""
    listed = browser.get("/visits.json").json()["page"]["visits"]
    assert [(v["session_id"], v["label"], v["state"]) for v in listed] == [
        (1, "2026-01-10", "computed"),
        (2, "2026-06-10 <b>", "computed"),
        (3, "other", "failed"),
        (4, "unmeasured", "incomplete"),
        (5, "was ended", "incomplete"),
    ]


def test_no_json_has_a_path_or_a_number_that_is_not_finite(results, browser):
    pages = ["/visits.json", *(f"/visits/{n}.json" for n in range(1, 7)), *(f"/recordings/{n}.json" for n in range(6))]
    for page in pages:
        answer = browser.get(page)
        assert answer.headers["content-type"] == "application/json", page
        assert answer.headers["cache-control"] == "no-store", page
        assert str(results) not in answer.text, page
        content = json.loads(answer.text, parse_constant=pytest.fail)  # NaN, Infinity
        if answer.status_code != 200:
            assert set(content["error"]) == {"code", "found", "expected", "next_step", "key"}, page
            assert all(content["error"][k] for k in ("code", "found", "expected", "next_step")), page
    damaged = browser.get("/visits/3.json")
    assert (damaged.status_code, damaged.json()["error"]["code"]) == (409, "FILE_FORMAT")
    assert damaged.json()["error"]["key"] == "session.json"
    assert browser.get("/visits/9.json").json()["error"]["code"] == "DB_NOT_FOUND"
    assert browser.get("/no/such/page.json").json()["error"]["code"] == "DB_NOT_FOUND"
    browser.cookies.clear()
    refused = browser.get("/visits.json")
    assert (refused.status_code, refused.json()["error"]["code"]) == (401, "WEB_REFUSED")


def test_what_plain_values_are_of():
    frame = pd.DataFrame({"percent": [0, 1], "mean_deg": [np.nan, 2.5]})
    assert plain(frame) == [{"percent": 0, "mean_deg": None}, {"percent": 1, "mean_deg": 2.5}]
    values = {"at": datetime.date(2026, 3, 1), "p": Path("/a/b.mp4"), "x": np.float32(np.inf), "y": np.zeros(3)}
    assert plain(values) == {"at": "2026-03-01", "p": "b.mp4", "x": None, "y": None}
    assert plain("no file at /data/visits/2026/walk.mp4: gone") == "no file at walk.mp4: gone"
    assert plain("/visits/3, 1.2 m/s, https://a.org/b/c") == "3, 1.2 m/s, https://a.org/b/c"


def test_nothing_is_decided_in_a_folder(browser):
    for path in ("/recordings/1/person", "/visits/1/accept"):
        assert browser.post(path, data={"token": "x"}).status_code in (403, 404, 405)


def test_a_folder_without_results_and_one_for_others_are_refused(results, tmp_path):
    with pytest.raises(PblError, match=r"no session\.json and no fit") as error:
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
    walking_fit(name="walk", n_frames=200).save(out / "walk.fit.npz")
    assert folder.state(1) != before
    for file in out.iterdir():  # also its cycles
        before = folder.state(1)
        os.utime(file, ns=(0, 0))
        assert folder.state(1) != before, file.name
    assert len(not_none(folder.recording(1).recording.fit).time_s) == 200
