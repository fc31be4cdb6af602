"""A table of errors: cells with a value, its spread and the number of trials, and the paper's figure beside it."""

from __future__ import annotations

import dataclasses
import math

import pandas as pd


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
    """A table in the paper's form.

    Attributes
    ----------
    name
        Stem of its files.
    title
        Quantity, with its unit and the meaning of the brackets.
    rows, columns
        Their names, in order.
    cells
        (row, column) -> `Cell`; one for every pair.
    where
        Where in the paper the figures beside ours stand; empty where there are none.
    note
        How ours were made, and how they differ from the paper's.
    digits
        Decimals of the values, by name of a row or column; else 2.
    """

    name: str
    title: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    cells: dict[tuple[str, str], Cell]
    where: str = ""
    note: str = ""
    digits: dict[str, int] = dataclasses.field(default_factory=dict)

    def cell(self, row: str, column: str) -> Cell:
        """The cell of a row and a column."""
        return self.cells[row, column]

    def ours(self, row: str, column: str) -> str:
        """Our value as text: `2.79 (0.86)`; empty where there is none."""
        cell, digits = self.cells[row, column], self.digits.get(row, self.digits.get(column, 2))
        if not math.isfinite(cell.value):
            return ""
        spread = f" ({cell.spread:.{digits}f})" if math.isfinite(cell.spread) else ""
        return f"{cell.value:.{digits}f}{spread}"

    def frame(self) -> pd.DataFrame:
        """Long form: one row per cell with `row, column, value, spread, n, paper, paper_where`."""
        cells = [
            {"row": r, "column": c, **dataclasses.asdict(self.cells[r, c]), "paper_where": self._where(r, c)}
            for r in self.rows
            for c in self.columns
        ]
        return pd.DataFrame(cells, columns=["row", "column", "value", "spread", "n", "paper", "paper_where"])

    def text(self) -> str:
        """For a terminal: ours with n in square brackets, and the paper's figure below it after `paper`."""
        width = max([len(r) for r in self.rows] + [5])
        body: list[list[str]] = [["", *self.columns]]
        for row in self.rows:
            cells = [self.cells[row, c] for c in self.columns]
            body.append([row, *(f"{self.ours(row, c)} [{self.cells[row, c].n}]".strip() for c in self.columns)])
            if any(cell.paper for cell in cells):
                body.append(["  paper", *(cell.paper for cell in cells)])
        widths = [width, *(max(len(line[i + 1]) for line in body) for i in range(len(self.columns)))]
        lines = [
            "  ".join(
                [line[0].ljust(widths[0]), *(x.rjust(w) for x, w in zip(line[1:], widths[1:], strict=True))]
            ).rstrip()
            for line in body
        ]
        tail = [f"paper: {self.where}"] if self.where else []
        return "\n".join([self.title, *lines, *([self.note] if self.note else []), *tail])

    def _where(self, row: str, column: str) -> str:
        return self.where if self.cells[row, column].paper else ""
