"""`pbl study`: studies of visits and clinical scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._main import Commands


class _StudyCommands(Commands):
    entries = "pbl.study"


@click.group(cls=_StudyCommands, epilog="Example: pbl study check spine2026")
def study() -> None:
    """Studies of visits and clinical scores (docs/study.md)."""


@study.command(epilog="Example: pbl study check spine2026")
@click.argument("folder", type=click.Path(path_type=Path))
def check(folder: Path) -> None:
    """Read the FOLDER of a study and refuse what is damaged or contradictory."""
    from pbl_pipeline.study import content_hash, read_study

    data = read_study(folder)
    counted: Any = data.visits[data.visits["included"]]
    click.echo(
        f"{data.n_subjects} persons, {data.n_visits} visits; {counted['subject'].nunique()} persons and {len(counted)} "
        f"visits count; {data.measures['measure'].nunique()} measures, {data.scores['instrument'].nunique()} scores, "
        f"curves of {data.curves['variable'].nunique()} angles, {len(data.cycles)} values of cycles"
    )
    click.echo(f"slice {data.description.name or '-'} {data.description.hash or '-'}, content {content_hash(data)}")
