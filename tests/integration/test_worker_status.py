"""What `pbl status` asks the server: names and plans of its queries. What it counts is tested where rows are made."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymysql.err import OperationalError

import pbl_schemas
from pbl_schemas import connection, video
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading import status
from pbl_schemas.worker import installation_lock


@pytest.fixture(scope="module")
def server(database: Path) -> Iterator[Any]:
    """A connection beside the tables' own."""
    pbl_schemas.activate()
    found = connection.another()
    yield found
    found.close()


def test_queues_are_counted_under_the_names_that_datajoint_gives_them(server: Any):
    for table in pbl_schemas.computed_tables():
        schema, name = status.queue_name(table)
        assert f"`{schema}`.`{name}`" == jobs_of(table).full_table_name
    counts = status.queue_counts(server)
    assert list(counts) == [t.__name__ for t in pbl_schemas.computed_tables()]


def test_a_queue_that_was_never_used_counts_as_empty(server: Any, monkeypatch: pytest.MonkeyPatch):
    real = status.queue_name
    monkeypatch.setattr(status, "queue_name", lambda t: ("pbl_video", "~~gone") if t is video.VideoInfo else real(t))
    assert set(status.queue_counts(server)["VideoInfo"].values()) == {0}


def test_counting_reads_narrow_indexes_and_no_rows(server: Any, monkeypatch: pytest.MonkeyPatch):
    """With 300,000 videos the rows of a table are 100 to 250 MB, an index of them 20."""
    asked: list[str] = []

    class Asked:
        def query(self, text: str, **_: Any) -> Any:
            asked.append(text)
            return server.query(text)

    for table in pbl_schemas.computed_tables():
        status._rows(table, Asked())
    status.camera_kinds(Asked())
    assert len(asked) == len(pbl_schemas.computed_tables()) + 1
    for text in asked:
        plan = server.query(f"EXPLAIN {text}", as_dict=True).fetchall()
        read = [row for row in plan if not str(row["table"]).startswith("<derived")]
        assert read, text
        for row in read:
            assert row["key"] not in (None, "PRIMARY"), text
            assert "Using index" in row["Extra"], text


def test_two_processes_do_not_do_the_same_work_at_once(server: Any):
    with installation_lock("refresh", server) as first, installation_lock("refresh", video.Video.connection) as second:
        assert (first, second) == (True, False)
    with installation_lock("refresh", video.Video.connection) as third:
        assert third


def test_work_that_ended_on_a_full_disk_can_be_done_again(server: Any):
    """The connection of a page lives on: it does not keep the lock when its row cannot be deleted."""

    def query(text: str, **more: Any) -> Any:
        if text.startswith("DELETE"):
            raise OperationalError(1114, "The table 'turn' is full")
        return server.query(text, **more)

    with pytest.raises(OperationalError), installation_lock("refresh", SimpleNamespace(query=query)):
        pass
    with installation_lock("refresh", video.Video.connection) as again:
        assert again
