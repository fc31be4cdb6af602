"""A row for each look at a recording, where that is asked for."""

import json
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline.errors import PblError
from pbl_schemas.operations import embedded, forget
from pbl_schemas.review import Viewing
from pbl_workers.web import Where, audit, serve
from tests import Environment, Limits
from tests.command import pbl
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import register


@pytest.fixture
def audited(tables: None, tmp_path: Path, environment: Environment) -> int:
    """A video, and a page that has to write looks down."""
    environment(PBL_AUDIT_LOOKS="1")
    return register(small_video(tmp_path, "walk"), session_label="2026-01-10")[0]


def rows() -> list[tuple[Any, ...]]:
    found = Viewing().to_dicts(order_by="viewing_id")
    return [(r["viewing_by"], r["viewing_what"], r["video_id"], r["session_id"]) for r in found]


def test_each_look_is_a_row_before_anything_is_shown(audited: int, limits: Limits):
    browser = web.client(name="A. First")
    assert browser.get("/visits").status_code == browser.get("/visits/1").status_code == 200
    assert rows() == []  # measures are no look at a recording
    for _ in range(2):
        assert browser.get(f"/recordings/{audited}").status_code == 200
    assert rows() == [("A. First", "page", audited, None)] * 2
    for part in ("bytes=0-9", "bytes=10-19"):
        assert browser.get(f"/recordings/{audited}/video", headers={"range": part}).status_code == 206
    assert rows()[2:] == [("A. First", "video", audited, None)]
    web.client(name="B. Second").head(f"/recordings/{audited}/video")
    assert rows()[3:] == [("B. Second", "video", audited, None)]
    browser.get("/visits/1/export")
    browser.get("/visits/1/enter")
    assert rows()[4:] == [("A. First", "export", None, 1)]
    limits(audit, AGAIN_S=0.0)  # later it is another look
    browser.get(f"/recordings/{audited}/video")
    assert len(rows()) == 6
    listed = json.loads(pbl("list", "looks", "--subject", "P001", "--json").out)
    whose = ("by", "what", "subject", "session_label", "session_id", "video_id")
    assert [tuple(row[k] for k in whose) for row in listed[:2]] == [
        ("A. First", "video", "P001", "2026-01-10", 1, audited),
        ("A. First", "export", "P001", "2026-01-10", 1, None),
    ]
    assert len(listed) == 6
    assert pbl("list", "looks", "--subject", "P002").out == "none\n"
    assert not forget.forget("P001").left
    assert rows() == []


def test_a_page_as_json_is_a_look_as_the_page_is(audited: int):
    browser = web.client(name="A. First")
    assert browser.get("/visits.json").status_code == browser.get("/visits/1.json").status_code == 200
    assert rows() == []
    for _ in range(2):
        assert browser.get(f"/recordings/{audited}.json").status_code == 200
    assert rows() == [("A. First", "page", audited, None)] * 2
    assert browser.get("/recordings/999.json").json()["error"]["code"] == "DB_NOT_FOUND"
    assert web.client(signed_in=False).get(f"/recordings/{audited}.json").status_code == 401
    assert len(rows()) == 2


def test_no_row_for_what_there_is_not_or_nobody_saw(audited: int, environment: Environment):
    assert web.client(signed_in=False).get(f"/recordings/{audited}/video").status_code == 401
    assert web.client("operator").get(f"/recordings/{audited}/video").status_code == 403
    assert web.client().get("/recordings/999/video").status_code == 404
    assert web.client().get(f"/recordings/{10**30}/video").status_code == 404
    assert rows() == []
    environment(PBL_AUDIT_LOOKS="0")
    assert web.client().get(f"/recordings/{audited}/video").status_code == 200
    assert rows() == []


def test_what_cannot_be_written_down_is_not_shown(audited: int):
    browser = web.client()
    browser.get(f"/recordings/{audited}/video")
    embedded.stop()
    try:
        answer = browser.get(f"/recordings/{audited}")
        assert answer.status_code == 503
        assert "DB_NOT_RUNNING" in answer.text
        assert answer.headers["content-security-policy"]
    finally:
        embedded.start()
    assert browser.get(f"/recordings/{audited}").status_code == 200
    assert [r[1] for r in rows()] == ["video", "page"]


def test_a_folder_is_not_shown_where_rows_are_asked_for(environment: Environment):
    environment(PBL_AUDIT_LOOKS="1")
    folder: Any = object()  # refused before it is looked into
    with pytest.raises(PblError, match="--folder with PBL_AUDIT_LOOKS"):
        serve(Where(port=0), folder=folder)
