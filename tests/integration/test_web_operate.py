"""Operating in the review page: queues, errors and another try; who may see what."""

import datetime
import html
import json
from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import video
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading import status
from pbl_schemas.review import Decision
from pbl_workers.populate import populate
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import everything, register


@pytest.fixture
def three_gone(tables: None, tmp_path: Path) -> list[int]:
    """Three videos whose files are gone: errors of VideoInfo."""
    paths = [small_video(tmp_path, f"walk{i}", n=30) for i in range(3)]
    numbers = [register(p, subject=f"P00{i}", session_label="2026-01-10")[0] for i, p in enumerate(paths)]
    for path in paths:
        path.unlink()
    populate()
    assert _errors() == set(numbers)
    return numbers


def _errors() -> set[int]:
    return {int(v) for v in jobs_of(video.VideoInfo).errors.to_arrays("video_id")}


def again(browser: Any, **fields: str):
    return web.post(browser, "/operate/retry", **fields)


def test_errors_with_code_words_and_next_step_are_tried_again(three_gone: list[int]):
    browser = web.client("operator", name="O. Perator")
    page = html.unescape(browser.get("/operate").text)
    assert "VIDEO_MISSING" in page
    assert "Bring the file or its disk back" in page
    assert "Try all of this kind again (3)" in page
    assert "GB free of" in page
    one = {"table": "VideoInfo", "code": "VIDEO_MISSING", "key": json.dumps({"video_id": three_gone[1]})}
    assert one["key"] in page  # the form of that row
    assert again(browser, **one).headers["location"] == "/operate?retried=1"
    assert _errors() == {three_gone[0], three_gone[2]}
    late = again(browser, **one)  # as the second of two who press it
    assert late.headers["location"] == "/operate?retried=0"
    assert "Nothing was put back" in browser.get("/operate?retried=0").text
    assert again(browser, table="VideoInfo", code="VIDEO_MISSING").headers["location"] == "/operate?retried=2"
    assert _errors() == set()
    rows = Decision().to_dicts(order_by="decision_id")
    assert [(r["decision_by"], r["decision_what"], r["video_id"], r["decision_before"]["errors"]) for r in rows] == [
        ("O. Perator", "retry", three_gone[1], 1),
        ("O. Perator", "retry", None, 2),
    ]
    visit = (video.Video & {"video_id": three_gone[1]}).fetch1("session_id")
    assert "tried again" in web.client().get(f"/visits/{visit}").text
    assert "There are no errors" in browser.get("/operate").text


@pytest.mark.parametrize("language", ["en", "de"])
def test_each_error_of_a_kind_leads_to_its_own_recording(three_gone: list[int], tmp_path: Path, language: str):
    for film in range(3):
        (tmp_path / f"walk{film}.mp4").write_bytes(b"no longer this film")
    browser = web.client("reviewer,operator")
    again(browser, table="VideoInfo", code="VIDEO_MISSING")
    populate()
    page = browser.get("/operate", headers={"accept-language": language}).text
    assert [page.count(f'<a href="/recordings/{number}#usable">') for number in three_gone] == [1, 1, 1]


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"table": "Nothing", "code": "VIDEO_MISSING"}, 400),
        ({"table": "", "code": "VIDEO_MISSING"}, 415),
        ({"table": "VideoInfo", "code": ""}, 415),
        ({"table": "VideoInfo", "code": "x' OR '1'='1"}, 400),
        ({"table": "VideoInfo", "code": "OTHER_CODE"}, 303),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": "{"}, 415),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": "[1]"}, 415),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": '{"a":' * 2000}, 415),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": '{"video_id": [1, 2]}'}, 415),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": '{"status": "error"}'}, 303),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "key": '{"video_id": "1 OR 1=1"}'}, 303),
        ({"table": "VideoInfo", "code": "VIDEO_MISSING", "token": ""}, 403),
    ],
)
def test_forged_retries_change_nothing(three_gone: list[int], fields: dict[str, str], code: int):
    before = everything()
    answer = again(web.client("operator"), **fields)
    assert answer.status_code == code, answer.text
    assert everything() == before


def test_the_first_page_of_each_role(tables: None):
    operator, reviewer = web.client("operator"), web.client()
    assert operator.get("/", follow_redirects=False).headers["location"] == "/operate"
    assert reviewer.get("/", follow_redirects=False).headers["location"] == "/visits"
    assert reviewer.get("/operated").status_code == 404  # no page that begins alike


def test_a_page_without_workers_and_jobs_says_how_to_start_one(tables: None):
    assert "No worker is alive. Compute a visit on its page" in web.client("operator").get("/operate").text


def test_what_is_being_computed_by_whom_since_when(three_gone: list[int]):
    jobs = jobs_of(video.VideoInfo)
    jobs.connection.query(
        f"UPDATE {jobs.full_table_name} SET status='reserved', host='gait<b>', pid=42,"
        " reserved_time='2026-01-02 03:04:05' WHERE video_id = %s",
        args=(three_gone[0],),
    )
    (job,) = status.running()
    assert (job.table, job.host, job.pid, job.about) == ("VideoInfo", "gait<b>", 42, "walk0.mp4")
    page = web.client("operator").get("/operate").text
    assert "gait&lt;b&gt;:42" in page
    assert "No worker is alive" not in page
    assert "No worker runs; what is being computed now was started on a page or by a command" in page
    since = datetime.datetime(2026, 1, 2, 3, 4, tzinfo=datetime.UTC).astimezone()
    assert f"{since:%Y-%m-%d %H:%M}" in page
    assert f'href="/recordings/{three_gone[0]}"' not in page  # an operator does not look
    german = web.client("operator").get("/operate", headers={"accept-language": "de"}).text
    assert german.count("Lesen des Videos <code") >= 2  # among the stages and what is being computed


def test_from_the_click_to_the_queue_in_a_browser(three_gone: list[int], chromium: Any):
    with web.shown(chromium, role="operator") as page:
        page.wait_for_url("**/operate")
        # The name of a folder may be long.
        page.evaluate("for (const e of document.querySelectorAll('dt, dd')) e.textContent += '/wide'.repeat(30)")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.get_by_role("button", name="Try all of this kind again (3)").click()
        page.get_by_role("status").wait_for()
        assert "3 jobs were put back" in page.get_by_role("status").inner_text()
        page.wait_for_load_state()  # the style may come after the text
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert _errors() == set()
