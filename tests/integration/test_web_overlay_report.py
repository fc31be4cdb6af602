"""Overlay and report in the review page: made beside it, served when they are whole, never with a face to be hidden."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest

from pbl_pipeline.files import sha256_of
from pbl_schemas import fit, privacy
from pbl_schemas.origin import Origin
from pbl_workers.populate import populate
from pbl_workers.web import reports
from tests import until
from tests.german import REPORT_NAMES, english_of, english_words
from tests.html_page import commands_in
from tests.integration import web
from tests.rows import register
from tests.videos import constant_rate, numbered_frames, write_video

FRAMES = 60


@pytest.fixture(scope="module")
def visit(module_tables: Path) -> Path:
    """Visit 1 with the fitted video 1, whose pictures have the size of the fit, and its file."""
    path = module_tables / "walk.mp4"
    write_video(path, numbered_frames(FRAMES, 360, 640), constant_rate(FRAMES))
    register(path, session_label="2026-01-10")
    populate()
    return path


@pytest.fixture(scope="module")
def browser(visit: Path) -> Iterator[Any]:
    with web.client(role="reader") as found:
        yield found


def ended(browser: Any, address: str) -> None:
    """Ask as the page's script does, until the file is there or failed."""
    until(lambda: browser.get(address).json()["ended"], 60.0)


def test_an_overlay_is_made_beside_the_page_and_served_when_it_is_whole(visit: Path, browser: Any):
    assert '/recordings/1/overlay"' in browser.get("/recordings/1").text
    early = browser.get("/recordings/1/overlay/file", follow_redirects=False)
    assert (early.status_code, early.headers["location"]) == (303, "/recordings/1/overlay")
    page = browser.get("/recordings/1/overlay").text
    assert "<progress" in page
    assert "<video" not in page
    assert browser.get("/visits").status_code == 200  # the pages go on answering
    assert not browser.get("/recordings/1/overlay/state").json()["ended"]
    ended(browser, "/recordings/1/overlay/state")
    assert "/recordings/1/overlay/file" in browser.get("/recordings/1/overlay").text
    whole = browser.get("/recordings/1/overlay/file")
    assert whole.headers["content-type"] == "video/mp4"
    part = browser.get("/recordings/1/overlay/file", headers={"range": "bytes=0-99"})
    assert (part.status_code, part.content) == (206, whole.content[:100])
    with av.open(io.BytesIO(whole.content), "r") as found:
        assert sum(1 for _ in found.decode(video=0)) == FRAMES


def test_a_report_is_served_without_scripts_and_says_what_it_is_of(visit: Path, browser: Any):
    assert "/visits/1/report?result=0" in browser.get("/visits/1").text
    assert "<progress" in browser.get("/visits/1/report").text
    ended(browser, "/visits/1/report/state?result=0")
    report = browser.get("/visits/1/report?result=0")
    assert report.headers["content-security-policy"].startswith("sandbox; default-src 'none'")
    assert "Gait report" in report.text
    assert report.text.count("<figure><img") >= 1  # frames of the video
    assert browser.get("/visits/1/report?result=7").status_code == 404
    assert browser.get("/visits/99/report").status_code == 404
    assert browser.get("/recordings/99/overlay").status_code == 404


def test_a_report_is_in_the_language_of_its_reader(visit: Path, browser: Any, monkeypatch: pytest.MonkeyPatch):
    names = REPORT_NAMES + "|Scale"  # a check that the fit of this test has alone
    for language in ("de", "en"):
        monkeypatch.setitem(browser.headers, "accept-language", language)
        browser.get("/visits/1/report?result=0")
        ended(browser, "/visits/1/report/state?result=0")
        report = browser.get("/visits/1/report?result=0").text
        assert f'<html lang="{language}">' in report
        assert not commands_in(report)
        assert ("Wie dieser Bericht zu lesen ist" in report) == (language == "de")
        assert bool(english_of(report, english_words(), names)) == (language == "en")


@pytest.mark.long
def test_where_heads_are_to_be_hidden_nothing_of_the_original_is_drawn(
    visit: Path, browser: Any, monkeypatch: pytest.MonkeyPatch
):
    """The copy here is black; what is drawn over it must not show the grey of the original."""
    browser.get("/recordings/1/overlay")
    ended(browser, "/recordings/1/overlay/state")
    assert browser.get("/recordings/1/overlay/file", follow_redirects=False).status_code == 200  # of the original
    monkeypatch.setenv("PBL_DEIDENTIFY", "blur")
    for address in ("/recordings/1/overlay", "/visits/1/report"):
        answer = browser.get(address)
        assert (answer.status_code, "no de-identified copy" in answer.text) == (404, True)
    assert browser.get("/recordings/1/overlay/file", follow_redirects=False).status_code == 303
    copy = visit.with_name("copy.mp4")
    black = (frame * 0 for frame in numbered_frames(FRAMES, 360, 640))
    write_video(copy, black, constant_rate(FRAMES))
    privacy.Deidentified.insert1(copied(copy), allow_direct_insert=True)
    try:
        browser.get("/recordings/1/overlay")
        ended(browser, "/recordings/1/overlay/state")
        with av.open(io.BytesIO(browser.get("/recordings/1/overlay/file").content), "r") as found:
            frames = [f.to_ndarray(format="gray") for f in found.decode(video=0)]
        assert all(f[:40, :100].max() < 40 for f in frames)  # a corner of the picture
    finally:
        (privacy.Deidentified & {"video_id": 1}).delete(prompt=False)


def copied(path: Path) -> dict[str, Any]:
    """A row of Deidentified for a copy of video 1."""
    return {
        "video_id": 1,
        "deidentified_how": "blur",
        "deidentified_status": "CERTAIN",
        "deidentified_reason": "",
        "deidentified_heads": 1,
        "deidentified_uncertain": 0,
        "deidentified_ranges": [],
        "deidentified_sha256": sha256_of(path),
        "deidentified_file": path,
        **Origin.now(1.0).row("deidentified"),
    }


def test_what_is_computed_anew_is_drawn_anew(visit: Path):
    key = fit.trial_key(1)
    assert key is not None
    before = reports.overlay_key(1)
    assert reports.overlay_key(1) == before
    row = (fit.SessionFit & key).proj("fit_computed").fetch1()
    fit.SessionFit.update1({**row, "fit_computed": "2030-01-01 00:00:00"})
    assert reports.overlay_key(1) != before
    fit.SessionFit.update1(row)


def test_a_video_that_is_gone_says_so(visit: Path):
    away = visit.rename(visit.with_suffix(".away"))
    try:
        with web.client() as other:
            assert "VIDEO_MISSING" in other.get("/recordings/1/overlay").text
    finally:
        away.rename(visit)
