"""Figures of README and docs: constants are those of the code, tables are what their commands printed."""

import subprocess

import pytest

import docs_site
from research.figures import ROOT, Passage, commands, pages, passages, printed, unprinted, wrong_constants

PAGES = [page for page in docs_site.pages() if page.endswith(".md") and page != "CHANGELOG.md"]
#: Pages whose tables have versions and limits, no measurements.
NO_FIGURES = {"docs/errors.md", "docs/export.md", "docs/files.md", "docs/licences.md"}


def test_constants_that_pages_state_are_those_of_the_code():
    assert wrong_constants() == []


def test_marked_passages_state_what_their_command_printed():
    marked = [passage for page in pages() for passage in passages(page) if passage.name]
    assert {p.name for p in marked} == set(commands()) == set(printed())
    wrong = {(p.page, p.name): unprinted(p.numbers, printed()[p.name]["text"]) for p in marked}
    assert {where: numbers for where, numbers in wrong.items() if numbers} == {}


def test_every_table_of_figures_is_marked():
    """Record what you measure (`python -m research.figures record NAME`), and mark the table."""
    tables = (p for page in PAGES if page not in NO_FIGURES for p in passages(page) if p.is_table_of_figures)
    assert [(p.page, p.text) for p in tables if not p.name] == []


def test_a_number_that_was_not_printed_is_seen():
    table = "| index | sd |\n|---|---|\n| 97.1 | 8.4 |\n| 0.94 | 1,107 |"
    assert unprinted(Passage("p", table, "x").numbers, "97.13 8.449 94.4 % 1107") == []
    assert unprinted(Passage("p", table, "x").numbers, "97.16 8.451 0.946 1108") == ["97.1", "8.4", "0.94", "1,107"]


@pytest.mark.long
@pytest.mark.parametrize("name", commands())
def test_the_command_prints_the_same_today(name: str):
    done = subprocess.run(commands()[name], shell=True, cwd=ROOT, check=True, text=True, capture_output=True)
    for passage in (p for page in pages() for p in passages(page) if p.name == name):
        assert unprinted(passage.numbers, done.stdout) == []
