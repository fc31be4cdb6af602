"""Aids, orthoses, roles and groups: stated by words of a language, kept as codes, shown by words."""

import importlib
from pathlib import Path

import pytest

from pbl_schemas import connection, kinetics, lab, study
from pbl_schemas.reading import comparison
from pbl_schemas.reading.visit_list import results_of
from pbl_schemas.studies import visit_forms
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import populate
from tests import not_none
from tests.integration import web
from tests.integration.chain import computed_once, small_video
from tests.rows import register

GERMAN = {"accept-language": "de"}


@computed_once
def visits(folder: Path) -> None:
    """Two computed visits of P001."""
    for day in ("2026-01-10", "2026-04-10"):
        register(small_video(folder, day), session_label=day)
    populate()


def stated(number: int, language: str, **words: str) -> None:
    """State role, aid and orthosis of a visit on its pages."""
    browser = web.client()
    browser.headers["accept-language"] = language
    for page, fields in (
        ("enter", {"value:role": words.pop("role")}),
        ("facts", words),
    ):
        form = web.form_of(browser, f"/visits/{number}/{page}", f"/visits/{number}/{page}")
        answer = browser.post(f"/visits/{number}/{page}", data={**form, **fields}, follow_redirects=False)
        assert answer.status_code == 303, answer.text


def test_words_of_both_languages_are_one_code(visits: None):
    stated(1, "de", role="vor dem Eingriff", assistive_device="Keine", orthosis="keine", population="gesund")
    stated(2, "en", role="3 months", assistive_device="none", orthosis="none")
    first, second = study.Visit().to_dicts(order_by="session_id")
    assert [(v["visit_role"], v["assistive_device"], v["orthosis"]) for v in (first, second)] == [
        ("pre", "none", "none"),
        ("3_months", "none", "none"),
    ]
    assert lab.Subject.fetch1("population") == "healthy"
    populate()
    assert not {"AID"} & set(kinetics.Kinetics().to_arrays("forces_code"))  # of "keine" they were refused
    assert comparison.compare([(1, None), (2, None)]).compared[1].differs == ()
    browser = web.client()
    for language, role, none in (("de", "3 Monate", "keine"), ("en", "3 months", "none")):
        browser.headers["accept-language"] = language
        page = browser.get("/visits/2").text
        assert role in page
        assert "3_months" not in page
        facts = browser.get("/visits/2/facts").text
        assert f'<option value="none" selected>{none.capitalize()}</option>' in facts
        assert f'name="orthosis" value="{none}"' in facts
    stated(2, "de", role="3 Monate", assistive_device="Rollator", orthosis="keine")
    stated(1, "en", role="pre", assistive_device="walker", orthosis="none")
    assert comparison.compare([(1, None), (2, None)]).compared[1].differs == ()


def test_not_stated_is_not_none(visits: None):
    page = web.client().get("/visits/1/facts").text
    assert '<option value="" selected>Not stated</option>' in page
    stated(1, "en", role="pre", assistive_device="none")
    filmed = [not_none(results_of([n])[n][0].filming).aid for n in (1, 2)]
    assert filmed == [("none",), ()]
    assert comparison.compare([(1, None), (2, None)]).compared[1].differs == ()  # nothing says that it was another
    stated(1, "en", role="pre", assistive_device="cane")
    browser = web.client()
    assert "other walking aid (not stated, before: cane)" in browser.get("/compare?v=1&v=2").text
    german = browser.get("/compare?v=1&v=2", headers=GERMAN).text
    assert "andere Gehhilfe (nicht angegeben, zuvor: Stock)" in german


def test_sheets_take_words_and_codes(tables: None, tmp_path: Path):
    sheet = tmp_path / "visits.csv"
    sheet.write_text(
        "subject,visit,role,assistive_device,orthosis,population\n"
        "P001,2026-01-10,vor der OP,Gehstock,AFO links,gesund\n"
        "P002,2026-01-10,6 Wochen,my own stick,-,patient\n"
    )
    assert import_sheets([sheet]).done
    rows = study.Visit().to_dicts(order_by="session_id")
    assert [(r["visit_role"], r["assistive_device"], r["orthosis"]) for r in rows] == [
        ("pre", "cane", "afo_left"),
        ("6_weeks", "my own stick", ""),
    ]
    again = import_sheets([sheet])
    assert not [line.changes for line in again.lines if line.changes]


def test_the_phone_does_not_state_an_aid_by_itself(visits: None):
    from tests.integration.test_web_phone import phone

    for language, words in (("en", "not stated"), ("de", "nicht angegeben")):
        page = phone(1).get("/phone", headers={"accept-language": language}).text
        assert f'name="aid" value="" checked> {words}</label>' in page


def test_old_words_become_codes_once(visits: None):
    server, module = connection.connect(), importlib.import_module("pbl_schemas.migrations.0011_codes_of_words")
    assert module.statements(server) == []
    study.Visit.insert1(
        {"session_id": 1, "assistive_device": "Keine", "orthosis": "AFO links", "visit_role": "3_monate"}
    )
    lab.Population.insert1({"population": "gesund", "population_description": ""})
    lab.Subject.update1({"subject": "P001", "population": "gesund"})
    before = len(kinetics.Kinetics())
    table = kinetics.Kinetics.full_table_name
    server.query(f"UPDATE {table} SET forces_code = 'AID', forces_aid = 'Keine' WHERE session_id = 1")
    for statement in module.statements(server):
        server.query(statement)
    visit = study.Visit.fetch1()
    assert (visit["assistive_device"], visit["orthosis"], visit["visit_role"]) == ("none", "afo_left", "3_months")
    assert lab.Subject.fetch1("population") == "healthy"
    assert len(kinetics.Kinetics()) == before - 1  # computed again: it was refused for a word
    assert module.statements(server) == []
    populate()
    assert len(kinetics.Kinetics() & "forces_code != 'AID'") == before


@pytest.mark.parametrize("kind", ["aid", "orthosis", "population", "role", "pace", "activity"])
def test_every_word_is_that_of_one_code(kind: str):
    from pbl_pipeline import texts

    assert texts.codes(kind)
    words = [
        (word.casefold(), name)
        for name, said in texts.catalogue().items()
        if name.startswith(f"coded.{kind}_")
        for word in "|".join(said.values()).split("|")
    ]
    by_word: dict[str, set[str]] = {}
    for word, name in words:
        by_word.setdefault(word, set()).add(name)
    assert {w: n for w, n in by_word.items() if len(n) > 1} == {}
    for code in texts.codes(kind):
        for language in texts.LANGUAGES:
            assert texts.code_of(kind, texts.coded(language, kind, code)) == code
    for role in visit_forms.USUAL_ROLES if kind == "role" else ():
        assert {texts.code_of(kind, texts.coded(language, kind, role)) for language in texts.LANGUAGES} == {role}
