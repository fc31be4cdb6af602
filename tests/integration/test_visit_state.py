"""The verdicts on all recordings of a visit at once, and the tag by which a phone asks whether they are others."""

import contextlib
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import gait, keypoints, video
from pbl_schemas.connection import dj
from pbl_schemas.decisions import event_corrections, review_decisions
from pbl_schemas.intake.protocols import ProtocolStep, add_protocol
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading.usable import usable, verdicts
from pbl_schemas.reading.why import why, whys
from pbl_workers import refresh
from pbl_workers.populate import populate
from tests import not_none
from tests.integration import web
from tests.integration.chain import small_video
from tests.integration.compute_target import nothing
from tests.integration.test_web_phone import film, link_of, phone, send, visit  # noqa: F401  a fixture
from tests.rows import copies, new_visit, register


@contextlib.contextmanager
def statements() -> Iterator[list[str]]:
    """The statements of this process."""
    connection, found = dj.conn(), []
    execute = connection._execute_query

    def noted(cursor: Any, query: str, *args: Any) -> None:
        found.append(query)
        execute(cursor, query, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connection, "_execute_query", noted)
        yield found


def test_all_verdicts_at_once_are_those_one_by_one_with_as_many_statements(tables: None, tmp_path: Path):
    kinds = [small_video(tmp_path, "walk"), small_video(tmp_path, "empty", people="nobody")]
    kinds += [small_video(tmp_path, "short", n=1), small_video(tmp_path, "which", people="two alike")]
    numbers = register(*kinds, session_label="2026-01-10")
    populate()
    numbers += register(small_video(tmp_path, "waits", n=60), session_label="2026-01-10")
    refresh.refresh()
    verdicts(numbers)  # declares the queues
    with statements() as few:
        verdicts(numbers)
    for number in numbers:
        copies(number, 20, 100 * number)
    numbers = [int(v) for v in video.Video().to_arrays("video_id")]
    assert len(numbers) == 105
    rng, server = random.Random(1), dj.conn()

    def drawn() -> str:
        """The numbers of some recordings, in a statement."""
        return ", ".join(map(str, rng.sample(numbers, 20)))

    for outcome in ("WARN", "FAIL"):
        server.query(
            f"UPDATE {keypoints.Keypoints.Check.full_table_name} SET keypoints_check_outcome = '{outcome}',"
            f" keypoints_check_advice = CONCAT(video_id, ' is dark') WHERE video_id IN ({drawn()})"
        )
    server.query(f"UPDATE {gait.GaitCycle.Cycle.full_table_name} SET cycle_used = 0 WHERE video_id IN ({drawn()})")
    server.query(f"UPDATE {jobs_of(video.VideoInfo).full_table_name} SET status = 'error', error_message ="
                 f" CONCAT('VIDEO_NOT_A_VIDEO: ', video_id) WHERE video_id IN ({drawn()}, {numbers[-1]})")  # fmt: skip
    for number in rng.sample(numbers, 10):
        review_decisions.mark_not_usable(number, "helped")
    one_by_one = {number: usable(number) for number in numbers}
    assert {u.state for u in one_by_one.values()} == {"pending", "usable", "remarks", "unusable"}
    with statements() as many:
        assert verdicts(numbers) == one_by_one
    assert len(many) <= len(few)
    assert whys(numbers) == {number: why(number) for number in numbers}


def test_a_phone_is_told_what_changed_and_nothing_else(visit: int, tmp_path: Path):  # noqa: F811
    add_protocol("clinic", [ProtocolStep(1, "walking", "", "any", 1)])
    browser, tags = phone(visit), [""]

    def changes() -> bool:
        """Whether the answer has another tag than the last one, whose body is sent once."""
        answer = browser.get("/phone/state.json", headers={"if-none-match": tags[-1]} if tags[-1] else {})
        if answer.status_code == 304:
            assert (answer.content, answer.headers["etag"]) == (b"", tags[-1])
            return False
        assert answer.status_code == 200, answer.text
        assert answer.headers["etag"] != tags[-1]
        tags.append(answer.headers["etag"])
        return True

    assert changes()
    assert not changes()
    send(browser, small_video(tmp_path, "walk").read_bytes(), step="1")
    assert changes()
    (number,) = (int(v) for v in video.Video().to_arrays("video_id"))
    # Rows of others, or what is not said of these.
    register(small_video(tmp_path, "other", n=60), session_label="2026-03-01")
    refresh.refresh()
    dj.conn().query(f"UPDATE {jobs_of(video.VideoInfo).full_table_name} SET priority = priority + 1")
    link_of(new_visit("2026-04-01"), protocol="clinic")
    assert not changes()
    link_of(visit, protocol="clinic")
    assert changes()
    link_of(visit, protocol="clinic")
    assert not changes()
    populate()
    assert changes()
    assert not changes()
    review_decisions.mark_not_usable(number, "helped")
    assert changes()
    review_decisions.take_back(number, "", review_decisions.usable_state(number))
    assert changes()
    assert tags[-1] == tags[-3]  # it is as before
    events = not_none(event_corrections.shown_events(number))
    (time, side, kind, *_), *others = events.events
    event_corrections.save(number, [(time + 0.02, side, kind), *(e[:3] for e in others)], "A. First", events.state)
    assert changes()
    assert "cycles" not in browser.get("/phone/state.json").json()["recordings"][0]["verdict"]
    populate()
    assert changes()
    video.Video.connection.query(f"UPDATE {video.Video.full_table_name} SET video_name = 'moved.mp4'")
    with statements() as few:
        assert not changes()
    copies(number, 20, 100)
    assert changes()
    with statements() as many:
        assert not changes()
    assert len(few) > len(many)  # those of the answer and of the question, and the question alone
    assert sum("UNION ALL" in line for line in many) == 1


def test_the_page_of_a_visit_asks_as_many_statements_for_one_recording_as_for_many(visit: int, tmp_path: Path):  # noqa: F811
    reviewer, browser = web.client(target=nothing), phone(visit, protocol="")
    send(browser, film(tmp_path))

    def asked() -> int:
        assert reviewer.get(f"/visits/{visit}").status_code == 200
        with statements() as found:
            assert reviewer.get(f"/visits/{visit}").status_code == 200
        return len(found)

    few = asked()
    copies(int(video.Video().fetch1("video_id")), 20)
    assert asked() == few
