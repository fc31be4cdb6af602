"""The pages of the tables as JSON: who gets them, what is in them and what is not."""

import json
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import settings
from pbl_pipeline.visit import visit_facts
from pbl_schemas import load_visit
from pbl_workers.populate import populate
from tests import not_none
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import register

PAGES = ("/visits.json", "/visits/1.json", "/recordings/1.json", "/compare.json?v=1&v=2")


@pytest.fixture
def visits(tables: None, tmp_path: Path) -> Path:
    """Two computed visits; a folder without which their paths can be said. The second one's recording is 3."""
    videos = [small_video(tmp_path, name) for name in ("a", "b", "c")]
    register(*videos[:2], session_label="2026-01-10")
    register(videos[2], session_label="2026-06-10")
    populate()
    return tmp_path


def content_of(browser: Any, page: str, status: int = 200) -> Any:
    """The content of a page, in which a number that is not finite fails the test."""
    answer = browser.get(page)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["cache-control"] == "no-store"
    return json.loads(answer.text, parse_constant=lambda name: pytest.fail(f"{name} in {page}"))


def test_a_page_as_json_is_what_the_library_and_the_page_say(visits: Path):
    browser = web.client("reader")
    listed = content_of(browser, PAGES[0])["page"]["visits"]
    assert [(v["session_id"], v["subject"], v["label"]) for v in listed] == [
        (2, "P001", "2026-06-10"),
        (1, "P001", "2026-01-10"),
    ]
    visit = load_visit({"session_id": 1})
    about = content_of(browser, PAGES[1])["about"]
    stored = {**visit_facts(visit), "metrics": not_none(visit.judged).to_dict()}
    assert about["visit"] == json.loads(json.dumps(stored))
    assert about["checks"]
    assert len(about["of_person"]) == 2
    recording = content_of(browser, PAGES[2])["about"]
    assert (recording["number"], recording["session_id"], recording["n_frames"]) == (1, 1, 240)
    events = not_none(visit.recordings[0].events)
    assert [e["time_s"] for e in recording["recording"]["events"]] == [e.time_s for e in events.events]
    compared = content_of(browser, PAGES[3])["found"]["compared"]
    assert [c["about"]["row"]["session_id"] for c in compared] == [1, 2]
    assert compared[1]["change"]["by"] == pytest.approx(listed[0]["trend"]["change"])
    assert {"angle", "side", "percent", "mean_deg"} <= set(compared[0]["curves"][0])


def test_json_needs_the_same_rights_as_the_page(visits: Path):
    signed_out, operator = web.client(signed_in=False), web.client("operator")
    for page in PAGES:
        for browser, status in ((signed_out, 401), (operator, 403)):
            error = content_of(browser, page, status)["error"]
            assert error["code"] == "WEB_REFUSED"
            assert all(error[k] for k in ("found", "expected", "next_step"))
            assert "P001" not in json.dumps(error)
    reader = web.client("reader")
    refused = reader.get(PAGES[0], headers={"host": "evil.example"})
    assert (refused.status_code, refused.json()["error"]["code"]) == (400, "WEB_REFUSED")
    assert reader.post(PAGES[1]).status_code == 405
    assert content_of(reader, "/visits/99.json", 404)["error"]["code"] == "DB_NOT_FOUND"
    assert content_of(reader, "/visits/1.json?result=7", 404)["error"]["code"] == "DB_NOT_FOUND"
    assert content_of(reader, f"/recordings/{10**30}.json", 404)["error"]["code"] == "DB_NOT_FOUND"
    assert content_of(reader, "/compare.json?v=1", 400)["error"]["code"] == "USAGE"


def test_no_json_says_where_files_lie_or_what_a_form_needs(visits: Path):
    browser = web.client()
    (visits / "a.mp4").unlink()
    for page in (*PAGES, "/recordings/3.json"):
        text = json.dumps(content_of(browser, page))
        assert str(visits) not in text, page
        assert str(settings.home_dir()) not in text, page
        assert web.token(browser) not in text, page
    missing = content_of(browser, PAGES[2])["no_video"]
    assert (missing["code"], missing["found"]) == ("VIDEO_MISSING", "no file at a.mp4")
