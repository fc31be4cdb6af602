"""What is deleted takes along all that was computed from it, and comes back by the queue."""

import re
from pathlib import Path

import pytest

import pbl_schemas
from pbl_schemas import chain as tables_in_order
from pbl_schemas import connection, tracking, video
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.decisions import review_decisions
from pbl_workers.populate import populate
from tests.command import pbl
from tests.rows import register

from . import chain
from .jobs import counts


def _chain() -> list[str]:
    return [t.__name__ for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST]


def test_video_info_again_deletes_what_was_computed_from_it(tables: None, tmp_path: Path):
    one, dark = register(chain.small_video(tmp_path, "walk"), chain.small_video(tmp_path, "dark"))
    populate(_chain())
    before = counts()
    assert before["Tracking"] == 2
    review_decisions.mark_not_usable(dark, "other", "dark", by="A. First")
    assert len(tracking.Tracking & {"video_id": dark}) == 1  # marking deletes nothing
    dry = pbl("reprocess", "--table", "VideoInfo")
    assert "2 rows of VideoInfo would be deleted" in dry.out
    assert "1 of them only when they are asked for again" in dry.out
    assert pbl("reprocess", "--table", "VideoInfo", "--yes").code == 0
    assert set(counts().values()) == {0}
    assert not {t.table: t.errors for t in populate(_chain()).tables if t.errors}
    assert {int(v) for v in video.VideoInfo.to_arrays("video_id")} == {one}
    assert len(tracking.Tracking - video.VideoInfo) == 0
    assert counts()["SessionGdi"] == 1
    review_decisions.take_back(dark, by="A. First")
    populate(_chain())
    of_videos = ("VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput")
    assert {n: counts()[n] for n in of_videos} == {n: before[n] for n in of_videos}


def test_every_table_has_a_foreign_key_to_each_result_that_it_reads(
    tables: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """So that the server deletes nothing that something was computed from, without it."""
    register(chain.small_video(tmp_path, "walk"))
    populate(_chain())
    names = {cls: name for name, cls in tables_in_order.tables().items()}
    by_server = {cls.full_table_name: name for cls, name in names.items()}
    server, asked = connection.connect(), []
    real = server.query
    monkeypatch.setattr(server, "query", lambda text, *a, **k: (asked.append(text), real(text, *a, **k))[1])
    for table in pbl_schemas.computed_tables():
        for key in table().keys()[:1]:
            asked.clear()
            table().make_fetch(dict(key))
            read = {by_server[n] for text in asked for n in re.findall(r"`[^`]+`\.`[^`]+`", text) if n in by_server}
            results = {n.split(".")[1] for n in read} & {*_chain()} - {table.__name__}
            assert results <= _above(names[table]), table.__name__


def _above(name: str) -> set[str]:
    """Names of the tables that a table or its parts refer to, directly or through others and their parts."""
    found, todo, known = set(), [name], tables_in_order.tables()
    while todo:
        master = ".".join(todo.pop().split(".")[:2])
        if master in found:
            continue
        found.add(master)
        for path, cls in known.items():
            if path == master or path.startswith(f"{master}."):
                todo += tables_in_order.references(path, cls)
    return {n.split(".")[1] for n in found - {name}}
