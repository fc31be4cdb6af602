"""Recordings that are marked as not usable: what is computed without them, what stays, and taking it back."""

from pathlib import Path
from typing import Any

import pymysql
import pytest

from pbl_pipeline.errors import PblError
from pbl_schemas import fit, gdi, intake, load_visit, qc, study, tracking, video
from pbl_schemas.connection import dj
from pbl_schemas.decisions import not_usable, review_decisions
from pbl_schemas.intake import LaboratoryMarkers, SeveralCameras, VisitRecord
from pbl_schemas.jobs import jobs_of
from pbl_schemas.plan import plan_fit_sets
from pbl_schemas.reading import registered, visit_list
from pbl_schemas.reading.shown import shown_visit
from pbl_schemas.reading.visit_list import Filter, visit_page
from pbl_schemas.reading.why import why
from pbl_schemas.review import Decision
from pbl_schemas.studies import slices
from pbl_schemas.transactions import after_commit, in_transaction
from pbl_workers import refresh
from pbl_workers.populate import populate
from tests import Faults, Limits, StandIn
from tests.command import pbl
from tests.integration import decide_target, test_markers, test_rigs, web
from tests.integration.chain import computed_once, small_video
from tests.rows import everything_but_refreshes, register


@computed_once
def visit(folder: Path) -> tuple[int, int]:
    """A computed visit of two recordings, numbers 1 and 2."""
    one, two = register(small_video(folder, "a"), small_video(folder, "b"), session_label="2026-01-10")
    populate()
    assert len(gdi.SessionGdi()) == 1
    return one, two


def form_of(browser: Any, number: int) -> dict[str, str]:
    """The hidden fields of the form that marks a recording."""
    return web.form_of(browser, f"/recordings/{number}", f"/recordings/{number}/usable")


def send(browser: Any, number: int, form: dict[str, str] | None = None, /, **more: str):
    form = form_of(browser, number) if form is None else form
    return browser.post(f"/recordings/{number}/usable", data={**form, **more}, follow_redirects=False)


def state() -> str:
    (row,) = visit_page(Filter()).visits
    by_filter = [s for s in visit_list.STATES if visit_page(Filter(state=s)).visits]
    assert row.state in by_filter  # a failed one may also wait
    return row.state


def current() -> list[list[int]]:
    """Recordings of the current sets."""
    rows = (fit.FitSet.Video.proj() * fit.current()).to_dicts(order_by="fit_set, video_id")
    return [[r["video_id"] for r in rows if r["fit_set"] == s] for s in dict.fromkeys(r["fit_set"] for r in rows)]


@pytest.mark.parametrize("by_hand", [True, False])
def test_where_only_the_queue_fails_the_page_says_what_is_written(
    visit: tuple[int, int], faults: Faults, limits: Limits, by_hand: bool
):
    """The decision is committed; the next look at all tables or at recent decisions queues what it asks for."""
    browser = web.client(name="A. First")
    full = pymysql.err.OperationalError(1114, "The table '~~session_fit' is full")
    with faults(refresh, "refresh_scope", full):
        answer = send(browser, 2, usable="no", reason="interrupted", note="stumbled")
    assert answer.status_code == 503
    assert "NOT_QUEUED" in answer.text
    assert "it is stored, but what follows from it is not queued yet (" in answer.text
    assert "Do not send it again" in answer.text
    assert "nothing was" not in answer.text.lower()
    assert (len(video.NotUsable()), len(Decision())) == (1, 1)
    assert "not usable" in browser.get("/visits/1").text
    assert len(jobs_of(fit.SessionFit)) == 0
    if by_hand:
        assert pbl("cron", "refresh").code == 0
    else:  # as a worker of a large installation looks each minute
        limits(refresh, FEW=1)
        assert refresh.refresh(False) is not None
    assert len(jobs_of(fit.SessionFit).pending) == 1
    populate()
    assert current() == [[1]]


def test_a_marked_recording_leaves_its_visit_and_comes_back(visit: tuple[int, int]):
    browser = web.client(name="A. First")
    before = {k: v for k, v in everything_but_refreshes().items() if ".__" in k}
    assert (state(), current()) == ("computed", [[1, 2]])
    answer = send(browser, 2, usable="no", reason="interrupted", note="  <b>stumbled\n at the turn")
    assert answer.status_code == 303, answer.text
    row = video.NotUsable.fetch1()
    assert (row["video_id"], row["unusable_reason"], row["unusable_by"]) == (2, "interrupted", "A. First")
    (decided,) = Decision().to_dicts()
    assert (decided["video_id"], decided["decision_what"], decided["decision_by"]) == (2, "usable", "A. First")
    assert decided["decision_before"] == {"usable": "yes"}
    assert decided["decision_after"] == {"usable": "no", "why": "interrupted"}
    assert decided["decision_reason"] == "<b>stumbled at the turn"
    # The visit is planned without it; exactly the fit and what follows is pending, nothing was deleted.
    assert (state(), current()) == ("pending", [[1]])
    assert {k: v for k, v in everything_but_refreshes().items() if ".__" in k} == before
    run = {t.table: t.done for t in populate().tables if t.done}
    assert run["SessionFit"] == run["SessionGdi"] == run["SessionQc"] == 1
    assert not {"Tracking", "SubjectChoice", "Keypoints", "TrialInput"} & set(run)
    assert state() == "computed"
    assert shown_visit(1).results[0].status == "PASS"
    for page in (browser.get("/visits/1").text, browser.get("/recordings/2").text):
        assert "the walk was interrupted" in page
        assert "&lt;b&gt;stumbled at the turn" in page
    german = browser.get("/recordings/2", headers={"accept-language": "de"}).text
    assert "der Gang wurde unterbrochen" in german
    assert "interrupted" in why(2).verdict
    assert [r.problem for r in load_visit({"session_id": 1}).recordings][1].startswith("not usable: the walk was")
    # Back: what was computed is there at once.
    assert send(browser, 2, usable="yes").status_code == 303
    assert (state(), current()) == ("computed", [[1, 2]])
    assert not populate().did_something
    assert "No decisions about this visit" not in browser.get("/visits/1").text
    assert [d.after for d in review_decisions.decisions(1)] == [
        {"usable": "yes"},
        {"usable": "no", "why": "interrupted"},
    ]


def test_a_decision_queues_what_it_made_computable(visit: tuple[int, int]):
    review_decisions.mark_not_usable(2, "too_dark")
    (planned,) = fit.current().keys()
    assert jobs_of(fit.SessionFit).pending.proj().to_dicts() == [dict(planned)]


def test_what_waits_for_a_commit_is_forgotten_with_the_transaction(tables: None):
    called: list[str] = []

    def broken() -> None:
        after_commit(lambda: called.append("never"))
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_transaction(broken)
    in_transaction(lambda: after_commit(lambda: called.append(str(dj.conn().in_transaction))))
    assert called == ["False"]
    after_commit(lambda: called.append("immediately"))
    assert called[1:] == ["immediately"]


def test_what_waits_for_a_commit_may_be_a_transaction_itself(tables: None):
    called: list[int] = []

    def decide() -> None:
        for number in (1, 2, 3):
            after_commit(lambda number=number: in_transaction(lambda: called.append(number)))

    in_transaction(decide)
    assert called == [1, 2, 3]


def test_a_visit_without_a_usable_recording_has_no_set(visit: tuple[int, int]):
    for number in visit:
        review_decisions.mark_not_usable(number, "too_dark")
    assert (state(), current()) == ("unusable", [])
    assert not populate().did_something
    assert state() == "unusable"
    page = web.client().get("/visits/1").text
    assert "no usable recording" in page
    assert shown_visit(1).results == ()
    review_decisions.take_back(1)
    assert (state(), current()) == ("pending", [[1]])
    review_decisions.take_back(1)  # is used already
    assert len(Decision()) == 3


def test_a_mark_waits_for_nobody_and_nobody_for_it(tables: None, tmp_path: Path):
    """What is undecided, failed or waits for a choice does not hold a visit up once it is marked."""
    one = register(small_video(tmp_path, "a"), session_label="2026-01-10")[0]
    waits = register(small_video(tmp_path, "b", people="two alike"), session_label="2026-01-10")[0]
    lost = small_video(tmp_path, "c")
    gone = register(lost, session_label="2026-01-10")[0]
    lost.unlink()
    populate()
    assert (state(), visit_page(Filter()).visits[0].problem) == ("waiting", "VIDEO_MISSING")
    review_decisions.mark_not_usable(gone, "other", "the file is lost")
    assert state() == "waiting"
    review_decisions.mark_not_usable(waits, "other_person")
    assert (state(), current()) == ("computed", [[one]])
    said = pbl("status")
    assert "not usable" in said.out
    assert "the file is lost" in said.out
    assert "waiting for a choice" not in said.out
    populate()  # the failed job is not asked for any more
    assert "VIDEO_MISSING" not in pbl("status").out
    # A new recording that is not computed yet, and the only computed one is marked: no set until it is decided.
    later = register(small_video(tmp_path, "d"), session_label="2026-01-10")[0]
    review_decisions.mark_not_usable(one, "duplicate")
    assert (state(), current()) == ("pending", [])
    populate()
    assert (state(), current()) == ("computed", [[later]])


def test_nothing_is_computed_of_a_recording_that_was_marked_first(tables: None, tmp_path: Path):
    number = register(small_video(tmp_path, "a"), session_label="2026-01-10")[0]
    review_decisions.mark_not_usable(number, "not_in_view")
    populate()
    assert len(tracking.Tracking()) == 0
    assert state() == "unusable"
    review_decisions.take_back(number)
    populate()
    assert (state(), current()) == ("computed", [[number]])


def test_a_mark_by_another_route_is_planned_too(visit: tuple[int, int]):
    row = {"video_id": 1, "unusable_reason": "helped", "unusable_by": "SQL", "unusable_created": "2026-01-01"}
    video.NotUsable.insert1(row)
    plan_fit_sets([1])
    assert current() == [[2]]


def test_two_people_decide_at_the_same_moment(visit: tuple[int, int]):
    seen = review_decisions.usable_state(1)
    calls = [(1, reason, "", name, seen) for reason, name in (("helped", "A. First"), ("too_dark", "B. Second"))]
    late, done = decide_target.at_once("pbl_schemas.decisions.review_decisions.mark_not_usable", *calls)
    assert done == ("done", "")
    assert late[0] == "DECIDED_MEANWHILE"
    mark = not_usable.unusable([1])[1]
    assert f"{mark.by} decided for usable no, why {mark.reason}" in late[1]
    assert len(Decision()) == 1
    assert current() == [[2]]


def test_who_is_late_sees_it_in_the_page(visit: tuple[int, int]):
    first, second = web.client(name="A. First"), web.client(name="B. Second")
    form = form_of(second, 1)
    assert send(first, 1, usable="no", reason="helped").status_code == 303
    late = send(second, 1, form, usable="no", reason="too_dark")
    assert late.status_code == 409
    assert "A. First decided for" in late.text
    assert not_usable.unusable([1])[1].reason == "helped"
    assert send(first, 1, usable="yes").status_code == 303
    assert send(second, 1, form, usable="no", reason="too_dark").status_code == 409  # it was marked in between


def test_a_forged_form_changes_nothing(visit: tuple[int, int]):
    browser, reader, before = web.client(), web.client(role="reader"), everything_but_refreshes()
    for fields in (
        {"usable": "no", "reason": ""},
        {"usable": "no", "reason": "other", "note": "  "},
        {"usable": "no", "reason": "' or 1=1"},
        {"usable": "perhaps", "reason": "helped"},
        {"usable": "no", "reason": "helped", "seen": ""},
        {"usable": "no", "reason": "helped", "token": ""},
    ):
        assert send(browser, 1, **fields).status_code in (400, 403, 409, 415), fields
    assert send(browser, 999, form_of(browser, 1), usable="no", reason="helped").status_code == 404
    assert "/usable" not in reader.get("/recordings/1").text
    assert everything_but_refreshes() == before


def test_the_command(visit: tuple[int, int]):
    said = pbl("choose", 1, "--not-usable", "camera_moved", "--note", "fell over")
    assert (said.code, "left out" in said.out) == (0, True)
    assert not_usable.unusable([1, 2])[1].text == "the camera was moved, or stood badly (fell over)"
    assert "not usable: the camera was moved" in pbl("why", 1).out
    assert list(registered.videos()["not_usable"]) == ["the camera was moved, or stood badly (fell over)", ""]
    assert pbl("choose", 1, "--usable").code == 0
    assert len(video.NotUsable()) == 0
    assert len(Decision()) == 2
    assert pbl("choose", 1, "--not-usable", "other").error_code == "USAGE"
    assert pbl("choose", 1, "--not-usable", "other", "--note", "x" * 501).error_code == "USAGE"  # not cut
    assert len(Decision()) == 2
    assert pbl("choose", 99, "--not-usable", "helped").error_code == "DB_NOT_FOUND"
    assert pbl("choose", 1, 2, "--usable").code == pbl("choose", 1, "--note", "x").code == 2
    with pytest.raises(PblError, match="no video_id 99"):
        review_decisions.take_back(99)


def test_all_cameras_of_a_trial_are_marked_together(tables: None, tmp_path: Path, stand_in: StandIn):
    stand_in(detect_keypoints=test_rigs.detect_keypoints, fit_session=test_rigs.fit_none)
    toml = test_rigs.calibration(tmp_path / "Calib.toml")
    for trial in ("w1.", "w2."):
        made = intake.register(
            [SeveralCameras(test_rigs.rig_videos(tmp_path, trial), toml, VisitRecord("P001", "2026-01-10"))]
        )
        assert [r.status for r in made] == ["registered"] * 3
    populate()
    assert current() == [[1, 2, 3, 4, 5, 6]]
    assert "one of 3 cameras" in web.client().get("/recordings/5").text
    review_decisions.mark_not_usable(5, "camera_moved", by="A")
    assert sorted(video.NotUsable().to_arrays("video_id")) == [4, 5, 6]
    assert current() == [[1, 2, 3]]
    populate()
    assert state() == "computed"
    review_decisions.take_back(6, by="B")
    assert (state(), current()) == ("computed", [[1, 2, 3, 4, 5, 6]])


def test_marker_recordings_are_marked_too(tables: None, tmp_path: Path, stand_in: StandIn):
    stand_in(fit_session=lambda *given, **_: test_rigs.fit_none(*given))
    number = register(small_video(tmp_path, "walk"), session_label="2026-01-10")[0]
    paths = [test_markers.recording(tmp_path / f"{name}.npz", s) for name, s in (("m1", 7.0), ("m2", 8.0))]
    made = intake.register([LaboratoryMarkers(p, VisitRecord("P001", "2026-01-10")) for p in paths])
    assert [r.status for r in made] == ["registered"] * 2, made
    populate()
    assert sorted(current()) == [[number], [2, 3]]
    review_decisions.mark_not_usable(3, "duplicate")
    assert sorted(current()) == [[number], [2]]
    review_decisions.mark_not_usable(2, "helped")
    assert current() == [[number]]
    assert state() == "computed"
    assert "Is it usable?" in web.client().get("/recordings/2").text


def test_a_frozen_slice_does_not_change(visit: tuple[int, int]):
    study.Visit.insert1({"session_id": 1, "visit_role": "pre"})
    frozen = slices.freeze("before")
    review_decisions.mark_not_usable(2, "helped")
    assert not slices.changes("before")
    populate()
    assert not slices.changes("before")
    kept = study.StudySliceVisit.fetch1("slice_fit_set")
    assert kept not in fit.current().to_arrays("fit_set")
    after = slices.freeze("after")
    assert after.hash != frozen.hash
    assert len(qc.SessionQc()) == 2


def test_from_the_click_to_the_row(visit: tuple[int, int], chromium: Any):
    with web.shown(chromium, name="A. First") as page:
        page.goto("/recordings/1")
        page.wait_for_selector("[data-ready]")  # the tables are asked by one thread at a time
        button = page.get_by_role("button", name="Mark as not usable")
        button.click()  # without a reason the browser asks for one
        assert len(Decision()) == 0
        page.get_by_label("Reason").select_option("camera_moved")
        page.get_by_label("Why (no names)").last.fill("fell over")
        button.click()
        page.get_by_role("button", name="Use it again").wait_for()
        assert not_usable.unusable([1])[1].text == "the camera was moved, or stood badly (fell over)"
        assert Decision.fetch1("decision_by") == "A. First"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.get_by_role("button", name="Use it again").click()
        page.wait_for_selector("[data-ready]")
        assert len(video.NotUsable()) == 0
