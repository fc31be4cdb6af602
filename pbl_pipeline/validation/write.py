"""Tables as CSV, LaTeX and one HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import click
import jinja2

from pbl_pipeline.code_version import code_version
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.latex import tex_escape

from .paper import paper_figures
from .table import Table


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
