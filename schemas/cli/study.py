"""`pbl study import|slice|...`: what of a study needs the tables."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(
    "import",
    epilog="\b\nExample: pbl study import visits.csv scores.csv --dry-run\nExample: pbl study import study.xlsx",
)
@click.argument("sheets", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--dry-run", is_flag=True, help="Change nothing; say row by row what would happen.")
@click.option("--distinct-codes", is_flag=True, help="Codes such as P1 and P001 are different people.")
def import_(sheets: tuple[Path, ...], dry_run: bool, distinct_codes: bool) -> None:
    """Visits, clinical scores, cohorts, and activity and pace of videos from SHEETS (.csv, .xlsx).

    docs/files.md lists the columns. Rows that are stored already change nothing. Either all rows of all sheets are
    imported or none: exit code 1 where one is refused.
    """
    import schemas
    from schemas.study_import import import_sheets

    schemas.activate()
    found = import_sheets(sheets, dry_run, distinct_codes)
    changed = [line for line in found.lines if line.changes]
    for line in changed:
        click.echo(f"{line.where}: {'; '.join(line.changes)}")
    for error in found.errors:
        click.echo(error.text(), err=True)
    same = sum(not line.changes and not line.errors for line in found.lines)
    wrong = sum(bool(line.errors) for line in found.lines)
    word = "imported" if found.done else "would be imported" if dry_run else "not imported"
    click.echo(f"{len(changed)} rows {word}, {same} unchanged, {wrong} refused")
    if wrong:
        raise click.exceptions.Exit(1)
