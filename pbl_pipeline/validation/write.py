"""Tables as CSV, LaTeX and one HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import click
import jinja2
import numpy as np
import pandas as pd

from pbl_pipeline.code_version import code_version
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.errors import PblError
from pbl_pipeline.latex import tex_escape
from pbl_pipeline.stats import bland_altman, correlation

from .table import Cell, Table, paper_cells, paper_figures

#: Columns of the indices: of a visit by one kind of recordings (`kind`: single, rig, markers) against a norm that was
#: built from cycles of `norm_kind`; "" for one that ships.
INDEX_COLUMNS = ("subject", "session_label", "session_id", "kind", "method", "norm", "norm_kind", "index")
#: Columns of the pairs: the index of one camera and of several, of one visit.
PAIR_COLUMNS = ("subject", "session_label", "single", "rig", "single_norm", "rig_norm")
_ROW = "GDI of one camera against several"


def index_pairs(indices: pd.DataFrame) -> pd.DataFrame:
    """Visits that have an index of one camera and one of several, each against a norm of its own kind, as pairs.

    Raises `PblError` USAGE: a visit has several such indices of one kind, by several methods or norms.

    Parameters
    ----------
    indices
        Rows with `INDEX_COLUMNS`. An index against a norm of another kind, or against one that ships, does not count.
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
    return kinds[0].merge(kinds[1], on=columns[:3])[list(PAIR_COLUMNS)]


def index_agreement(pairs: pd.DataFrame) -> Table:
    """Pearson's r, bias and limits of agreement of the index of one camera and of several.

    Raises `PblError` STATS_INPUT: fewer than four visits, or indices that are all the same.
    """
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
    persons = pairs["subject"].nunique()
    norms = [", ".join(sorted(set(pairs[f"{k}_norm"]))) for k in ("single", "rig")]
    return Table(
        "index_agreement",
        "Index of one camera against several, each with a norm of its own kind",
        {(_ROW, column): cell for column, cell in values.items()},
        f"{n} visits of {persons} persons. Norms: {norms[0]} (one camera), {norms[1]} (several). Bias: one camera "
        "minus several; limits of agreement hold 95 % of the visits. r with its 95 % interval, which is too narrow "
        "where a person has several visits.",
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
    folder = resources.files("pbl_pipeline.validation").joinpath("templates")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string(folder.joinpath("tables.html").read_text(encoding="utf-8"))
    return template.render(
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
