"""Deciding in the review page: who is measured, a warning accepted; rows, conflicts and rights."""

import getpass
import json
import re
import sys
from pathlib import Path
from typing import Any

import pymysql
import pytest

from pbl_pipeline.errors import PblError
from pbl_schemas import fit, gait, gdi, qc, tracking
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.decisions import review_decisions
from pbl_schemas.intake.records import set_height
from pbl_schemas.operations import forget
from pbl_schemas.reading import visit_list
from pbl_schemas.reading.usable import Usable, usable
from pbl_schemas.review import Decision
from pbl_schemas.rows import delete_below
from pbl_schemas.transactions import in_transaction
from pbl_workers.populate import populate
from pbl_workers.web.source import TablesSource
from tests import Environment, Faults, Limits, StandIn
from tests.command import pbl
from tests.integration import web
from tests.integration.chain import computed_once, small_video
from tests.rows import everything, register


@computed_once
def two_alike(folder: Path) -> int:
    """A video in which somebody has to be chosen."""
    number = register(small_video(folder, "walk", people="two alike"), session_label="2026-01-10")[0]
    populate()
    assert tracking.SubjectChoice.fetch1("choice_status") == "NEEDS_CHOICE"
    return number


def form_of(browser: Any, number: int) -> dict[str, str]:
    """The hidden fields of the form in which a person is chosen."""
    return web.form_of(browser, f"/recordings/{number}", f"/recordings/{number}/person")


def send(browser: Any, number: int, fields: dict[str, str], person: int):
    return browser.post(f"/recordings/{number}/person", data={**fields, "person": person}, follow_redirects=False)


def test_two_people_decide_at_once_and_the_second_sees_it(two_alike: int):
    first, second = web.client(name="A. First"), web.client(name="B. Second")
    forms = [form_of(b, two_alike) for b in (first, second)]
    assert send(first, two_alike, forms[0], 2).status_code == 303
    late = send(second, two_alike, forms[1], 1)
    assert late.status_code == 409
    assert "DECIDED_MEANWHILE" in late.text
    assert "A. First decided for person 2" in late.text
    assert tracking.SubjectOverride.fetch1("override_person_id") == 2
    (row,) = Decision().to_dicts()
    assert (row["video_id"], row["session_id"], row["decision_by"]) == (two_alike, None, "A. First")
    assert row["decision_before"] == {"status": "NEEDS_CHOICE", "person": None}
    assert row["decision_after"] == {"person": 2}
    populate()  # what depends on it is computed
    assert tracking.SubjectChoice.fetch1("choice_status", "chosen_person_id") == ("MANUAL", 2)
    assert len(fit.SessionFit()) == 1
    # Having seen it, the second decides otherwise: exactly what was computed for the other person goes.
    assert send(second, two_alike, form_of(second, two_alike), 1).status_code == 303
    assert len(tracking.Tracking()) == 1
    assert len(tracking.SubjectChoice()) == 0
    history = second.get("/visits/1").text
    assert history.index("B. Second") < history.index("A. First")
    assert "NEEDS_CHOICE" not in history[history.index("Decisions") :]
    assert "No one is chosen yet" in history
    listed = json.loads(pbl("list", "decisions", "--session", "2026-01-10", "--json").out)
    assert [(row["by"], row["what"], row["session_id"], json.loads(row["after"])) for row in listed] == [
        ("B. Second", "person", 1, {"person": 1}),
        ("A. First", "person", 1, {"person": 2}),
    ]


def test_a_person_who_was_chosen_is_shown_before_it_is_computed(two_alike: int):
    browser = web.client()
    assert "No one is chosen yet" in browser.get(f"/recordings/{two_alike}").text
    assert send(browser, two_alike, form_of(browser, two_alike), 1).status_code == 303
    page, visit = browser.get(f"/recordings/{two_alike}").text, browser.get("/visits/1").text
    assert "No one is chosen yet" not in page
    assert "Person 1 is measured" in page
    # What waits is said without the tables' and queues' own words.
    for told in (page, visit):
        assert "not computed yet" in told
        assert not re.search(r"SubjectChoice|priority|not queued|pbl worker", told)
    browser.cookies.set("pbl_language", "de")
    assert "noch nicht berechnet" in browser.get("/visits/1").text


def test_a_choice_on_the_command_line_is_seen_too(two_alike: int):
    browser = web.client()
    form = form_of(browser, two_alike)
    assert pbl("choose", two_alike, 1).code == 0
    assert send(browser, two_alike, form, 2).status_code == 409
    (row,) = Decision().to_dicts()
    assert (row["decision_by"], row["decision_after"]) == (getpass.getuser(), {"person": 1})
    assert tracking.SubjectOverride.fetch1("override_person_id") == 1


@pytest.mark.parametrize("person", ["99", "0", "-1", "1.5", "1 or 1=1", "99999999999", ""])
def test_a_forged_person_changes_nothing(two_alike: int, person: str):
    browser, before = web.client(), everything()
    form = form_of(browser, two_alike)
    answer = browser.post(f"/recordings/{two_alike}/person", data={**form, "person": person}, follow_redirects=False)
    assert answer.status_code in (409, 415), answer.text
    assert everything() == before


@pytest.mark.parametrize("change", [{"method": "none"}, {"seen": ""}, {"seen": "'--"}, {"token": ""}])
def test_a_forged_form_changes_nothing(two_alike: int, change: dict[str, str]):
    browser, before = web.client(), everything()
    answer = send(browser, two_alike, {**form_of(browser, two_alike), **change}, 1)
    assert answer.status_code in (400, 403, 409)
    assert send(browser, 999, form_of(browser, two_alike), 1).status_code in (400, 404)
    assert everything() == before


def test_a_reader_looks_and_does_not_decide(two_alike: int):
    reader, before = web.client(role="reader"), everything()
    assert "Your role can look but not decide" in reader.get(f"/recordings/{two_alike}").text
    assert send(reader, two_alike, form_of(reader, two_alike), 1).status_code == 403
    assert everything() == before


def test_the_picture_of_the_people(two_alike: int, environment: Environment):
    browser = web.client()
    picture = browser.get(f"/recordings/{two_alike}/people?method=0")
    assert (picture.status_code, picture.content[:3]) == (200, b"\xff\xd8\xff")
    assert browser.get(f"/recordings/{two_alike}/people?method=7").status_code == 404
    environment(PBL_DEIDENTIFY="blur")  # it shows faces
    assert browser.get(f"/recordings/{two_alike}/people?method=0").status_code == 404
    assert "/people?" not in browser.get(f"/recordings/{two_alike}").text


def test_a_worker_that_inserts_below_what_is_deleted_stops_no_decision(two_alike: int, faults: Faults):
    """DataJoint then says that its cascade was blocked; the second time the row is among those that go."""
    browser = web.client()
    assert send(browser, two_alike, form_of(browser, two_alike), 2).status_code == 303
    populate()
    blocked = "Delete blocked by table `pbl_gait`.`__spatiotemporal` in an unloaded schema."
    times = faults(dj.Table, "delete", dj.DataJointError(blocked))
    assert send(browser, two_alike, form_of(browser, two_alike), 1).status_code == 303
    assert (len(times), len(fit.SessionFit()), len(tracking.SubjectChoice())) == (2, 0, 0)


def test_a_worker_that_inserts_below_what_a_transaction_deletes_is_waited_for(
    tables: None, tmp_path: Path, faults: Faults
):
    """An open transaction does not see the new row however often it tries: it is begun again."""
    register(small_video(tmp_path, "walk"))
    populate()
    info, events = dj.conn().conn_info, gait.GaitEvents.full_table_name
    account = {"user": info["user"], "password": info["passwd"], "autocommit": True}
    with pymysql.connect(host=info["host"], port=info["port"], **account) as worker:
        query = worker.cursor().execute
        query(f"CREATE TABLE {events[:-1]}_kept` AS SELECT * FROM {events}")
        delete_below(gait.GaitEvents, gait.GaitEvents.keys())

        def insert_first(*_: Any, **__: Any) -> None:
            if len(begun) == 1:
                query(f"INSERT INTO {events} SELECT * FROM {events[:-1]}_kept`")

        begun = faults(dj.Table, "delete", before=insert_first)
        try:
            changes = in_transaction(lambda: set_height("P001", 1.7))
        finally:
            query(f"DROP TABLE {events[:-1]}_kept`")
    assert "gait_events" in changes[1]
    assert (len(begun), len(gait.GaitEvents()), len(fit.SessionFit())) == (2, 0, 0)


def test_a_fit_that_is_deleted_while_its_page_loads_is_pending(two_alike: int, monkeypatch: pytest.MonkeyPatch):
    browser = web.client()
    assert send(browser, two_alike, form_of(browser, two_alike), 2).status_code == 303
    populate()
    gone = lambda key: tuple(delete_below(fit.SessionFit, fit.SessionFit().keys()))  # noqa: E731
    monkeypatch.setattr(TablesSource, "state", staticmethod(gone))
    answer = browser.get(f"/recordings/{two_alike}/movement")
    assert (answer.status_code, "DB_NOT_FOUND" in answer.text) == (404, True)


@computed_once
def warned(folder: Path) -> dict[str, Any]:
    """A computed visit, number 1; the row of its check `residual_3d_cm`, which is WARN."""
    register(small_video(folder, "walk"), session_label="2026-01-10")
    populate()
    return (qc.SessionQc.proj("qc_computed") * qc.SessionQc.Check & {"qc_check": "residual_3d_cm"}).fetch1()


def accept(browser: Any, row: dict[str, Any], **change: object):
    fields = {"result": 0, "check": row["qc_no"], "computed": str(row["qc_computed"]), "reason": "seen", **change}
    return web.post(browser, "/visits/1/accept", **fields)


def test_a_warning_is_accepted_with_a_name_until_it_is_computed_anew(warned: dict[str, Any]):
    browser = web.client(name="A. First")
    assert "accepted by" not in browser.get("/visits/1").text
    assert accept(browser, warned, reason="<b>looked at the overlay").status_code == 303
    assert accept(web.client(name="B. Second"), warned).status_code == 303  # accepted already
    page = browser.get("/visits/1").text
    assert "accepted by A. First" in page
    assert re.search(r"<td>attention\s*</td><td>accepted\s*</td>", page)
    assert "&lt;b&gt;looked at the overlay" in page
    (row,) = Decision().to_dicts()
    assert (row["session_id"], row["video_id"], row["decision_before"]) == (1, None, {"outcome": "WARN"})
    key = {k: warned[k] for k in qc.SessionQc.primary_key}
    qc.SessionQc.update1({**key, "qc_computed": "2030-01-01 00:00:00"})  # as if computed again
    assert "accepted by" not in browser.get("/visits/1").text
    assert accept(browser, warned).status_code == 409
    assert len(review_decisions.decisions(1)) == 1  # what was decided stays in the history


def test_what_was_accepted_is_no_longer_open(warned: dict[str, Any]):
    browser = web.client(name="A. First")

    def listed(quality: str) -> int:
        return len(visit_list.visit_page(visit_list.Filter(quality=quality)).visits)

    key = {k: warned[k] for k in qc.SessionQc.primary_key}
    open_checks = (qc.SessionQc.Check & key & {"qc_check_outcome": "WARN"}).to_dicts()
    assert (listed("WARN"), listed("ACCEPTED")) == (1, 0)
    for i, check in enumerate(open_checks):
        (result,) = visit_list.results_of([1])[1]
        assert (result.outcome, len(result.worst)) == ("WARN", len(open_checks) - i)
        assert accept(browser, check | {"qc_computed": warned["qc_computed"]}).status_code == 303
        assert check["qc_check"] not in visit_list.results_of([1])[1][0].worst
    (result,) = visit_list.results_of([1])[1]
    assert (result.outcome, result.worst) == ("ACCEPTED", ())
    assert (listed("WARN"), listed("ACCEPTED")) == (0, 1)
    page = browser.get("/visits").text
    assert '<span class="outcome ACCEPTED">accepted</span>' in page
    assert '<span class="outcome WARN">' not in page
    browser.cookies.set("pbl_language", "de")
    assert '<span class="outcome ACCEPTED">angenommen</span>' in browser.get("/visits").text
    qc.SessionQc.update1({**key, "qc_computed": "2030-01-01 00:00:00"})  # as if computed again
    assert (listed("WARN"), listed("ACCEPTED")) == (1, 0)


def test_an_unusual_cadence_gives_no_number_until_somebody_accepts_it(
    tables: None, tmp_path: Path, limits: Limits, stand_in: StandIn
):
    measures = sys.modules["pbl_pipeline.gait.cycle_measures"]  # a function of the package has its name
    limits(measures, CADENCE_PER_MIN=(20.0, 50.0))  # the walk's is higher
    register(small_video(tmp_path, "walk"), session_label="2026-01-10")
    populate()
    numbers = ("session_gdi", "session_cadence", "session_gps")
    why = "the cadence is unusual for walking, and no one has accepted it"
    assert gdi.SessionGdi.fetch1(*numbers, "session_gdi_reason") == (None, None, None, why)
    assert qc.SessionQc.fetch1("qc_outcome") == "FAIL"
    assert usable(1) == Usable("unusable", (why, *usable(1).said[1:]), (0, 0), "walking")
    browser = web.client(name="A. First")
    assert why in browser.get("/visits/1").text
    cadence = {"qc_check": "cadence_plausible"}
    row = (qc.SessionQc.proj("qc_computed") * qc.SessionQc.Check & cadence).fetch1()
    assert row["qc_check_outcome"] == "FAIL"
    assert accept(browser, row, reason="counted").status_code == 303
    assert (len(gait.GaitEvents()), len(gait.GaitCycle()), len(gdi.SessionGdi())) == (1, 0, 0)
    populate()
    assert None not in gdi.SessionGdi.fetch1(*numbers[:2])
    assert (qc.SessionQc.Check & cadence).fetch1("qc_check_outcome") == "WARN"
    page = browser.get("/visits/1").text
    assert why not in page
    assert page.count("accepted by A. First") == 1
    (result,) = visit_list.results_of([1])[1]
    assert "cadence_plausible" not in result.worst
    key = gait.GaitCycle.fetch1("KEY")
    stand_in(accepted_cadence=lambda _: 1.0)  # as if the events had changed since
    delete_below(gait.GaitCycle, [key])
    populate()
    assert gdi.SessionGdi.fetch1(*numbers[:2]) == (None, None)
    assert "accepted by" not in browser.get("/visits/1").text


@pytest.mark.parametrize("reason", ["", "  ", "x" * 501])
def test_no_check_is_accepted_without_a_reason(warned: dict[str, Any], reason: str):
    before = everything()
    answer = accept(web.client(), warned, reason=reason)
    assert (answer.status_code, "USAGE" in answer.text) == (400, True)
    assert everything() == before
    assert re.search(r'<input name="reason"[^>]* required', web.client().get("/visits/1").text)


def test_only_warnings_can_be_accepted(warned: dict[str, Any]):
    key = {k: warned[k] for k in (*qc.SessionQc.primary_key, "qc_no")}
    assert accept(web.client(), warned, check=999).status_code == 404
    assert accept(web.client(), warned, check="x").status_code == 415
    assert accept(web.client(), warned, result=5).status_code == 404
    qc.SessionQc.Check.update1({**key, "qc_check_outcome": "FAIL"})
    with pytest.raises(PblError, match="asks for attention"):
        review_decisions.accept_check(key, warned["qc_no"], "A", "seen")
    assert len(Decision()) == 0


def test_a_forgotten_person_takes_the_decisions_along(warned: dict[str, Any]):
    accept(web.client(), warned)
    review_decisions.decide_person(1, int(tracking.SubjectChoice.fetch1("chosen_person_id")), by="A")
    assert len(Decision()) == 2
    assert not forget.forget("P001").left
    assert len(Decision()) == 0
