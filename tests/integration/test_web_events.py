"""Events that a person corrects: the rows, what follows from them, conflicts, and dragging in a browser."""

import dataclasses
import io
import json
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest

import pbl_pipeline.gait
from pbl_pipeline.errors import PblError
from pbl_schemas import fit, gait, gdi, load_visit, qc, study
from pbl_schemas.decisions import event_corrections, review_decisions
from pbl_schemas.intake import move
from pbl_schemas.operations.forget import forget
from pbl_schemas.reading import list_fitted
from pbl_schemas.reading.shown import shown_recording, shown_visit
from pbl_schemas.reading.visit_list import Filter, visit_page
from pbl_schemas.review import Decision
from pbl_schemas.rows import delete_below
from pbl_schemas.studies import slices
from pbl_workers.populate import populate
from pbl_workers.web import export
from pbl_workers.web.corrections import _events
from tests import Faults, Limits, not_none
from tests.integration import decide_target, web
from tests.integration.chain import computed_once, small_video
from tests.rows import everything_but_refreshes, register


@computed_once
def visit(folder: Path) -> str:
    """A computed visit of two recordings, 1 and 2; the method of its events."""
    register(small_video(folder, "a"), small_video(folder, "b", n=250), session_label="2026-01-10")
    populate()
    return str(gait.GaitPlan.fetch1("gait_method"))


def moved(number: int = 1, by: float = 0.1, which: int = 6) -> list[tuple[float, str, str]]:
    """The events of a recording, one of them later by so many seconds."""
    found = not_none(event_corrections.shown_events(number))
    events = [e[:3] for e in found.events]
    time, side, kind = events[which]
    return [*events[:which], (time + by, side, kind), *events[which + 1 :]]


def save(number: int, events: list[tuple[float, str, str]], by: str = "A. First") -> dict[str, int]:
    return event_corrections.save(number, events, by, not_none(event_corrections.shown_events(number)).state)


def form_of(browser: Any, number: int) -> dict[str, str]:
    """The hidden fields of the form that saves events, and the events that the page shows."""
    return web.form_of(browser, f"/recordings/{number}", f"/recordings/{number}/events")


def send(browser: Any, number: int, form: dict[str, str], /, **more: str):
    return browser.post(f"/recordings/{number}/events", data={**form, **more}, follow_redirects=False)


def pooled() -> dict[str, Any]:
    """The measures of the visit, without when and how long they were computed."""
    return {k: v for k, v in gdi.SessionGdi.fetch1().items() if not k.endswith(("_computed", "_seconds"))}


def test_corrected_events_count_instead_of_the_detected_ones(visit: str, limits: Limits):
    detected = {k: v for k, v in everything_but_refreshes().items() if "gait_events" in k or "__session_fit" in k}
    before, stance = pooled(), dict(zip(*(gait.Spatiotemporal.to_arrays("video_id", "stance")), strict=True))
    browser = web.client(name="A. First")
    form = form_of(browser, 1)
    events = _events(form["events"])
    assert events == [(round(t, 4), s, k) for t, s, k in moved(by=0.0)]
    time, side, kind = events[6]
    text = form["events"].replace(f"{time:.4f}", f"{time + 0.1:.4f}", 1)
    assert send(browser, 1, form, events=text).status_code == 303
    # The rows say what was set by hand, of which detection, who and when.
    row = gait.EventCorrection.fetch1()
    assert (row["video_id"], row["gait_method"], row["correction_no"]) == (1, visit, 1)
    assert (row["correction_changed"], row["correction_by"], row["correction_withdrawn"]) == (1, "A. First", 0)
    assert (row["correction_person"], row["correction_tracking"]) == (1, "blazepose-tiles-v5")
    by_hand = gait.EventCorrection.Event & "corrected_probability is null"
    set_by_hand = by_hand.fetch1("corrected_time", "corrected_side", "corrected_kind")
    assert set_by_hand == (pytest.approx(time + 0.1, abs=1e-4), side, kind)
    (decided,) = Decision().to_dicts()
    assert (decided["video_id"], decided["decision_what"], decided["decision_by"]) == (1, "events", "A. First")
    assert decided["decision_about"] == {"method": visit}
    assert (decided["decision_before"]["by"], decided["decision_after"]["by"]) == ("automatic", "hand")
    assert decided["decision_after"]["changed"] == 1
    assert [time, side, kind] in decided["decision_before"]["events"]
    # The detected events are not touched; what was computed from them is gone, and the page shows the new ones at once.
    assert {k: v for k, v in everything_but_refreshes().items() if k in detected} == detected
    assert gait.GaitCycle.fetch1("video_id") == 2
    assert len(gdi.SessionGdi()) == 0
    page = browser.get("/recordings/1").text
    assert "1 events corrected by A. First" in page
    assert page.count("by hand</td>") == 1
    shown = not_none(shown_recording(1).recording.events)
    assert next(e for e in shown.events if e.probability == 1.0).time_s == pytest.approx(time + 0.1, abs=1e-4)
    # What follows is computed again: of the corrected trial and of the visit alone.
    run = {t.table: t.done for t in populate().tables if t.done}
    assert run == dict.fromkeys(("GaitCycle", "Spatiotemporal", "GDI", "SessionGdi", "SessionQc", "Kinetics"), 1)
    assert dict(zip(*gait.GaitCycle.to_arrays("video_id", "correction_no"), strict=True)) == {1: 1, 2: None}
    after = dict(zip(*(gait.Spatiotemporal.to_arrays("video_id", "stance")), strict=True))
    assert (after[1] != stance[1], after[2]) == (True, stance[2])
    assert (before["session_corrected"], gdi.SessionGdi.fetch1("session_corrected")) == (0, 1)
    assert gdi.SessionGdi.fetch1("session_stance") != before["session_stance"]
    # The checks of the visit are those of the events that count.
    checks = {r["qc_video_id"]: r["qc_value"] for r in (qc.SessionQc.Check & {"qc_check": "events_by_hand"}).to_dicts()}
    assert checks == {1: 1.0}
    assert not qc.SessionQc.Check & {"qc_stage": "gait", "qc_video_id": 1} & "qc_check != 'events_by_hand'"
    # Everything that reads the visit reads the corrected events.
    (result,) = shown_visit(1).results
    assert (result.methods[1], result.corrected) == (visit, True)
    assert "A person corrected events of this visit" in browser.get("/visits/1").text
    found = load_visit({"session_id": 1})
    one, two = (t.events for t in not_none(found.measures).trials)
    assert (one.corrected, two.corrected) == (True, False)
    assert (one.method, one.params_hash) == (two.method, two.params_hash)
    counting = not_none(event_corrections.shown_events(1))
    assert [e.time_s for e in one.events] == [e[0] for e in (counting.hand or ())]
    assert [v["gait_method"] for v in list_fitted({})] == [visit]
    limits(export, FORMATS=("csv",))  # the stand-in of the fit has no markers for a .trc
    archive = zipfile.ZipFile(io.BytesIO(browser.get("/visits/1/export?result=0").content))
    (name,) = [n for n in archive.namelist() if n.endswith("export.json")]
    trials = json.loads(archive.read(name))["trials"].values()
    assert [t["event_method"] for t in trials] == [f"{visit}, corrected by hand", visit]
    assert not populate().did_something


def test_the_history_says_which_event_was_moved_and_by_how_much(visit: str):
    time, side, kind = moved(by=0.0)[6]
    save(1, moved(by=0.1))
    (decided,) = review_decisions.decisions(1)
    assert decided.moves == [(side, kind, pytest.approx(time, abs=1e-4), pytest.approx(time + 0.1, abs=1e-4))]
    event = f"{side.capitalize()}, {'initial contact' if kind == 'foot_down' else 'toe-off'}"
    assert f"{event} {time:.2f} s, moved by +0.10 s" in web.client().get("/visits/1").text
    events = moved(by=0.0)
    saved = dataclasses.replace(decided, before={"events": events}, after={"events": events[1:]})
    assert saved.moves == [(*events[0][1:], events[0][0], None)]


def test_moving_an_event_back_leaves_nothing_set_by_hand(visit: str):
    before = pooled()
    detected = moved(by=0.0)
    save(1, moved(by=0.1))
    save(1, detected)
    counting = not_none(event_corrections.shown_events(1))
    assert counting.hand is None
    assert not counting.stale
    assert "events corrected by" not in web.client().get("/recordings/1").text
    populate()
    assert pooled() == before
    assert not qc.SessionQc.Check & {"qc_check": "events_by_hand"}


def test_corrections_again_and_back_to_the_detected_ones(visit: str):
    before, events = pooled(), moved()
    save(1, events)
    save(2, moved(2))
    populate()
    stance = gdi.SessionGdi.fetch1("session_stance")
    deleted = save(1, moved(by=0.05), "B. Second")  # from those of A. First
    assert deleted["`pbl_gait`.`__gait_cycle`"] == deleted["`pbl_qc`.`__session_qc`"] == 1
    assert len(gdi.SessionGdi()) == len(qc.SessionQc()) == 0
    assert len(gait.GaitCycle()) == 1  # the other trial's stay
    # The history: who set which events, one correction after the other.
    of_first = (gait.EventCorrection & {"video_id": 1}).to_dicts(order_by="correction_no")
    assert [(r["correction_no"], r["correction_by"]) for r in of_first] == [(1, "A. First"), (2, "B. Second")]
    decided = (Decision & {"video_id": 1}).to_dicts(order_by="decision_id")
    for correction, decision in zip(of_first, decided, strict=True):
        kept = (gait.EventCorrection.Event & correction).to_arrays("corrected_time", order_by="corrected_no")
        assert kept.tolist() == pytest.approx([e[0] for e in decision["decision_after"]["events"]], abs=1e-4)
    assert decided[0]["decision_after"]["events"] != decided[1]["decision_after"]["events"]
    populate()
    assert gdi.SessionGdi.fetch1("session_stance") != stance
    assert gdi.SessionGdi.fetch1("session_corrected") == 2
    with pytest.raises(PblError, match="are there already"):
        save(1, moved(by=0.0))
    browser = web.client()
    assert send(browser, 1, form_of(browser, 1), back="automatic").status_code == 303
    populate()
    assert dict(zip(*gait.GaitCycle.to_arrays("video_id", "correction_no"), strict=True)) == {1: None, 2: 1}
    assert send(browser, 2, form_of(browser, 2), back="automatic").status_code == 303
    populate()
    assert pooled() == before
    assert not populate().did_something
    history = (gait.EventCorrection & {"video_id": 1}).to_arrays("correction_withdrawn", order_by="correction_no")
    assert history.tolist() == [0, 0, 1]
    told = [(d.before["by"], d.after["by"]) for d in review_decisions.decisions(1)]
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
    assert everything_but_refreshes() == before


def test_two_people_correct_at_the_same_moment(visit: str):
    found = not_none(event_corrections.shown_events(1))
    calls = [(1, moved(by=d), name, found.state) for d, name in ((0.1, "A. First"), (0.05, "B. Second"))]
    late, done = decide_target.at_once("pbl_schemas.decisions.event_corrections.save", *calls)
    assert (done, late[0]) == (("done", ""), "DECIDED_MEANWHILE")
    assert f"{gait.EventCorrection.fetch1('correction_by')} decided for by hand, changed 1" in late[1]
    assert len(Decision()) == 1
    with pytest.raises(PblError, match="decided for by hand"):
        event_corrections.save(1, moved(by=-0.05), "C", "old")


@pytest.mark.parametrize("computing", ["find_cycles", "pool_trials"])
def test_a_correction_while_its_visit_is_computed(visit: str, computing: str, faults: Faults):
    """What was computed from earlier corrections is not written: it is computed again from the later ones."""
    save(1, moved())
    corrected_again: list[bool] = []

    def corrects(*_: Any, **__: Any) -> None:
        if not corrected_again:
            corrected_again.append(True)
            save(1, moved(by=0.1), "B. Second")

    faults(pbl_pipeline.gait, computing, then=corrects)
    run = populate()
    assert corrected_again
    # Cycles are tried again; the visit's job has no rows to pool then, until they are there.
    tried_again = {"GaitCycle": {"INPUT_CHANGED": 1}} if computing == "find_cycles" else {}
    assert {t.table: t.errors for t in run.tables if t.errors} == tried_again
    populate()
    row = pooled()
    hand = (gait.EventCorrection.Event & {"correction_no": 2}).to_arrays("corrected_time", order_by="corrected_no")
    assert gait.GaitCycle.to_arrays("correction_no", order_by="video_id").tolist() == [2, None]
    assert set((gait.GaitCycle.Cycle & {"video_id": 1}).to_arrays("cycle_start")) < set(hand)
    delete_below(gait.GaitCycle, gait.GaitCycle.keys())
    populate()
    assert pooled() == row


def test_a_decision_waits_for_the_insert_that_reads_what_it_changes(visit: str):
    """Rows of corrected events that are being read inside a transaction are not changed before its end."""
    from contextlib import closing

    from pbl_schemas import connection

    save(1, moved())
    key = not_none(fit.trial_key(1))
    waited = threading.Event()

    def other() -> None:
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute("SELECT session_id FROM pbl_session.session FOR UPDATE")
            waited.set()

    thread = threading.Thread(target=other)
    with gait.EventCorrection().connection.transaction:
        assert gait.correction_of({**key, "gait_method": visit})
        thread.start()
        assert not waited.wait(0.5)
    assert waited.wait(10)
    thread.join()


def test_corrections_are_of_the_person_that_was_measured(visit: str):
    save(1, moved())
    populate()
    review_decisions.decide_person(1, 2)
    populate()
    found = not_none(event_corrections.shown_events(1))
    assert (found.hand, found.stale) == (None, True)
    assert (gait.GaitCycle & {"video_id": 1} & fit.current()).fetch1("correction_no") is None
    page = web.client().get("/recordings/1").text
    assert "corrected for another person" in page
    review_decisions.decide_person(1, 1)
    populate()
    assert (gait.GaitCycle & {"video_id": 1} & fit.current()).fetch1("correction_no") == 1
    assert shown_recording(1).recording.cycles  # those of the corrected events
    # The last correction of each person counts: of the other one there was none to take back.
    review_decisions.decide_person(1, 2)
    populate()
    found = not_none(event_corrections.shown_events(1))
    event_corrections.take_back(1, "A. First", found.state)
    found = not_none(event_corrections.shown_events(1))
    assert (found.hand, found.stale) == (None, False)


def test_trend_slices_move_and_forget(visit: str, tmp_path: Path):
    register(small_video(tmp_path, "c", n=260), session_label="2026-04-10")
    populate()
    study.Visit.insert({"session_id": i, "visit_role": r} for i, r in ((1, "pre"), (2, "3_months")))
    slices.freeze("before")
    save(3, moved(3))
    populate()
    # Corrected against detected: a change, of which no error is known.
    (row,) = [v for v in visit_page(Filter()).visits if v.session_id == 2]
    assert (row.result.corrected, row.more) == (True, 0) if row.result else False
    assert row.trend is not None
    assert (row.trend.session_id, row.trend.sure) == (1, None)
    assert [d.what for d in row.trend.differs] == ["corrected"]
    # A slice says which of its visits have other measures since.
    assert slices.changes("before") == ["visit 2026-04-10 of P001 has other rows"]
    slices.freeze("after")
    assert not slices.changes("after")
    assert len(set(study.StudySlice().to_arrays("slice_hash"))) == 2
    # The corrections go with their recording, and with their person.
    move.carry_out(move.plan_move(3, "P001", "2026-01-10"))
    populate()
    assert (gait.GaitCycle & {"video_id": 3} & fit.current()).fetch1("correction_no") == 1
    assert not forget("P001").left
    assert len(gait.EventCorrection()) == len(gait.EventCorrection.Event()) == 0


@pytest.mark.parametrize("language", ["en", "de"])
def test_body_marks_and_curves_are_in_one_view_where_there_is_no_picture(chromium: Any, visit: str, language: str):
    """Of a laboratory's markers the 3D view is in the place of the video."""

    def of_markers(route: Any) -> None:
        movement = route.fetch().json()
        movement["body"]["camera"] = None
        route.fulfill(json=movement)

    with web.shown(chromium, locale=language) as page:
        page.route("**/movement", of_markers)
        for width, height in ((1280, 900), (1024, 768), (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            page.goto("/recordings/1")
            page.wait_for_selector("[data-ready]")
            page.locator("#correct").click()
            comes_into_view(page, ".space-view", ".line", "#curves figure >> nth=0")


def test_a_frame_that_the_browser_does_not_tell_is_shown(chromium: Any, visit: str):
    """Of two seeks within milliseconds Chromium tells the first at times."""
    with web.shown(chromium, name="A. First") as page:
        page.goto("/recordings/1")
        page.wait_for_selector("[data-ready]")
        page.evaluate("HTMLVideoElement.prototype.requestVideoFrameCallback = () => 0")
        for frame in (1, 2, 3):
            page.get_by_role("button", name="One frame forward").click()
            page.wait_for_selector(f"canvas.body[data-frame='{frame}']", timeout=10_000)


def test_from_dragging_a_mark_to_the_row(chromium: Any, visit: str, axe: str):
    before = not_none(event_corrections.shown_events(1))
    with web.shown(chromium, name="A. First", size=(1200, 900), bypass_csp=True, refused=True) as page:
        # On a slow connection the editor comes after the player is ready.
        page.route("**/correct.js", lambda route: (time.sleep(1.0), route.continue_()))
        page.goto("/recordings/1")
        page.wait_for_selector("[data-ready]")
        page.get_by_text("Correct the events").click()
        page.wait_for_selector(".track .mark")
        marks = page.locator(".track .mark")
        assert marks.count() == len(before.detected)
        # By the mouse: 0.2 s later, on a frame; the video shows it.
        marks.nth(6).scroll_into_view_if_needed()
        box = marks.nth(6).bounding_box()
        page.mouse.move(box["x"] + 13, box["y"] + 10)
        page.mouse.down()
        page.mouse.move(box["x"] + 13 + 18, box["y"] + 10, steps=4)
        page.mouse.up()
        frame = round((before.detected[6][0] + 0.2) * 30)
        page.wait_for_selector(f"canvas.body[data-frame='{frame}']")
        # By the keyboard: two frames back; another is deleted, and one is added at the frame that is shown.
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("ArrowLeft")
        page.wait_for_selector(f"canvas.body[data-frame='{frame - 2}']")
        assert f"at {(frame - 2) / 30:.2f} s" in page.locator(".correct .said").inner_text()
        marks.nth(marks.count() - 1).focus()
        page.keyboard.press("Delete")
        assert marks.count() == len(before.detected) - 1
        # Each of three marks that are at most a frame apart can be hit.
        for shown in ("5", "6"):
            page.locator("#position").fill(shown)
            page.wait_for_selector(f"canvas.body[data-frame='{shown}']")
            page.get_by_role("button", name="+ Left: initial contact").click()
        page.get_by_role("button", name="+ Left: toe-off").click()
        page.evaluate(axe)
        found = page.evaluate("axe.run('.track', { runOnly: ['target-size'] })")
        assert sum(len(rule["nodes"]) for rule in found["passes"]) == marks.count() == len(before.detected) + 2
        assert not found["violations"]
        for what in (
            f"toe-off at {6 / 30:.2f}",
            f"initial contact at {6 / 30:.2f}",
            f"initial contact at {5 / 30:.2f}",
        ):
            page.get_by_label(f"Left {what} s").click()
            page.keyboard.press("Delete")
        # What the server refuses is said, and the marks stay.
        page.locator("#position").fill("5")
        page.wait_for_selector("canvas.body[data-frame='5']")
        page.get_by_role("button", name="+ Left: initial contact").click()
        page.get_by_role("button", name="+ Left: initial contact").click()
        page.get_by_role("button", name="Save the events").click()
        problem = page.locator(".correct .problem")
        problem.wait_for()
        assert "EVENTS_IMPLAUSIBLE" in problem.inner_text()
        assert marks.count() == len(before.detected) + 1
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        for _ in range(2):
            page.get_by_label(f"Left initial contact at {5 / 30:.2f} s").first.focus()
            page.keyboard.press("Delete")
        with page.expect_navigation():
            page.get_by_role("button", name="Save the events").click()
        page.wait_for_selector("[data-ready]")
    found = not_none(event_corrections.shown_events(1))
    assert found.hand is not None
    set_by_hand = [e for e in found.hand if e[3] is None]
    assert [(round(t * 30), s, k) for t, s, k, _ in set_by_hand] == [(frame - 2, *before.detected[6][1:3])]
    assert (len(found.hand), found.n_changed, found.by) == (len(before.detected) - 1, 2, "A. First")
    assert Decision.fetch1("decision_by") == "A. First"


def comes_into_view(page: Any, *names: str) -> None:
    """Wait until all these are in view at once."""
    for _ in range(100):
        boxes = [page.locator(name).bounding_box() for name in names]
        height = page.viewport_size["height"]
        if all(box and 0 <= box["y"] < box["y"] + box["height"] <= height for box in boxes):
            return
        page.wait_for_timeout(50)
    raise AssertionError(names)


@pytest.mark.parametrize("language", ["en", "de"])
def test_picture_marks_and_curves_are_in_one_view_while_events_are_corrected(
    chromium: Any, visit: str, axe: str, language: str
):
    def upright(route: Any) -> None:
        movement = route.fetch().json()
        route.fulfill(json=movement | {"size": movement["size"][::-1]})

    with web.shown(chromium, locale=language, bypass_csp=True) as page:
        for width, height, turned in ((1280, 900, 0), (1024, 768, 1), (390, 844, 0), (390, 844, 1)):
            page.set_viewport_size({"width": width, "height": height})
            page.unroute("**/movement")
            if turned:  # filmed in portrait
                page.route("**/movement", upright)
            page.goto("/recordings/1")
            page.wait_for_selector("[data-ready]")
            page.locator("#correct").click()
            comes_into_view(page, ".stage", ".line", "#curves figure >> nth=0")
            marks, values = page.locator(".track .mark"), page.locator("#curves output")
            first = values.first.inner_text()
            marks.nth(6).click()  # which may scroll the page before it clicks
            page.wait_for_function("(last) => document.querySelector('#curves output').innerText !== last", arg=first)
            # Each curve has its values at the mark, and at the pointer while it is over one.
            found = values.all_inner_texts()
            words = ("Left", "Right") if language == "en" else ("Links", "Rechts")
            assert len(found) == page.locator("#curves figure").count() > 4
            assert all(w in text and "°" in text for text in found for w in words)
            marks.nth(7).press("ArrowRight")
            page.wait_for_function(
                "(last) => document.querySelector('#curves output').innerText !== last", arg=found[0]
            )
            found = values.all_inner_texts()
            page.locator("#curves .u-over").first.hover(position={"x": 150, "y": 40})
            page.wait_for_function(
                "(last) => document.querySelector('#curves output').innerText !== last", arg=found[0]
            )
            assert sum(a != b for a, b in zip(found, values.all_inner_texts(), strict=True)) >= 3
            page.evaluate(axe)
            assert not page.evaluate("axe.run('.look')")["violations"]
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
