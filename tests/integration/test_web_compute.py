"""Computing a visit from its page: what is pending, the process, what it shows, and whom it leaves alone."""

import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import fit, gdi, qc, tracking
from pbl_schemas.decisions import review_decisions
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading.visit_progress import visit_progress
from pbl_workers import queue, refresh, run_job
from pbl_workers.populate import populate
from pbl_workers.web.computing import told
from tests import Environment, Faults, until
from tests.integration import compute_target, web
from tests.integration.chain import computed_once, small_video
from tests.rows import everything_but_refreshes, register


@pytest.fixture
def hold(environment: Environment, tmp_path: Path) -> Path:
    """A folder that holds up what computes visits."""
    folder = tmp_path / "hold"
    folder.mkdir()
    environment(PBL_TEST_HOLD=folder)
    return folder


@pytest.fixture
def browser(hold: Path) -> Iterator[Any]:
    found: Any = web.client(name="A. First", target=compute_target.compute)
    yield found
    found.app.state.site.computing.close()


@computed_once
def visits(folder: Path) -> None:
    """Visit 1 of recordings 1 and 2, visit 2 of recording 3; all computed."""
    register(small_video(folder, "a"), small_video(folder, "b"), session_label="2026-01-10")
    register(small_video(folder, "c"), session_label="2026-04-10")
    populate()
    assert len(qc.SessionQc()) == 2


def state(browser: Any, session_id: int) -> str:
    return told(types.SimpleNamespace(app=browser.app), visit_progress(session_id)).state  # type: ignore[arg-type]


def ended(browser: Any, session_id: int = 1) -> None:
    until(lambda: not state(browser, session_id))


def mark(browser: Any, number: int) -> None:
    answer = web.post(
        browser,
        f"/recordings/{number}/usable",
        usable="no",
        reason="helped",
        seen=review_decisions.usable_state(number),
    )
    assert answer.status_code == 303, answer.text


def compute(browser: Any, session_id: int, **fields: str) -> None:
    answer = web.post(browser, f"/visits/{session_id}/compute", **{"again": "no", **fields})
    assert (answer.status_code, answer.headers["location"]) == (303, fields.get("back", f"/visits/{session_id}"))


def test_what_a_decision_made_pending_is_computed_of_this_visit_alone(visits: None, browser: Any, tmp_path: Path):
    assert "Compute now" not in browser.get("/visits/1").text
    mark(browser, 2)
    later = register(small_video(tmp_path, "d"), session_label="2026-07-10")
    for path in ("/visits/1", "/recordings/1"):
        page = browser.get(path).text
        assert "Not computed yet" in page
        assert "Compute now" in page
    assert "Compute now" not in browser.get("/visits/2").text
    progress = visit_progress(1)
    assert (progress.queued, progress.running, progress.failed) == (1, (), ())
    compute(browser, 1, back="/recordings/1")
    ended(browser)
    assert not visit_progress(1).pending
    assert len(qc.SessionQc & fit.current()) == 2
    assert "Compute now" not in browser.get("/visits/1").text
    assert len(tracking.Tracking & {"video_id": later[0]}) == 0  # another visit's work is left to workers


@pytest.mark.long
def test_a_visit_waits_for_the_one_before_and_says_so(visits: None, browser: Any, hold: Path):
    (hold / "hold").touch()
    mark(browser, 1)
    compute(browser, 1)
    compute(browser, 2)
    until(lambda: state(browser, 1) == "running")
    page = browser.get("/visits/1").text
    assert "This visit is being computed" in page
    assert "Compute now" not in page
    assert "Load again" in page
    assert "Decisions made meanwhile count" in page
    assert "after another one" in browser.get("/visits/2/progress").text
    assert 'data-busy="yes"' in browser.get("/visits/1/progress").text
    mark(browser, 2)  # decided while it is computed: the last decision counts
    review_decisions.take_back(1)
    (hold / "hold").unlink()
    ended(browser)
    ended(browser, 2)
    assert fit.FitSet.Video.proj() * fit.current()
    rows = (fit.FitSet.Video.proj() * fit.current() * fit.FitSet.proj("session_id") & {"session_id": 1}).to_dicts()
    assert [r["video_id"] for r in rows] == [1]
    assert len(gdi.SessionGdi & fit.current()) == 2
    assert 'data-busy="no"' in browser.get("/visits/1/progress").text


def test_a_job_in_other_hands_is_not_taken_twice(visits: None, browser: Any):
    mark(browser, 2)
    (job,) = queue.claim(fit.SessionFit)  # a worker has it: this process
    compute(browser, 1)
    until(lambda: "fit of the body" in browser.get("/visits/1/progress").text)
    time.sleep(3.0)
    assert state(browser, 1) == "running"  # it waits for what follows
    assert len(fit.SessionFit & job.key) == 0
    assert run_job.run(job).what == run_job.DONE
    ended(browser)
    assert len(qc.SessionQc & job.key) == 1
    assert len(jobs_of(fit.SessionFit)) == 0


def test_a_job_that_ends_just_after_it_was_looked_for_is_followed(visits: None, browser: Any, faults: Faults):
    mark(browser, 2)
    (job,) = queue.claim(fit.SessionFit)

    def look(_: Any) -> None:
        if len(looks) == 2:  # the first is before the worker
            assert run_job.run(job).what == run_job.DONE

    looks = faults(refresh, "refresh_scope", then=look)
    populate(visit=1)
    assert len(qc.SessionQc & job.key) == 1


def test_a_job_that_another_has_queued_and_not_taken_is_done(visits: None, browser: Any, faults: Faults):
    mark(browser, 2)
    job = fit.SessionFit.jobs.pending.fetch1("KEY")
    fit.SessionFit.jobs.update1({**job, "status": "ignore"})

    def look(_: Any) -> None:
        if len(looks) == 2:  # the first is before the worker
            fit.SessionFit.jobs.update1({**job, "status": "pending"})

    looks = faults(refresh, "refresh_scope", then=look)
    populate(visit=1)
    assert len(fit.SessionFit & job) == 1


def test_a_failure_is_shown_with_its_next_step_and_tried_again(visits: None, browser: Any, tmp_path: Path):
    gone = small_video(tmp_path, "gone")
    number = register(gone, session_label="2026-01-10")[0]
    kept = gone.read_bytes()
    gone.unlink()
    compute(browser, 1)
    ended(browser)
    for path in ("/visits/1", f"/recordings/{number}", "/visits/1/progress"):
        page = browser.get(path).text
        assert "VIDEO_MISSING" in page
        assert "Bring the file or its disk back" in page
    assert "Try failed computations again" in browser.get("/visits/1").text
    gone.write_bytes(kept)
    assert populate(visit=1).did_something is False  # what failed is tried again where that is asked for
    assert populate(visit=1, retry_errors=True).retried == 1
    assert "VIDEO_MISSING" not in browser.get("/visits/1").text
    assert len(qc.SessionQc & fit.current()) == 2


def test_a_process_that_dies_is_told_and_leaves_nothing_half(visits: None, browser: Any, hold: Path):
    mark(browser, 2)
    (hold / "kill").touch()
    before = everything_but_refreshes()
    compute(browser, 1)
    ended(browser)
    page = browser.get("/visits/1").text
    assert "WORKER_CRASH" in page
    assert "Try failed computations again" in page
    assert everything_but_refreshes() == before
    assert [t.table for t in populate(visit=1).tables if t.errors] == []
    assert len(qc.SessionQc & fit.current()) == 2


def test_who_may_not_and_what_is_not_there(visits: None, browser: Any):
    mark(browser, 2)
    reader = web.client(role="reader")
    page = reader.get("/visits/1").text
    assert "Not computed yet" in page
    assert "Compute now" not in page
    assert web.post(reader, "/visits/1/compute", again="no").status_code == 403
    assert web.post(browser, "/visits/1/compute", again="maybe").status_code == 415
    assert web.post(browser, "/visits/99/compute", again="no").status_code == 404
    assert browser.get("/visits/99/progress").status_code == 404
    assert state(browser, 1) == ""


def test_from_the_button_to_the_result(visits: None, chromium: Any, hold: Path):
    mark(web.client(), 2)
    (hold / "hold").touch()
    with web.shown(chromium, name="A. First", target=compute_target.compute) as page:
        page.goto("/visits/1")
        page.get_by_role("button", name="Compute now").click()
        page.get_by_text("This visit is being computed").wait_for()
        page.wait_for_load_state("load")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.evaluate("window.loaded = 'once'")
        page.wait_for_timeout(2000)
        assert page.evaluate("window.loaded") == "once"  # it asks without loading the page
        (hold / "hold").unlink()
        page.get_by_text("This visit is being computed").wait_for(state="detached", timeout=300_000)
        page.wait_for_function("window.loaded === undefined")
    assert len(qc.SessionQc & fit.current()) == 2
