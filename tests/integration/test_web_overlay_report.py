"""Overlay and report in the review page: made beside it, served when they are whole, never with a face to be hidden."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_schemas import computed_tables, fit, gait, privacy, session, video
from pbl_schemas.connection import dj
from pbl_schemas.origin import Origin
from pbl_schemas.reading import shown
from pbl_schemas.reading.visit_state import state_of
from pbl_schemas.rows import delete_below
from pbl_workers.populate import populate
from pbl_workers.web import reports, source
from tests import Environment, until
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
    visit: Path, browser: Any, environment: Environment
):
    """The copy here is black; what is drawn over it must not show the grey of the original."""
    browser.get("/recordings/1/overlay")
    ended(browser, "/recordings/1/overlay/state")
    assert browser.get("/recordings/1/overlay/file", follow_redirects=False).status_code == 200  # of the original
    environment(PBL_DEIDENTIFY="blur")
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


def test_each_input_of_what_is_kept_changes_its_key(visit: Path, environment: Environment):
    """The movement of a recording's page, its overlay, the report of its visit, a phone's answer."""
    of_recording = {"movement": lambda: shown.computations(1), "overlay": lambda: reports.overlay_key(1)}
    of_visit = {"report": lambda: reports.report_key(1, 0, "en"), "phone": lambda: state_of(1)}
    every = {**of_recording, **of_visit}

    def changed(keys: dict[str, Any], change: Any) -> set[str]:
        """Those of the keys that a statement, or a call, changes; it is taken back."""
        before = {name: key() for name, key in keys.items()}
        assert before == {name: key() for name, key in keys.items()}
        with dj.conn().transaction:
            change() if callable(change) else dj.conn().query(change)
            found = {name for name, key in keys.items() if key() != before[name]}
            dj.conn().cancel_transaction()
            dj.conn().start_transaction()
        assert before == {name: key() for name, key in keys.items()}
        return found

    made = [t for t in computed_tables() if len(t())]
    assert {t.__name__ for t in made} >= {"SessionFit", "GaitEvents", "GaitCycle", "SessionGdi", "Kinetics"}
    own = {fit.SessionFit, gait.GaitEvents, gait.GaitCycle}
    for table in made:
        prefix = next(n.removesuffix("_computed") for n in table.heading.names if n.endswith("_computed"))
        keys = {**(of_recording if table in own else {}), **of_visit}
        for column, value in ((f"{prefix}_computed", "'2030-01-01'"), (f"{prefix}_seconds", "77")):
            statement = f"UPDATE {table.full_table_name} SET {column} = {value}"
            assert changed(keys, statement) == set(keys), (table.__name__, column)
    for change in ("session_label = 'x'", "session_date = '2026-01-11'"):
        statement = f"UPDATE {session.Session.full_table_name} SET {change}"
        assert changed({"report": every["report"]}, statement) == {"report"}
    assert changed(of_visit, f"UPDATE {video.Video.full_table_name} SET activity = 'tug'") == set(of_visit)
    paced = lambda: video.Pace.insert1({"video_id": 1, "pace": "fast"})  # noqa: E731
    assert changed({"report": every["report"]}, paced) == {"report"}
    mark = {"unusable_reason": "helped", "unusable_by": "R", "unusable_created": "2026-01-01"}
    assert changed(of_visit, lambda: video.NotUsable.insert1({"video_id": 1, **mark})) == set(of_visit)
    assert every["report"]() != reports.report_key(1, 0, "de")
    before = {name: every[name]() for name in ("overlay", "report")}
    environment(PBL_DEIDENTIFY="blur")
    assert all(every[name]() != key for name, key in before.items())


def test_a_page_opened_while_cycles_were_pending_is_made_again_with_them(visit: Path):
    delete_below(gait.GaitCycle(), gait.GaitCycle().keys())
    pending = shown.computations(1)
    populate()
    assert shown.computations(1) != pending


def test_another_copy_with_hidden_heads_replaces_the_one_that_is_kept(
    visit: Path, tmp_path: Path, environment: Environment
):
    environment(PBL_DEIDENTIFY="blur")
    videos = source.Videos()
    try:
        for shade in (0, 1):
            copy = tmp_path / f"copy{shade}.mp4"
            write_video(copy, (frame * shade for frame in numbered_frames(9, 36, 64)), constant_rate(9))
            privacy.Deidentified.insert1(copied(copy), allow_direct_insert=True)
            assert sha256_of(videos.path(1)) == sha256_of(videos.path(1)) == sha256_of(copy)
            (privacy.Deidentified & {"video_id": 1}).delete(prompt=False)
        with pytest.raises(PblError, match="no de-identified copy"):  # such as of a person who was forgotten
            videos.path(1)
    finally:
        videos.close()
        (privacy.Deidentified & {"video_id": 1}).delete(prompt=False)


def test_a_video_that_is_gone_says_so(visit: Path):
    away = visit.rename(visit.with_suffix(".away"))
    try:
        with web.client() as other:
            assert "VIDEO_MISSING" in other.get("/recordings/1/overlay").text
    finally:
        away.rename(visit)
