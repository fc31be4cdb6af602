"""Figures of README, docs and reports: the command that printed each, what it printed, and whether the text agrees.

A table or paragraph of figures is followed by `<!-- printed by NAME -->`. `commands.toml` has the command of each NAME,
`printed.json` what it printed, at which commit, on which day and machine. Constants of the code that a page states are
in `constants.toml`. `research/tests/test_figures.py` compares both with the pages.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import subprocess
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import docs_site

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
PRINTED = HERE / "printed.json"
_FENCE = re.compile(r"^```.*?^```[^\n]*$", re.MULTILINE | re.DOTALL)
_MARK = re.compile(r"<!-- printed by ([\w-]+) -->")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?")


class Passage(NamedTuple):
    """A table or paragraph of a page; `name`: the entry that printed its figures, "" without a mark."""

    page: str
    text: str
    name: str

    @property
    def numbers(self) -> list[str]:
        """The numbers of the passage, those in code and in targets of links left out."""
        return _NUMBER.findall(re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->", " ", self.text))

    @property
    def is_table_of_figures(self) -> bool:
        return self.text.startswith("|") and sum("." in number for number in self.numbers) >= 3


def commands() -> dict[str, str]:
    """Return the command of each name."""
    return tomllib.loads((HERE / "commands.toml").read_text("utf-8"))


def printed() -> dict[str, dict[str, str]]:
    """Return what each command printed: `commit`, `day`, `machine`, `text`."""
    return json.loads(PRINTED.read_text("utf-8"))


def pages() -> list[str]:
    """Return the pages and reports whose passages may be marked."""
    reports = (str(path.relative_to(ROOT)) for path in (ROOT / "research" / "reports").glob("*.md"))
    return [*(page for page in docs_site.pages() if page.endswith(".md")), *sorted(reports)]


def passages(page: str) -> Iterator[Passage]:
    """Yield the tables and paragraphs of a page. A mark below a passage is its last line or the next paragraph."""
    blocks = re.split(r"\n\s*\n", _FENCE.sub("", (ROOT / page).read_text("utf-8")))
    for i, block in enumerate(blocks):
        after = blocks[i + 1] if i + 1 < len(blocks) else ""
        mark = _MARK.search(block) or (_MARK.fullmatch(after.strip()))
        if not _MARK.fullmatch(block.strip()):
            yield Passage(page, block.strip("\n"), mark[1] if mark else "")


def unprinted(numbers: list[str], text: str) -> list[str]:
    """Return the numbers that `text` does not have, rounded to the digits of the page, as a fraction or as percent."""
    found = [float(n.replace(",", "")) for n in _NUMBER.findall(text)]
    return [n for n in numbers if not any(_same(n, value) for value in found)]


def _same(stated: str, value: float) -> bool:
    number = float(stated.replace(",", ""))
    half = 0.5000001 * 10.0 ** -len(stated.partition(".")[2])
    return any(abs(abs(number) - abs(v)) <= half for v in (value, 100 * value, value / 100))


def record(name: str) -> None:
    """Run the command of `name` from the root of the checkout and keep what it printed; entries without a command go.

    Raises
    ------
    subprocess.CalledProcessError
        The command failed; nothing is kept.
    """
    done = subprocess.run(  # noqa: S602  the project's own commands
        commands()[name], shell=True, cwd=ROOT, check=True, text=True, capture_output=True
    )
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, check=True, text=True, capture_output=True
    )
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    entry = {"commit": commit.stdout.strip(), "day": f"{datetime.now(UTC):%Y-%m-%d}", "machine": machine}
    found = {**(printed() if PRINTED.exists() else {}), name: {**entry, "text": done.stdout}}
    kept = {n: e for n, e in found.items() if n in commands()}
    PRINTED.write_text(json.dumps(dict(sorted(kept.items())), indent=1, ensure_ascii=False) + "\n", "utf-8")


def wrong_constants() -> list[str]:
    """Return one text for each statement of `constants.toml` that its page does not make with the code's values."""
    found = []
    for page, entry in tomllib.loads((HERE / "constants.toml").read_text("utf-8")).items():
        text = " ".join((ROOT / page).read_text("utf-8").split())
        for sentence, *expressions in entry["statements"]:
            expected = sentence.format(*map(_value, expressions))
            if expected not in text:
                found.append(f"{page}: {expected}")
    return found


def _value(expression: str) -> float:
    """The value of `module: expression`, evaluated in that module; whole numbers without a decimal point."""
    module, _, rest = expression.partition(": ")
    value = round(float(eval(rest, dict(vars(importlib.import_module(module))))), 6)  # noqa: S307  the project's own file
    return int(value) if value.is_integer() else value
