"""`pbl study`: studies of visits and clinical scores."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from .command_line import Commands


class _StudyCommands(Commands):
    entries = "pbl.study"


@click.group(cls=_StudyCommands, epilog="Example: pbl study check spine2026")
def study() -> None:
    """Studies of visits and clinical scores (docs/study.md)."""


@study.command(epilog="Example: pbl study check spine2026")
@click.argument("folder", type=click.Path(path_type=Path))
def check(folder: Path) -> None:
    """Read the FOLDER of a study and check that it is complete and consistent."""
    from pbl_pipeline.study import content_hash, read_study

    data = read_study(folder)
    counted: Any = data.visits[data.visits["included"]]
    click.echo(
        f"{data.n_subjects} persons, {data.n_visits} visits; {counted['subject'].nunique()} persons and {len(counted)} "
        f"visits count; {data.measures['measure'].nunique()} measures, {data.scores['instrument'].nunique()} scores, "
        f"curves of {data.curves['variable'].nunique()} angles, {len(data.cycles)} values of cycles"
    )
    click.echo(f"slice {data.description.name or '-'} {data.description.hash or '-'}, content {content_hash(data)}")


@study.command(
    epilog="\b\nExample: pbl study report spine2026 --out spine2026_report\n"
    "Example: pbl study report --slice spine2026 --out spine2026_report"
)
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--slice", "name", metavar="NAME", help="A slice of the tables (`pbl study slice`) instead of FOLDER.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for report.html, figures, tables.")
@click.option(
    "--from", "change_from", default="", metavar="ROLE", help="Change from this visit (default: the study's)."
)
@click.option("--to", "change_to", default="", metavar="ROLE", help="Last visit of the change.")
@click.option("--group", default="", metavar="GROUP", help="Group whose change is assessed.")
def report(folder: Path | None, name: str | None, out: Path, change_from: str, change_to: str, group: str) -> None:
    """Write the report of a FOLDER or slice: participants, repeatability, correlation with scores, change, curves.

    Figures are written as SVG and PDF, tables as CSV and LaTeX. Statistics that the values do not support are replaced
    by a code with its reason.
    """
    from pbl_pipeline.study import read_study
    from pbl_pipeline.study_report import write_study_report

    if (folder is None) == (name is None):
        raise click.UsageError("the FOLDER of a study, or --slice NAME")
    data = read_study(folder) if folder is not None else _of_slice(name or "")
    paths = write_study_report(data, out, change_from, change_to, group)
    click.echo(f"written: {paths[0]}, {len(paths) - 1} figures and tables")


def _of_slice(name: str) -> Any:
    """Load the `StudyData` of a slice through the entry point `slice` of `pbl.study_data`, registered by the tables."""
    found = [e for e in entry_points(group="pbl.study_data") if e.name == "slice"]
    if not found:
        raise click.UsageError("--slice needs the tables, which are not installed")
    return found[0].load()(name)
