"""The review page over tables: finding visits, and what must not work."""

import datetime
import html
import io
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import fit, gdi, qc, study
from pbl_schemas.reading import visit_list
from pbl_schemas.reading.shown import shown_visit
from pbl_schemas.reading.visit_list import Filter, visit_page
from pbl_workers.populate import populate
from pbl_workers.web import Options, create_app, export
from pbl_workers.web.access import HOURS, Sessions
from tests import Faults, Limits
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import new_visit, register


@pytest.fixture
def four_visits(tables: None) -> None:
    """P001 with three visits and P002 with one, no videos: numbers 1 to 4."""
    for label in ("2026-01-10", "2026-04-10", "later"):
        new_visit(label)
    new_visit("2026-02-01", "P002")
    study.Visit.insert({"session_id": i, "visit_role": r} for i, r in ((1, "pre"), (2, "3_months"), (4, "pre")))
    study.Cohort.insert1({"cohort": "spine"})
    members = (("P001", True), ("P002", False))
    study.CohortMember.insert({"cohort": "spine", "subject": s, "member_included": i} for s, i in members)


def numbers(wanted: Filter, **more: Any) -> list[int]:
    return [v.session_id for v in visit_page(wanted, **more).visits]


def test_filters_of_the_list_and_their_order(four_visits: None):
    assert numbers(Filter()) == [2, 4, 1, 3]  # the newest day first, no day last
    assert numbers(Filter(search="p001")) == [2, 1, 3]
    assert numbers(Filter(search="LATE")) == [3]
    assert numbers(Filter(search="%")) == numbers(Filter(search="_")) == numbers(Filter(search="\\")) == []
    assert numbers(Filter(search="' OR 1=1 -- ")) == []
    assert numbers(Filter(cohort="spine")) == [2, 1, 3]  # who was left out of a cohort is not in it
    assert numbers(Filter(role="pre")) == [4, 1]
    assert numbers(Filter(first_day=datetime.date(2026, 2, 1))) == [2, 4]
    assert numbers(Filter(last_day=datetime.date(2026, 2, 1), cohort="spine")) == [1]
    assert numbers(Filter(state="unrecorded")) == [2, 4, 1, 3]
    assert [numbers(Filter(state=s)) for s in visit_list.STATES if s != "unrecorded"] == [[]] * 6
    assert visit_list.choices() == {"cohort": ["spine"], "role": ["pre", "3_months"]}


def test_pages_of_the_list_hold_every_visit_once(four_visits: None):
    first = visit_page(Filter(), size=1)
    assert first.total == 4
    found, page = [first.visits[0].session_id], first
    while page.after is not None:
        page = visit_page(Filter(), page.after, size=1)
        found.append(page.visits[0].session_id)
        assert page.total is None
    assert found == [2, 4, 1, 3]


def test_a_visit_with_its_index_trend_and_worst_check(tables: None, tmp_path: Path, limits: Limits):
    for day in ("2026-01-10", "2026-04-10"):
        register(small_video(tmp_path, f"walk {day}"), session_label=day)
    register(small_video(tmp_path, "none", people="nobody"), subject="P004", session_label="2026-02-03")
    register(small_video(tmp_path, "two", people="two alike"), subject="P002", session_label="2026-02-01")
    broken = tmp_path / "gone.mp4"
    broken.write_bytes(small_video(tmp_path, "gone").read_bytes() + b"x")
    register(broken, subject="P003", session_label="2026-02-02")
    broken.unlink()
    populate()
    for number, index in ((1, 80.0), (2, 90.0)):
        key = (gdi.SessionGdi & visit_list_key(number)).keys()[0]
        gdi.SessionGdi.update1({**key, "session_gdi": index, "session_gdi_sd": 3, "session_gdi_minimal_change": 7})
    rows = {v.subject + str(v.day): v for v in visit_page(Filter()).visits}
    later, before = rows["P0012026-04-10"], rows["P0012026-01-10"]
    assert later.trend is not None
    assert (later.trend.session_id, later.trend.change, later.trend.sure) == (before.session_id, 10.0, True)
    assert before.trend is None
    assert (later.state, later.videos, later.more) == ("computed", 1, 0)
    assert later.result is not None
    assert later.result.outcome == (qc.SessionQc & visit_list_key(2)).fetch1("qc_outcome")
    assert "residual_3d_cm" in later.result.worst
    assert [rows[k].state for k in ("P0022026-02-01", "P0032026-02-02")] == ["waiting", "failed"]
    assert rows["P0032026-02-02"].problem == "VIDEO_MISSING"
    by_state = {s: numbers(Filter(state=s)) for s in visit_list.STATES}
    counts = {s: len(n) for s, n in by_state.items() if n}
    assert counts == {"computed": 2, "waiting": 1, "failed": 1, "empty": 1}
    assert sorted(numbers(Filter(quality=later.result.outcome))) == [1, 2]
    page = web.client().get("/visits").text
    assert "+10.0 since 2026-01-10: more than chance" in page
    assert "Residual 3D (cm)" in page
    assert "VIDEO_MISSING" in page
    for number in (1, 2):  # each page shows the result of its own visit
        assert shown_visit(number).key["fit_set"] == visit_list_key(number)["fit_set"]
    visit = web.client().get(f"/visits/{later.session_id}").text
    assert "Cadence" in visit
    assert "look at the overlay" in visit  # the advice of the check
    stopped = web.client().get(f"/visits/{rows['P0032026-02-02'].session_id}").text
    assert "VIDEO_MISSING" in html.unescape(stopped)
    assert "a fit without one marker" in web.client().get(f"/visits/{later.session_id}/export").text
    limits(export, FORMATS=("csv", "mot"))  # the stand-in of the fit has no markers for a .trc
    taken = web.client().get(f"/visits/{later.session_id}/export")
    assert taken.status_code == 200, taken.text
    assert taken.headers["content-disposition"] == f'attachment; filename="visit_{later.session_id}.zip"'
    names = zipfile.ZipFile(io.BytesIO(taken.content)).namelist()
    assert {Path(n).suffix for n in names} >= {".csv", ".mot"}
    assert not any("walk" in n or "P001" in n for n in names)
    assert web.client().get(f"/visits/{rows['P0032026-02-02'].session_id}/export").status_code == 404
    assert rows["P0042026-02-03"].state == "empty"


def visit_list_key(number: int) -> dict[str, str]:
    return {"fit_set": (fit.FitSet & {"session_id": number}).fetch1("fit_set")}


# ---------------------------------------------------------------------------------------------------------- the way in
def test_a_link_opens_one_browser_once():
    app = create_app(Options())
    key = app.state.site.sessions.new_link("A", "reader")
    browser, other = (web.TestClient(app, base_url=web.BASE) for _ in range(2))
    answer = browser.get("/enter", params={"key": key, "to": "/visits/12"}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/visits/12")
    cookie = answer.headers["set-cookie"].lower()
    assert all(part in cookie for part in ("httponly", "samesite=strict", "path=/", "max-age=43200"))
    assert other.get("/enter", params={"key": key}, follow_redirects=False).status_code == 401
    assert other.get("/visits").status_code == 401
    for to in ("//evil.example", "https://evil.example", "/visits/1/../../x", "/visits/1\r\nx: y", "/recordings"):
        key = app.state.site.sessions.new_link("A", "reader")
        answer = other.get("/enter", params={"key": key, "to": to}, follow_redirects=False)
        assert answer.headers["location"] == "/"


def test_a_session_ends_and_is_never_taken_from_the_browser():
    now = [0.0]
    sessions = Sessions(clock=lambda: now[0])
    app = create_app(Options(), sessions)
    cookie = sessions.enter(sessions.new_link("A", "reader"))
    assert cookie is not None
    assert sessions.find(cookie) is not None
    now[0] = 3600 * HOURS + 1
    assert sessions.find(cookie) is None
    # Fixation: a cookie that was put into a browser before is not the one that it gets.
    browser = web.TestClient(app, base_url=web.BASE, cookies={"pbl_session": "planted"})
    browser.get("/enter", params={"key": sessions.new_link("A", "reader")}, follow_redirects=False)
    assert sessions.find("planted") is None
    assert web.TestClient(app, base_url=web.BASE, cookies={"pbl_session": "planted"}).get("/visits").status_code == 401


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8484", 404),
        ("localhost", 404),
        ("[::1]:8484", 404),
        ("evil.example", 400),
        ("127.0.0.1.evil.example:8484", 400),
        ("127.0.0.1@evil.example", 400),
        ("", 400),
        ("[::1", 400),
    ],
)
def test_only_the_names_of_this_machine_are_answered(host: str, status: int):
    """Otherwise a page elsewhere could have its own name lead here (DNS rebinding)."""
    assert web.client().get("/nothing", headers={"host": host}).status_code == status


@pytest.mark.parametrize(
    ("search", "headers", "status"),
    [
        ("x", {"content-type": "text/plain"}, 415),
        ("x" * 70_000, {}, 413),
        ("x", {"origin": web.BASE}, 303),
    ],
)
def test_a_form_of_the_page_is_taken(tables: None, search: str, headers: dict, status: int):
    """Those of other pages: test_web_attacks.py."""
    browser = web.client()
    fields = {"token": web.token(browser), "search": search}
    assert browser.post("/visits", data=fields, headers=headers, follow_redirects=False).status_code == status


def test_what_was_searched_for_is_no_part_of_an_address(four_visits: None):
    browser = web.client()
    answer = web.post(browser, "/visits", search="P001", role="pre")
    assert answer.headers["location"] == "/visits?q=1&role=pre"
    page = browser.get("/visits?q=1&role=pre").text
    assert "/visits/1" in page
    assert "/visits/4" not in page
    assert 'value="P001"' in page
    assert "This filter does not exist" in web.client().get("/visits?q=1").text  # another session's number


def test_every_answer_carries_the_headers(four_visits: None):
    browser = web.client()
    signed_out = web.client(signed_in=False)
    for answer in (browser.get("/visits"), browser.get("/nothing"), signed_out.get("/visits"),
                   browser.get("/static/page.css"), browser.get("/visits", headers={"host": "evil"})):  # fmt: skip
        policy = answer.headers["content-security-policy"]
        assert "unsafe" not in policy
        assert policy.startswith("default-src 'none'")
        assert (answer.headers["x-content-type-options"], answer.headers["cache-control"]) == ("nosniff", "no-store")
    # The name of such a file carries its version.
    assert "immutable" in browser.get("/vendor/uplot-1.6.32.min.js").headers["cache-control"]
    assert browser.get("/vendor/none.js").headers["cache-control"] == "no-store"


def test_no_page_has_a_script_or_style_of_its_own(four_visits: None):
    """Else the policy would have to allow them, and with them those of a label."""
    browser = web.client()
    for path in ("/visits", "/visits/1", "/nothing", "/visits/99"):
        page = browser.get(path).text
        assert not re.search(r"<style|\sstyle=|\son[a-z]+=|javascript:|<script(?![^>]*\ssrc=)", page)


@pytest.mark.parametrize(
    "path",
    [
        "/static/../app.py",
        "/static/%2e%2e/app.py",
        "/static/..%2fapp.py",
        "/static/%2e%2e%2f%2e%2e%2f%2e%2e%2fetc/passwd",
        "/vendor//etc/passwd",
        "/static/",
        "/static/%00",
        "/visits/../enter",
        "/visits/-1",
        "/visits/1e3",
        "/visits/%31%27",
        "/visits/99999999999999999999999",
        "/visits/1?result=9",
        "/visits/1?result=-1",
    ],
)
def test_addresses_that_lead_nowhere(four_visits: None, path: str):
    answer = web.client().get(path)
    assert answer.status_code in (401, 404), answer.text
    assert "root:" not in answer.text


@pytest.mark.parametrize(
    "query",
    ["after=2026-01-01~99999999999", "after=x", "after=2026-99-99~1", "first_day=yesterday", "quality=GOOD", "q=0",
     "q=999999999999", "cohort=none", "role=%00", "state='--", "after=0000-00-00~1"],
)  # fmt: skip
def test_filters_that_do_not_exist_are_left_out(four_visits: None, query: str):
    answer = web.client().get(f"/visits?{query}")
    assert answer.status_code == 200
    assert ("/visits/1" in answer.text) != query.startswith(("cohort", "role"))


def test_the_database_away_is_a_page_that_says_what_to_do(four_visits: None):
    from pbl_schemas.operations import embedded

    browser = web.client()
    assert browser.get("/visits").status_code == 200
    embedded.stop()
    try:
        away = browser.get("/visits")
        assert away.status_code == 503
        assert "DB_NOT_RUNNING" in away.text
        assert "ask the person who runs this server" in away.text
    finally:
        embedded.start()
    assert "/visits/1" in browser.get("/visits").text  # the same page finds the server again


def test_an_error_nobody_foresaw_says_nothing_of_the_program(four_visits: None, faults: Faults):
    faults(visit_list, "choices", RuntimeError("secret path /home/x"))
    answer = web.client().get("/visits")
    assert answer.status_code == 500
    assert "secret" not in answer.text
    assert "unsafe" not in answer.headers["content-security-policy"]


def test_german_by_the_browser_and_by_choice(four_visits: None):
    browser = web.client()
    assert "Termine" in browser.get("/visits", headers={"accept-language": "fr, de-CH;q=0.8, en;q=0.1"}).text
    web.post(browser, "/language", language="de", back="/visits/1")
    assert "Alle Termine dieser Person" in browser.get("/visits/1").text
    assert web.post(browser, "/language", language="de", back="//evil").headers["location"] == "/"
