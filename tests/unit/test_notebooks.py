"""Every notebook of the docs runs, and prints what it shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests import notebook

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda p: p.stem)
def test_a_notebook_runs_and_prints_what_it_shows(path):
    """To store what it shows now: `python -m tests.notebook PATH`."""
    shown, now = json.loads(path.read_text(encoding="utf-8")), notebook.run(path)
    assert _printed(now)
    assert _printed(now) == _printed(shown)
    assert [len(c.get("outputs", ())) for c in now["cells"]] == [len(c.get("outputs", ())) for c in shown["cells"]]


def _printed(of: dict[str, Any]) -> list[str]:
    outputs = [o for cell in of["cells"] for o in cell.get("outputs", ())]
    return ["".join(o["text"]) for o in outputs if o["output_type"] == "stream"]
