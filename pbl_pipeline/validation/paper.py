"""The paper's own figures, as printed, to stand beside ours."""

from __future__ import annotations

import functools
import json
from importlib import resources
from typing import Any


@functools.cache
def paper_figures() -> dict[str, Any]:
    """`data/paper_figures.json`: table -> `where` (table or section of the paper) and `cells` (row -> column -> text).

    The texts are as printed, most "median (nIQR)". Beside the tables that we fill from error rows it holds the paper's
    figures on reliability, curves and run time.
    """
    folder = resources.files("pbl_pipeline.validation").joinpath("data")
    return json.loads(folder.joinpath("paper_figures.json").read_text(encoding="utf-8"))


def paper_cells(table: str) -> dict[str, dict[str, str]]:
    """Row -> column -> text of one table; empty where the paper has no such table."""
    return paper_figures().get(table, {}).get("cells", {})


def paper_where(table: str) -> str:
    """Where in the paper a table's figures stand; empty where it has none."""
    return paper_figures().get(table, {}).get("where", "")
