"""Tables of errors with the paper's own figures beside, as CSV, LaTeX and one HTML page."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import pandas as pd

from pbl_pipeline.code_version import code_version
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.errors import PblError
from pbl_pipeline.latex import tex_escape
from pbl_pipeline.shipped import shipped_page, shipped_text


@functools.cache
def paper_figures() -> dict[str, Any]:
    """`data/paper_figures.json`: table -> `where` (table or section of the paper) and `cells` (row -> column -> text).

    The texts are as printed, most "median (nIQR)". Beside the tables that we fill from error rows it holds the paper's
    figures on reliability, curves and run time.
    """
    return json.loads(shipped_text("validation/data/paper_figures.json"))


def paper_cells(table: str) -> dict[str, dict[str, str]]:
    """Row -> column -> text of one table; empty where the paper has no such table."""
    return paper_figures().get(table, {}).get("cells", {})


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
        return tuple(dict.fromkeys(row for row, _ in self.cells))

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(column for _, column in self.cells))

    @property
    def where(self) -> str:
        """Place of the compared figures in the paper; "" if there are none."""
        return paper_figures().get(self.name, {}).get("where", "")

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


#: Columns of the indices: of a visit by one kind of recordings (`kind`: single, rig, markers) against a norm that was
#: built from cycles of `norm_kind`; "" for one that ships. `index`: `Gdi.unshrunk`.
INDEX_COLUMNS = ("subject", "session_label", "session_id", "kind", "method", "norm", "norm_kind", "index")
#: Columns of the pairs: the index of one camera and of several, of one visit.
PAIR_COLUMNS = ("subject", "session_label", "single", "rig", "single_norm", "rig_norm")
_ROW = "GDI of one camera against several"


def index_pairs(indices: pd.DataFrame) -> pd.DataFrame:
    """First visits of persons with an index of one camera and one of several, each with a norm of the same kind, as
    pairs.

    Raises `PblError` USAGE: a visit has several such indices of one kind, by several methods or norms.

    Parameters
    ----------
    indices
        Rows with `INDEX_COLUMNS`, both indices by one estimator (`Gdi.unshrunk`). An index with a norm of another kind,
        or with an included norm, does not count.
    """
    own: Any = indices[(indices["kind"] == indices["norm_kind"]) & indices["index"].notna()]
    twice = own[own.duplicated(["session_id", "kind"], keep=False)]
    if len(twice):
        chains = sorted({f"{m}, {n}" for m, n in zip(twice["method"], twice["norm"], strict=True)})
        raise PblError(
            "USAGE",
            found=f"several indices of one kind for a visit: {'; '.join(chains[:6])}",
            expected="one index and one norm of each kind",
            next_step="name them: --where method=NAME, or --where norm=NAME for each kind",
        )
    columns = ["subject", "session_label", "session_id", "index", "norm"]
    kinds = [
        own.loc[own["kind"] == k, columns].rename(columns={"index": k, "norm": f"{k}_norm"}) for k in ("single", "rig")
    ]
    pairs: Any = kinds[0].merge(kinds[1], on=columns[:3])
    return pairs.sort_values("session_id").drop_duplicates("subject", ignore_index=True)[list(PAIR_COLUMNS)]


def index_agreement(pairs: pd.DataFrame) -> Table:
    """Pearson's r, bias and limits of agreement of the index of one camera and of several.

    Raises `PblError` STATS_INPUT: fewer than four visits, or indices that are all the same.
    """
    from pbl_pipeline.stats import bland_altman, correlation

    one, several = (pairs[k].to_numpy(float) for k in ("single", "rig"))
    r, agreement, n = correlation(one, several), bland_altman(one, several), len(pairs)
    values = {
        "r": Cell(r.value, n=n, paper=paper_cells("index_agreement")[_ROW]["r"]),
        "r, low": Cell(r.low, n=n),
        "r, high": Cell(r.high, n=n),
        "bias": Cell(agreement.bias.value, n=n),
        "lower limit": Cell(agreement.lower.value, n=n),
        "upper limit": Cell(agreement.upper.value, n=n),
        "sd, one camera": Cell(float(np.std(one, ddof=1)), n=n),
        "sd, several": Cell(float(np.std(several, ddof=1)), n=n),
    }
    norms = [", ".join(sorted(set(pairs[f"{k}_norm"]))) for k in ("single", "rig")]
    return Table(
        "index_agreement",
        "Index of one camera against several, each with a norm of the same kind",
        {(_ROW, column): cell for column, cell in values.items()},
        f"The first such visit of each of {n} persons. Norms: {norms[0]} (one camera), {norms[1]} (several). Both "
        "indices are unshrunk. Bias: one camera minus several; limits of agreement hold 95 % of the persons. r with "
        "its 95 % interval.",
        {column: 1 if column not in ("r", "r, low", "r, high") else 2 for column in values},
    )


def write_tables(tables: Mapping[str, Table], folder: str | Path) -> list[Path]:
    """Write each table as `<name>.csv` (long form) and `<name>.tex` (booktabs), and all as `index.html`.

    The folder is made. Returns the paths; the page is the last.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for table in tables.values():
        csv, tex = folder / f"{table.name}.csv", folder / f"{table.name}.tex"
        csv.write_bytes(frame_to_csv(table.frame()).encode())
        tex.write_text(latex(table), encoding="utf-8")
        paths += [csv, tex]
    page = folder / "index.html"
    page.write_text(html(tables), encoding="utf-8")
    return [*paths, page]


def print_tables(tables: Mapping[str, Table]) -> None:
    """Print the tables, those first that hold a value; those without one are only named."""
    filled = [t for t in tables.values() if _has_values(t)]
    for table in filled:
        click.echo(f"\n{table.text()}")
    empty = [t.name for t in tables.values() if not _has_values(t)]
    if empty:
        click.echo(f"\nwithout a value of ours: {', '.join(empty)}")
    click.echo("\nvalue (nIQR) [number of trials]; paper: the figures of Peiffer et al. as printed")


def latex(table: Table) -> str:
    """A `table` for the booktabs package: ours with n in square brackets, the paper's beside it where it has one."""
    with_paper = [any(table.cell(r, c).paper for r in table.rows) for c in table.columns]
    head, rules, second, at = [""], [], [""], 2
    for column, two in zip(table.columns, with_paper, strict=True):
        if two:
            head.append(rf"\multicolumn{{2}}{{c}}{{{tex_escape(column)}}}")
            rules.append(rf"\cmidrule(lr){{{at}-{at + 1}}}")
            second += ["ours", "paper"]
        else:
            head.append(tex_escape(column))
            second.append("ours")
        at += 2 if two else 1
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{tex_escape(_caption(table))}}}",
        rf"\label{{tab:pbl_{table.name}}}",
        rf"\begin{{tabular}}{{l{'r' * (at - 2)}}}",
        r"\toprule",
        " & ".join(head) + r" \\",
        *([" ".join(rules), " & ".join(second) + r" \\"] if any(with_paper) else []),
        r"\midrule",
    ]
    for row in table.rows:
        cells = [tex_escape(row)]
        for column, two in zip(table.columns, with_paper, strict=True):
            cells.append(f"{table.ours(row, column)} {{[{table.cell(row, column).n}]}}".strip())
            if two:
                cells.append(tex_escape(table.cell(row, column).paper))
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def html(tables: Mapping[str, Table]) -> str:
    """One page with all tables that asks for nothing from elsewhere. Every text is escaped."""
    return shipped_page("validation/templates/tables.html").render(
        tables=list(tables.values()),
        source=paper_figures()["source"],
        version=code_version(),
        has_values=_has_values,
    )


def _caption(table: Table) -> str:
    where = f" Paper: {table.where}." if table.where else ""
    return f"{table.title}. In square brackets: number of trials. {table.note}{where}"


def _has_values(table: Table) -> bool:
    return any(cell.n > 0 for cell in table.cells.values())
