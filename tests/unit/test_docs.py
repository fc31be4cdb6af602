"""The documentation names every code, variable and command there is, and none that is not."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from pathlib import Path

import click

from pbl_pipeline.cli import TASKS
from pbl_pipeline.errors import CODES
from pbl_pipeline.settings import VARIABLES
from tests.command import pbl

ROOT = Path(__file__).resolve().parents[2]


def test_errors_page_lists_exactly_the_codes():
    text = (ROOT / "docs" / "errors.md").read_text()
    listed = re.findall(r"^\| ([A-Z_]+) \|", text, re.MULTILINE)
    assert sorted(listed) == sorted(CODES)


def test_readme_names_every_variable_and_command():
    text = (ROOT / "README.md").read_text()
    missing = [v for v in VARIABLES if f"`{v}`" not in text]
    missing += [c.name for c in entry_points(group="pbl.commands") if f"`pbl {c.name}`" not in text]
    assert not missing


def test_readme_has_no_placeholder_and_no_dead_link():
    text = (ROOT / "README.md").read_text()
    assert not re.findall(r"@[A-Z]+@", text)
    links = [x for x in re.findall(r"\]\(([^)#]+)", text) if "://" not in x]
    assert [x for x in links if not (ROOT / x).exists()] == []
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert [t for t in re.findall(r"`make ([a-z-]+)`", text) if t not in targets] == []


def test_every_command_has_help_with_an_example():
    commands = entry_points(group="pbl.commands")
    assert len(commands) > 15
    for entry in commands:
        command = entry.load()
        assert "Example:" in command.get_help(click.Context(command)), entry.name


def test_the_help_lists_every_command_under_one_task():
    listed = [name for names in TASKS.values() for name in names]
    assert sorted(listed) == sorted(entry.name for entry in entry_points(group="pbl.commands"))
    shown = pbl("--help").out
    assert "Further commands" not in shown
    assert all(f"\n{task}:\n" in shown for task in TASKS)
    assert all(shown.count(f"\n  {name} ") == 1 for name in listed)
