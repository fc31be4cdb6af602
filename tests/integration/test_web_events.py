"""Events that a person corrects: the rows, what follows from them, conflicts, and dragging in a browser."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbl_pipeline.gait
from pbl_pipeline.errors import PblError
from schemas import decide, fit, gait, gdi, hand_events, qc, study
from schemas.export import visits_of_tables
from schemas.forget import forget
from schemas.intake import move
from schemas.recording_page import recording_about, recording_fit, trial_key
from schemas.results import load_session
from schemas.review import Decision
from schemas.studies import slices
from schemas.visit_list import Filter, visit_page
from schemas.visit_page import visit_about
from tests.integration import decide_target, web
from tests.integration.chain import small_video
from tests.rows import everything_but_refreshes, register
from workers.populate import populate
from workers.web.judge import _events


@pytest.fixture
def visit(tables: None, tmp_path: Path) -> str:
    """A computed visit of two recordings, 1 and 2; the method of its events."""
    register(small_video(tmp_path, "a"), small_video(tmp_path, "b", n=250), session_label="2026-01-10")
    populate()
    return str(gait.GaitPlan.fetch1("gait_method"))


def moved(number: int = 1, by: float = 0.1, which: int = 6) -> list[tuple[float, str, str]]:
    """The events of a recording, one of them later by so many seconds."""
    found = hand_events.shown(number)
    assert found is not None
    events = [e[:3] for e in found.events]
    time, side, kind = events[which]
    return [*events[:which], (time + by, side, kind), *events[which + 1 :]]


def save(number: int, events: list[tuple[float, str, str]], by: str = "A. First") -> dict[str, int]:
    found = hand_events.shown(number)
    assert found is not None
    return hand_events.save(number, events, by, found.state)


def form_of(browser: Any, number: int) -> dict[str, str]:
    """The hidden fields of the form that saves events, and the events that the page shows."""
    page = browser.get(f"/recordings/{number}").text
    form = page[page.index(f'action="/recordings/{number}/events"') :]
    form = form[: form.index("</form>")]
    found = re.search(r'data-events="([^"]*)"', form)
    assert found
    return {**dict(re.findall(r'type="hidden" name="([a-z]+)" value="([^"]*)"', form)), "events": found[1]}


def send(browser: Any, number: int, form: dict[str, str], /, **more: str):
    return browser.post(f"/recordings/{number}/events", data={**form, **more}, follow_redirects=False)


def test_corrected_events_are_a_method_of_their_own(visit: str):
    automatic = {k: v for k, v in everything_but_refreshes().items() if ".__" in k}
    browser = web.client(name="A. First")
    form = form_of(browser, 1)
    events = _events(form["events"])
    assert events == [(round(t, 4), s, k) for t, s, k in moved(by=0.0)]
    time, side, kind = events[6]
    text = form["events"].replace(f"{time:.4f}", f"{time + 0.1:.4f}", 1)
    assert send(browser, 1, form, events=text).status_code == 303
    # The rows say what was set by hand, what it began from, who and when.
    row = gait.HandEvents.fetch1()
    assert (row["video_id"], row["hand_from"], row["hand_changed"], row["hand_by"]) == (1, visit, 1, "A. First")
    assert (row["hand_person"], row["hand_tracking"]) == (1, "blazepose-tiles-v2")
    by_hand = gait.HandEvents.Event & "hand_probability is null"
    assert by_hand.fetch1("hand_time", "hand_side", "hand_kind") == (pytest.approx(time + 0.1, abs=1e-4), side, kind)
    method = (gait.GaitEventMethod & {"gait_method_name": "by-hand"}).fetch1()
    sha = (gait.GaitEventMethod & {"gait_method": visit}).fetch1("gait_method_sha")
    assert method["gait_params"] == {"automatic": visit, "automatic_hash": sha}
    (decided,) = Decision().to_dicts()
    assert (decided["video_id"], decided["decision_what"], decided["decision_by"]) == (1, "events", "A. First")
    assert decided["decision_about"] == {"method": visit}
    assert (decided["decision_before"]["by"], decided["decision_after"]["by"]) == ("automatic", "hand")
    assert decided["decision_after"]["changed"] == 1
    assert [time, side, kind] in decided["decision_before"]["events"]
    # Nothing of the automatic method is touched; the page shows the new ones at once.
    assert {k: v for k, v in everything_but_refreshes().items() if ".__" in k} == automatic
    page = browser.get("/recordings/1").text
    assert "1 events corrected by A. First" in page
    assert page.count("by hand</td>") == 1
    shown = recording_about(1).events
    assert next(e for e in shown if e.probability == 1.0).time_s == pytest.approx(time + 0.1, abs=1e-4)
    # What follows is computed beside it: the corrected trial by hand, the other one automatically.
    run = {t.table: t.done for t in populate().tables if t.done}
    assert run == {
        "GaitEvents": 2, "GaitCycle": 2, "Spatiotemporal": 2, "GDI": 2, "SessionGdi": 1, "SessionQc": 1
    }  # fmt: skip
    rows = {r["video_id"]: r for r in (gait.GaitEvents & {"gait_method": "by-hand-v1"}).to_dicts()}
    assert rows[1]["events_method_hash"] == rows[2]["events_method_hash"] == method["gait_method_sha"]
    assert [rows[i]["events_detector"] for i in (1, 2)] == ["by-hand", visit.rpartition("-v")[0]]
    both = (gait.GaitEvents.Event & {"video_id": 2}).to_dicts(order_by="gait_method, event_no")
    assert [r["event_time"] for r in both[: len(both) // 2]] == [r["event_time"] for r in both[len(both) // 2 :]]
    check = gait.GaitEvents.Check & {"video_id": 1, "gait_method": "by-hand-v1", "events_check": "events_by_hand"}
    assert check.fetch1("events_check_value") == 1.0
    # The measures of the visit are those of the corrected events, in both ways through the tables.
    measures = {r["gait_method"]: r for r in gdi.SessionGdi().to_dicts()}
    assert measures[visit]["session_stance"] != measures["by-hand-v1"]["session_stance"]
    trial = {r["gait_method"]: r["stance"] for r in (gait.Spatiotemporal & {"video_id": 1}).to_dicts()}
    assert trial["by-hand-v1"] != trial[visit]
    about = visit_about(1)
    assert [r.automatic for r in about.results] == [visit, ""]
    assert about.results[0].methods[1] == "by-hand-v1"
    assert "events by hand" in browser.get("/visits/1").text
    assert load_session({"session_id": 1}).key["gait_method"] == "by-hand-v1"
    assert load_session({"session_id": 1, "gait_method": visit}).key["gait_method"] == visit
    assert [v["gait_method"] for v in visits_of_tables({})] == ["by-hand-v1"]
    assert browser.get("/visits/1/export?result=0").status_code == browser.get("/visits/1/export?result=1").status_code
    assert not populate().did_something


def test_corrections_again_and_back_to_the_automatic_ones(visit: str):
    events = moved()
    save(1, events)
    save(2, moved(2))
    populate()
    sums = {r["gait_method"]: r["session_stance"] for r in gdi.SessionGdi().to_dicts()}
    deleted = save(1, moved(by=0.05), "B. Second")  # from those of A. First
    assert deleted["`pbl_gait`.`__gait_events`"] == 1
    assert len(gdi.SessionGdi & {"gait_method": "by-hand-v1"}) == len(qc.SessionQc & {"gait_method": "by-hand-v1"}) == 0
    assert len(gait.GaitEvents & {"gait_method": "by-hand-v1"}) == 1  # the other trial's stay
    assert len(gait.GaitPlan()) == 2
    populate()
    assert (gdi.SessionGdi & {"gait_method": "by-hand-v1"}).fetch1("session_stance") != sums["by-hand-v1"]
    with pytest.raises(PblError, match="are there already"):
        save(1, moved(by=0.0))
    browser = web.client()
    assert send(browser, 1, form_of(browser, 1), back="automatic").status_code == 303
    populate()
    rows = (gait.GaitEvents & {"video_id": 1}).to_dicts()
    assert {r["events_detector"] for r in rows} == {visit.rpartition("-v")[0]}
    assert len(gait.GaitPlan()) == 2  # the other recording's corrections count
    assert send(browser, 2, form_of(browser, 2), back="automatic").status_code == 303
    assert gait.GaitPlan.fetch1("gait_method") == visit
    assert len(gait.HandEvents()) == len(gait.HandEvents.Event()) == 0
    assert set(gait.GaitEvents().to_arrays("gait_method")) == {visit}
    assert set(gdi.SessionGdi().to_arrays("gait_method")) == {visit}
    assert not populate().did_something
    told = [(d.before["by"], d.after["by"]) for d in decide.decisions(1)]
    assert told == [("hand", "automatic")] * 2 + [("hand", "hand")] + [("automatic", "hand")] * 2
    assert f"by hand, {len(events)} events" in browser.get("/visits/1").text


def test_what_is_refused_changes_nothing(visit: str):
    browser, reader, before = web.client(), web.client(role="reader"), everything_but_refreshes()
    form = form_of(browser, 1)
    first = form["events"].split()[0]
    for events, code, words in (
        (form["events"] + " 99.0ld", 409, "a time inside the recording"),
        (form["events"] + f" {float(first[:-2]) + 0.02:.4f}{first[-2:]}", 409, "between two"),
        (" ".join(w for w in form["events"].split() if not w.endswith("lu")), 409, "toe-off of the left foot"),
        (form["events"], 400, "are there already"),
        ("1.0xd", 415, ""),
        ("nan", 415, ""),
        ("-1.0ld", 415, ""),
    ):
        answer = send(browser, 1, form, events=events)
        assert (answer.status_code, words in answer.text) == (code, True), (events[-20:], answer.text)
    changed = form["events"].replace(first, "", 1)
    for wrong in ({"seen": "x"}, {"token": ""}):
        assert send(browser, 1, form, **{"events": changed, **wrong}).status_code in (403, 409)
    assert send(browser, 999, form, events=changed).status_code == 404
    assert "/events" not in reader.get("/recordings/1").text
    assert web.post(reader, "/recordings/1/events", events=changed, seen=form["seen"]).status_code == 403
    assert everything_but_refreshes() == before


def test_two_people_correct_at_the_same_moment(visit: str):
    found = hand_events.shown(1)
    assert found is not None
    calls = [(1, moved(by=d), name, found.state) for d, name in ((0.1, "A. First"), (0.05, "B. Second"))]
    late, done = decide_target.at_once("schemas.hand_events.save", *calls)
    assert (done, late[0]) == (("done", ""), "DECIDED_MEANWHILE")
    assert f"{gait.HandEvents.fetch1('hand_by')} decided for by hand, changed 1" in late[1]
    assert len(Decision()) == 1
    with pytest.raises(PblError, match="decided for by hand"):
        hand_events.save(1, moved(by=-0.05), "C", "old")


def test_a_correction_while_the_measures_are_computed(visit: str, monkeypatch: pytest.MonkeyPatch):
    """What was computed of earlier corrections is not written: it is computed again from the later ones."""
    save(1, moved())
    real, corrected_again = pbl_pipeline.gait.gait_metrics, []

    def slow(*args: Any, **named: Any):
        done = real(*args, **named)
        if not corrected_again:
            corrected_again.append(True)
            save(1, moved(by=0.1), "B. Second")
        return done

    monkeypatch.setattr(pbl_pipeline.gait, "gait_metrics", slow)
    run = populate()
    assert corrected_again
    assert {t.table: t.errors for t in run.tables if t.errors} == {"SessionGdi": {"INPUT_CHANGED": 1}}  # tried again
    (row,) = (gdi.SessionGdi & {"gait_method": "by-hand-v1"}).to_dicts()
    events = (gait.GaitEvents.Event & {"video_id": 1, "gait_method": "by-hand-v1"}).to_arrays(
        "event_time", order_by="event_no"
    )
    hand = gait.HandEvents.Event().to_arrays("hand_time", order_by="hand_no")
    np.testing.assert_allclose(events, hand)
    gdi.SessionGdi.delete(prompt=False)
    populate()
    again = (gdi.SessionGdi & {"gait_method": "by-hand-v1"}).fetch1()
    assert row["session_stance"] == again["session_stance"]


def test_a_decision_waits_for_the_insert_that_reads_what_it_changes(visit: str):
    """Rows of corrected events that are being read inside a transaction are not changed before its end."""
    from contextlib import closing

    from schemas import connection

    save(1, moved())
    key = trial_key(1)
    assert key is not None
    waited = threading.Event()

    def other() -> None:
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute("SELECT session_id FROM pbl_session.session FOR UPDATE")
            waited.set()

    thread = threading.Thread(target=other)
    with gait.HandEvents().connection.transaction:
        assert gait.corrected(key, [1])
        thread.start()
        assert not waited.wait(0.5)
    assert waited.wait(10)
    thread.join()


def test_corrections_are_of_the_person_that_was_measured(visit: str):
    save(1, moved())
    populate()
    decide.decide_person(1, 2)
    populate()
    found = hand_events.shown(1)
    assert found is not None
    assert (found.hand, found.stale) == (None, True)
    rows = (gait.GaitEvents & {"video_id": 1, "gait_method": "by-hand-v1"} & fit.current()).to_dicts()
    assert [r["events_detector"] for r in rows] == [visit.rpartition("-v")[0]]
    page = web.client().get("/recordings/1").text
    assert "corrected for another person" in page
    decide.decide_person(1, 1)
    populate()
    assert (gait.GaitEvents & {"video_id": 1, "gait_method": "by-hand-v1"} & fit.current()).fetch1(
        "events_detector"
    ) == "by-hand"
    assert recording_fit(trial_key(1) or {}).cycles  # those of the corrected events


def test_trend_slices_move_and_forget(visit: str, tmp_path: Path):
    register(small_video(tmp_path, "c", n=260), session_label="2026-04-10")
    populate()
    study.Visit.insert({"session_id": i, "visit_role": r} for i, r in ((1, "pre"), (2, "3_months")))
    slices.freeze("automatic")
    assert study.StudySlice.fetch1("gait_method") == visit
    save(3, moved(3))
    populate()
    # Corrected against automatic: a change, of which no error is known. A slice takes one method for everybody.
    (row,) = [v for v in visit_page(Filter()).visits if v.session_id == 2]
    assert (row.result.automatic, row.more) == (visit, 1) if row.result else False
    assert row.trend is not None
    assert (row.trend.session_id, row.trend.sure) == (1, None)
    assert not slices.changes("automatic")
    slices.freeze("again")
    assert len(set(study.StudySlice().to_arrays("slice_hash"))) == 1
    slices.freeze("hand", methods={"gait_method": "by-hand-v1"})
    # The corrections go with their recording, and with their person.
    move.carry_out(move.plan_move(3, "P001", "2026-01-10"))
    populate()
    assert (gait.GaitEvents & {"video_id": 3, "gait_method": "by-hand-v1"} & fit.current()).fetch1(
        "events_detector"
    ) == "by-hand"
    assert not forget("P001").left
    assert len(gait.HandEvents()) == len(gait.HandEvents.Event()) == 0


@pytest.mark.needs_extra
@pytest.mark.slow
def test_from_dragging_a_mark_to_the_row(chromium: Any, visit: str):
    before = hand_events.shown(1)
    assert before is not None
    with web.shown(chromium, name="A. First", size=(1200, 900), refused=True) as page:
        page.goto("/recordings/1")
        page.wait_for_selector("[data-ready]")
        page.get_by_text("Correct the events").click()
        marks = page.locator(".track .mark")
        assert marks.count() == len(before.automatic)
        # By the mouse: 0.2 s later, on a frame; the video shows it.
        marks.nth(6).scroll_into_view_if_needed()
        box = marks.nth(6).bounding_box()
        page.mouse.move(box["x"] + 13, box["y"] + 10)
        page.mouse.down()
        page.mouse.move(box["x"] + 13 + 18, box["y"] + 10, steps=4)
        page.mouse.up()
        frame = round((before.automatic[6][0] + 0.2) * 30)
        page.wait_for_selector(f"canvas.body[data-frame='{frame}']")
        # By the keyboard: two frames back; another is deleted, and one is added at the frame that is shown.
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("ArrowLeft")
        page.wait_for_selector(f"canvas.body[data-frame='{frame - 2}']")
        assert f"at {(frame - 2) / 30:.2f} s" in page.locator(".correct .said").inner_text()
        marks.nth(marks.count() - 1).focus()
        page.keyboard.press("Delete")
        assert marks.count() == len(before.automatic) - 1
        # What the server refuses is said, and the marks stay.
        page.locator("#position").fill("5")
        page.wait_for_selector("canvas.body[data-frame='5']")
        page.get_by_role("button", name="+ Left: initial contact").click()
        page.get_by_role("button", name="+ Left: initial contact").click()
        page.get_by_role("button", name="Save the events").click()
        problem = page.locator(".correct .problem")
        problem.wait_for()
        assert "EVENTS_IMPLAUSIBLE" in problem.inner_text()
        assert marks.count() == len(before.automatic) + 1
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        for _ in range(2):
            page.get_by_label(f"Left initial contact at {5 / 30:.2f} s").first.focus()
            page.keyboard.press("Delete")
        with page.expect_navigation():
            page.get_by_role("button", name="Save the events").click()
        page.wait_for_selector("[data-ready]")
    found = hand_events.shown(1)
    assert found is not None
    assert found.hand is not None
    set_by_hand = [e for e in found.hand if e[3] is None]
    assert [(round(t * 30), s, k) for t, s, k, _ in set_by_hand] == [(frame - 2, *before.automatic[6][1:3])]
    assert (len(found.hand), found.n_changed, found.by) == (len(before.automatic) - 1, 2, "A. First")
    assert Decision.fetch1("decision_by") == "A. First"
