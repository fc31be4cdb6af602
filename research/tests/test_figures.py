"""Figures of README and docs: constants are those of the code, tables are what their commands printed."""

import subprocess
from collections import Counter

import pytest

import docs_site
from research.figures import ROOT, Passage, commands, passages, printed, unprinted, wrong_constants

PAGES = [page for page in docs_site.pages() if page.endswith(".md") and page != "CHANGELOG.md"]
#: Pages whose tables have versions and limits, no measurements.
NO_FIGURES = {"docs/errors.md", "docs/export.md", "docs/files.md", "docs/licences.md"}
#: Tables of figures by page whose command's output is not kept yet. It only becomes less: record what you measure
#: (`python -m research.figures record NAME`), mark the table, and lower the number.
NOT_KEPT = {
    "docs/accuracy.md": 14,
    "docs/events.md": 5,
    "docs/kinetics.md": 4,
    "docs/measures.md": 1,
    "docs/models.md": 1,
    "docs/statistics.md": 4,
    "docs/synth.md": 1,
    "docs/tracking.md": 1,
    "docs/validation.md": 1,
}


def test_constants_that_pages_state_are_those_of_the_code():
    assert wrong_constants() == []


def test_marked_passages_state_what_their_command_printed():
    marked = [passage for page in PAGES for passage in passages(page) if passage.name]
    assert {p.name for p in marked} == set(commands()) == set(printed())
    wrong = {(p.page, p.name): unprinted(p.numbers, printed()[p.name]["text"]) for p in marked}
    assert {where: numbers for where, numbers in wrong.items() if numbers} == {}


def test_tables_of_figures_without_a_kept_output_become_fewer():
    without = Counter(p.page for page in PAGES for p in passages(page) if p.is_table_of_figures and not p.name)
    assert {page: n for page, n in without.items() if page not in NO_FIGURES} == NOT_KEPT


def test_a_number_that_was_not_printed_is_seen():
    table = "| index | sd |\n|---|---|\n| 97.1 | 8.4 |\n| 0.94 | 1,107 |"
    assert unprinted(Passage("p", table, "x").numbers, "97.13 8.449 94.4 % 1107") == []
    assert unprinted(Passage("p", table, "x").numbers, "97.16 8.451 0.946 1108") == ["97.1", "8.4", "0.94", "1,107"]


@pytest.mark.long
@pytest.mark.parametrize("name", commands())
def test_the_command_prints_the_same_today(name: str):
    done = subprocess.run(commands()[name], shell=True, cwd=ROOT, check=True, text=True, capture_output=True)
    for passage in (p for page in PAGES for p in passages(page) if p.name == name):
        assert unprinted(passage.numbers, done.stdout) == []
