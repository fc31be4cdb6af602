"""A table of errors: cells with a value, its spread and the number of trials, and the paper's figure beside it."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from importlib import resources
from typing import Any

import pandas as pd


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


@dataclasses.dataclass(frozen=True)
class Cell:
    """`value` (`spread`) over `n` trials; `paper` is the paper's figure as printed, or ``""``.

    An empty cell has NaN and n = 0. A single value has no spread (NaN).
    """

    value: float = math.nan
    spread: float = math.nan
    n: int = 0
    paper: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table in the paper's form."""

    name: str  # stem of its files
    title: str  # quantity, with its unit and the meaning of the brackets
    cells: dict[tuple[str, str], Cell]  # by (row, column), row by row; one for every pair
    note: str = ""  # how ours were made, and how they differ from the paper's
    digits: dict[str, int] = dataclasses.field(default_factory=dict)  # by name of a row or column; else 2

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows, in order."""
        return tuple(dict.fromkeys(row for row, _ in self.cells))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return tuple(dict.fromkeys(column for _, column in self.cells))

    @property
    def where(self) -> str:
        """Where in the paper the figures beside ours stand; empty where there are none."""
        return paper_where(self.name)

    def cell(self, row: str, column: str) -> Cell:
        return self.cells[row, column]

    def ours(self, row: str, column: str) -> str:
        """Return our value as text: `2.79 (0.86)`; empty where there is none."""
        cell, digits = self.cells[row, column], self.digits.get(row, self.digits.get(column, 2))
        if not math.isfinite(cell.value):
            return ""
        spread = f" ({cell.spread:.{digits}f})" if math.isfinite(cell.spread) else ""
        return f"{cell.value:.{digits}f}{spread}"

    def frame(self) -> pd.DataFrame:
        """Return the long form: one row per cell with `row, column, value, spread, n, paper, paper_where`."""
        cells = [
            {"row": r, "column": c, **dataclasses.asdict(cell), "paper_where": self.where if cell.paper else ""}
            for (r, c), cell in self.cells.items()
        ]
        return pd.DataFrame(cells, columns=["row", "column", "value", "spread", "n", "paper", "paper_where"])

    def text(self) -> str:
        """Return the table for a terminal: ours with n in square brackets, the paper's figure below it."""
        body: list[list[str]] = [[" " * 5, *self.columns]]
        for row in self.rows:
            cells = {c: self.cells[row, c] for c in self.columns}
            body.append([row, *(f"{self.ours(row, c)} [{cell.n}]".strip() for c, cell in cells.items())])
            if any(cell.paper for cell in cells.values()):
                body.append(["  paper", *(cell.paper for cell in cells.values())])
        first, *others = (max(map(len, column)) for column in zip(*body, strict=True))
        lines = ["  ".join([label.ljust(first), *map(str.rjust, texts, others)]).rstrip() for label, *texts in body]
        return "\n".join([self.title, *lines, *filter(None, [self.note, self.where and f"paper: {self.where}"])])
