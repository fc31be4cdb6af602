"""Entering in the review page: the role of a visit and clinical scores, from the click to the row."""

import datetime
import os
import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
from click.testing import CliRunner

from pbl_schemas import study
from pbl_schemas.cli.study import instrument
from pbl_schemas.review import Decision
from pbl_schemas.studies.visit_forms import enter_scores, scores_form
from tests import Environment
from tests.integration import web
from tests.rows import everything, new_visit


@pytest.fixture
def two_visits(tables: None) -> None:
    """P001 with visits 1 (pre, mJOA 12) and 2 of 2026, without videos."""
    new_visit("2026-01-10")
    new_visit("2026-04-10")
    study.Visit.insert1({"session_id": 1, "visit_role": "pre", "visit_note": "uses a cane"})
    study.ClinicalScore.insert1({"session_id": 1, "instrument": "mJOA", "score_value": 12})


def send(browser: Any, number: int, seen: str = "", reason: str = "", **values: object):
    seen = seen or str(re.findall(r'name="seen" value="([^"]*)"', browser.get(f"/visits/{number}/enter").text)[0])
    fields = {f"value:{name}": str(value) for name, value in values.items()}
    return web.post(browser, f"/visits/{number}/enter", seen=seen, reason=reason, **fields)


def score(number: int, name: str) -> float | None:
    found = (study.ClinicalScore & {"session_id": number, "instrument": name}).to_arrays("score_value")
    return float(found[0]) if len(found) else None


def test_each_change_is_a_row_with_what_was_before(two_visits: None):
    browser = web.client(name="A. First")
    answer = send(browser, 1, mJOA="13", TUG="9,5", BBS="44", role="baseline", reason="read from the <i>chart")
    assert (answer.status_code, answer.headers["location"]) == (303, "/visits/1#entered")
    assert (score(1, "mJOA"), score(1, "BBS"), score(1, "TUG")) == (13, 44, 9.5)
    assert (study.Visit & {"session_id": 1}).fetch1("visit_role", "visit_note") == ("baseline", "uses a cane")
    rows = {(r["decision_what"], r["decision_about"].get("instrument")): r for r in Decision().to_dicts()}
    told = {k: (r["decision_before"]["value"], r["decision_after"]["value"]) for k, r in rows.items()}
    scores = {"mJOA": (12.0, 13.0), "BBS": (None, 44.0), "TUG": (None, 9.5)}
    assert told == {**{("score", n): v for n, v in scores.items()}, ("role", None): ("pre", "baseline")}
    assert {(r["decision_by"], r["session_id"]) for r in rows.values()} == {("A. First", 1)}
    page = browser.get("/visits/1").text
    assert "clinical score mJOA: read from the &lt;i&gt;chart" in page
    assert re.search(r"TUG 9\.5 <span[^>]*>s<", page)
    browser.headers["accept-language"] = "de"
    assert re.search(r"TUG 9,5 <span[^>]*>s<", browser.get("/visits/1").text)
    assert 'value="9,5"' in browser.get("/visits/1/enter").text
    # What is as it was changes nothing; an empty field removes.
    assert send(browser, 1, mJOA="13.0", TUG="9,50", BBS="", role="baseline").status_code == 303
    assert (score(1, "BBS"), len(Decision())) == (None, 5)


@pytest.mark.parametrize(
    ("values", "code", "said"),
    [
        ({"mJOA": "19"}, "SCORE_RANGE", "at least 0 and at most 18"),
        ({"mJOA": "-1"}, "SCORE_RANGE", "at least 0"),
        ({"mJOA": "nan"}, "SHEET_FORMAT", "a number with a decimal point"),
        ({"mJOA": "12,5"}, "SCORE_RANGE", "a whole number"),
        ({"mJOA": "12.5"}, "SCORE_RANGE", "a whole number"),
        ({"mJOA-LE": "3", "mJOA": "2"}, "SHEET_CONFLICT", "the sum of its parts"),
        ({"TUG": "1,234"}, "SHEET_FORMAT", "a number with a decimal point"),
        ({"mJOA": "1_2"}, "SHEET_FORMAT", "a number"),
        ({"mJOA": "<script>"}, "SHEET_FORMAT", "&lt;script&gt;"),
        ({"role": "Six Weeks"}, "SHEET_FORMAT", "small letters"),
        ({"role": ""}, "SHEET_FORMAT", "no role"),
        ({"role": "x" * 33}, "SHEET_FORMAT", "small letters"),
    ],
)
def test_a_wrong_value_is_said_beside_its_field(two_visits: None, values: dict[str, str], code: str, said: str):
    browser, before = web.client(), everything()
    answer = send(browser, 1, **{"BBS": "40", **values})
    assert answer.status_code == 200
    page = answer.text
    at = page.index('aria-invalid="true"')
    beside = page[at : page.index("</div>", at)]
    assert code in beside
    assert said in beside
    assert page.count("aria-invalid") == 1
    assert 'value="40"' in page  # what was right is not typed again
    assert everything() == before  # all or nothing


def test_a_role_that_does_not_fit_the_days_is_refused(two_visits: None):
    answer = send(web.client(), 2, role="baseline")
    assert answer.status_code == 303  # two visits may be before
    answer = send(web.client(), 1, role="6_weeks")
    assert answer.status_code == 200
    assert "roles in the order of their dates" in answer.text


@pytest.fixture
def tokyo(environment: Environment) -> Iterator[str]:
    """The clock of a machine in Tokyo; what it shows now, to the hour."""
    before = os.environ.get("TZ")
    environment(TZ="Asia/Tokyo")
    time.tzset()
    yield f"{datetime.datetime.now():%Y-%m-%d %H:}"
    environment(TZ=before)
    time.tzset()


def test_times_are_those_of_the_clock_of_the_machine(two_visits: None, tokyo: str):
    browser, seen = web.client(role="reviewer,operator", name="A. First"), scores_form(1).seen
    assert send(browser, 1, seen, mJOA="14").status_code == 303
    for language in ("en", "de"):
        browser.headers["accept-language"] = language
        for page in (
            send(browser, 1, seen, mJOA="15").text,
            browser.get("/operate").text,
            browser.get("/visits/1").text,
        ):
            assert tokyo in page
            assert "UTC" not in page


def test_the_second_of_two_sees_what_the_first_entered(two_visits: None):
    first, second = web.client(name="A. First"), web.client(name="B. Second")
    seen = scores_form(1).seen
    assert send(first, 1, seen, mJOA="14").status_code == 303
    late = send(second, 1, seen, mJOA="15")
    assert late.status_code == 409
    assert "DECIDED_MEANWHILE" in late.text
    assert "A. First entered mJOA" in late.text
    assert (score(1, "mJOA"), len(Decision())) == (14, 1)
    study.ClinicalScore.update1({"session_id": 1, "instrument": "mJOA", "score_value": 16})  # as an import does
    assert send(second, 1, seen, BBS="3").status_code == 409
    assert send(second, 1, mJOA="15").status_code == 303
    assert score(1, "mJOA") == 15


def test_forged_forms_change_nothing(two_visits: None):
    reviewer, reader, before = web.client(), web.client(role="reader"), everything()
    assert send(reader, 1, mJOA="14").status_code == 403
    assert "Your role can look but not enter values" in reader.get("/visits/1/enter").text
    assert send(reviewer, 1, seen="forged", mJOA="14").status_code == 409
    assert send(reviewer, 1, **{"none'--": "3"}).status_code == 400
    assert send(reviewer, 999, seen=scores_form(1).seen, mJOA="3").status_code == 404
    token = {"value:mJOA": "3", "seen": scores_form(1).seen}
    assert reviewer.post("/visits/1/enter", data=token, follow_redirects=False).status_code == 403
    assert reviewer.get("/visits/999/enter").status_code == 404
    assert everything() == before


def test_a_value_that_an_import_wrote_out_of_range_does_not_block_the_others(two_visits: None):
    table = study.ClinicalScore.full_table_name
    study.ClinicalScore.connection.query(f"UPDATE {table} SET score_value = 99")
    assert enter_scores(1, {"mJOA": "99", "BBS": "12"}, "A", scores_form(1).seen)[0] == ("BBS",)


OWN = {"instrument": "FAC", "instrument_name": "Functional Ambulation Categories", "instrument_unit": "points",
       "instrument_low": "0", "instrument_high": "5", "higher_is_better": "yes", "ordinal": "yes"}  # fmt: skip


@pytest.fixture
def own(two_visits: None):
    yield
    (study.ClinicalScore & {"instrument": "FAC"}).delete(prompt=False)
    (study.ClinicalInstrument & {"instrument": "FAC"}).delete(prompt=False)


def test_an_instrument_of_ones_own_is_added_and_entered(own: None):
    browser = web.client(name="A. First")
    assert web.post(browser, "/instruments", **OWN).status_code == 303
    assert "Functional Ambulation Categories" in browser.get("/instruments").text
    assert send(browser, 1, FAC="2.5").status_code == 200
    assert send(browser, 1, FAC="3").status_code == 303
    assert score(1, "FAC") == 3
    added = (Decision & {"decision_what": "instrument"}).to_dicts()
    assert [(r["decision_by"], r["decision_after"]["instrument_high"]) for r in added] == [("A. First", 5)]
    again = web.post(browser, "/instruments", **{**OWN, "instrument": "fac"}).text
    assert "a name that no instrument and no column of a sheet has" in again
    computed = web.post(browser, "/instruments", **{**OWN, "instrument": "=HYPERLINK(A1)"}).text
    assert "a name that no spreadsheet computes" in computed


def test_every_wrong_field_of_an_instrument_is_said_and_nothing_is_added(own: None):
    browser, before = web.client(), everything()
    wrong = {"instrument": "Role", "instrument_name": "", "instrument_unit": "x" * 17, "instrument_low": "1,234",
             "instrument_high": "much", "minimal_change": "-1", "higher_is_better": "", "ordinal": "maybe"}  # fmt: skip
    answer = web.post(browser, "/instruments", **wrong)
    assert answer.status_code == 200
    assert answer.text.count("aria-invalid") == len(wrong)
    more = {"instrument_low": "6", "minimal_change": "1"}
    said = web.post(browser, "/instruments", **{**OWN, **more}).text
    assert said.count("aria-invalid") == 2
    assert "more than the lowest value, 6" in said
    assert "who found it, in whom" in said
    assert web.post(web.client(role="reader"), "/instruments", **OWN).status_code == 403
    assert "Add a score" not in web.client(role="reader").get("/instruments").text
    assert everything() == before


def test_the_command_adds_an_instrument(own: None):
    words = ["FAC", "--title", "Categories", "--unit", "points", "--better", "higher", "--low", "0"]
    assert CliRunner().invoke(instrument, ["add", *words, "--high", "-1"]).exit_code == 1
    assert CliRunner().invoke(instrument, ["add", *words, "--high", "5", "--ordinal"]).output == "FAC: added\n"
    row = (study.ClinicalInstrument & {"instrument": "FAC"}).fetch1()
    assert (row["instrument_high"], row["ordinal"], row["higher_is_better"]) == (5, 1, 1)


def test_from_the_click_to_the_row_in_a_browser(two_visits: None, chromium: Any):
    with web.shown(chromium) as page:
        page.goto("/visits/1")
        page.get_by_role("link", name="Enter role and clinical scores").click()
        page.get_by_label("Role of the visit").fill("baseline")
        page.get_by_label("BBS", exact=False).first.fill("57")
        page.get_by_role("button", name="Save").click()
        page.get_by_role("alert").wait_for()
        assert "at most 56" in page.locator(".problem").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.get_by_label("BBS", exact=False).first.fill("50")
        page.get_by_role("button", name="Save").click()
        page.wait_for_url("**/visits/1#entered")
    assert score(1, "BBS") == 50
    assert {r["decision_what"] for r in Decision().to_dicts()} == {"role", "score"}


@pytest.mark.parametrize(("language", "saved"), [("de", "Sichern"), ("en", "Save")])
def test_an_instrument_is_added_in_a_browser(own: None, chromium: Any, language: str, saved: str):
    with web.shown(chromium, locale=language) as page:
        page.goto("/visits/1/enter")
        page.locator('a[href="/instruments"]').click()
        for field, text in OWN.items():
            one = page.locator(f"#{field}")
            one.select_option(text) if text in ("yes", "no") else one.fill("" if field == "instrument_unit" else text)
        page.get_by_role("button", name=saved).click()
        page.get_by_role("alert").wait_for()
        assert page.locator(".problem").get_attribute("data-code") == "SHEET_FORMAT"
        assert ("ein leeres Feld." if language == "de" else "an empty field.") in page.locator(".problem").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.locator("#instrument_unit").fill("Punkte" if language == "de" else "points")
        page.get_by_role("button", name=saved).click()
        page.get_by_text("Functional Ambulation Categories").wait_for()
    assert (study.ClinicalInstrument & {"instrument": "FAC"}).fetch1("instrument_unit") == "points"
