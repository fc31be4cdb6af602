"""`pbl study import|slice|...`: commands of a study that need the tables."""

from __future__ import annotations

import getpass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ._kind import kind_option

if TYPE_CHECKING:
    from pbl_pipeline.study import StudyData


@click.command(
    "import",
    epilog="\b\nExample: pbl study import --template visits.xlsx\n"
    "Example: pbl study import visits.csv scores.csv --dry-run\nExample: pbl study import study.xlsx",
)
@click.argument("sheets", nargs=-1, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--template",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write an empty sheet (.csv, .xlsx) of visits with all its columns and scores; nothing else is done.",
)
@click.option("--dry-run", is_flag=True, help="Change nothing; print the outcome row by row.")
@click.option("--distinct-codes", is_flag=True, help="Codes such as P1 and P001 are different people.")
def import_(sheets: tuple[Path, ...], template: Path | None, dry_run: bool, distinct_codes: bool) -> None:
    """Visits, clinical scores, cohorts, and activity and pace of videos from SHEETS (.csv, .xlsx).

    docs/files.md lists the columns. Rows that are stored already change nothing. Either all rows of all sheets are
    imported or none: exit code 1 where one is refused.
    """
    import pbl_schemas
    from pbl_schemas import study
    from pbl_schemas.intake.sheets import write_template
    from pbl_schemas.studies.study_sheets import COLUMNS, import_sheets

    if not sheets and template is None:
        raise click.UsageError("Missing argument 'SHEETS...' (or --template FILE).")
    pbl_schemas.activate()
    if template is not None:
        instruments = map(str, study.ClinicalInstrument().to_arrays("instrument"))
        write_template(template, (*COLUMNS, *instruments))
        click.echo(f"written: {template}; remove the columns that you do not need (docs/files.md)")
        return
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


@click.command(
    "slice",
    epilog="\b\nExample: pbl study slice spine2026 --cohort dcm --role pre --role 6_weeks --dry-run\n"
    "Example: pbl study slice spine2026 --cohort dcm --role pre --role 6_weeks --event surgery\n"
    "Example: pbl study slice spine2026",
)
@click.argument("name", required=False)
@click.option("--cohort", metavar="NAME", help="Visits of the people of this cohort (else: of all).")
@click.option("--role", "roles", multiple=True, help="Visits of this role; repeat for several (else: all).")
@click.option("--all", "every", is_flag=True, help="Visits of all people and roles.")
@click.option("--dry-run", is_flag=True, help="Freeze nothing; print the visits, and why others do not count.")
@click.option("--withdraw", is_flag=True, help="Delete the slice, as long as nothing refers to it.")
@click.option("--event", default="", help="What the days of the visits count from, such as surgery.")
@click.option("--note", default="", help="Shown on the report.")
@kind_option
@click.option("--keypoints", "keypoint_method", help="Keypoint method, where the tables hold several.")
@click.option("--fit", "fit_method", help="Fit method, where the tables hold several.")
@click.option("--gait", "gait_method", help="Event method, where the tables hold several.")
@click.option("--index", "gdi_method", help="Method of the index, where the tables hold several.")
@click.option("--norm", help="Normative set, where the tables hold several.")
def slice_(
    name: str | None,
    cohort: str | None,
    roles: tuple[str, ...],
    every: bool,
    dry_run: bool,
    withdraw: bool,
    event: str,
    note: str,
    **methods: str,
) -> None:
    """Freeze visits and methods under NAME; with NAME alone print what changed since. Without NAME list all.

    Methods are named by their key, such as blazepose-v5, or short, such as blazepose: the newest version with results.
    """
    import pbl_schemas
    from pbl_pipeline.texts import code_of
    from pbl_schemas import study
    from pbl_schemas.studies import slices

    pbl_schemas.activate()
    if name is None:
        for row in study.StudySlice().to_dicts(order_by="slice_created"):
            cohort_name = row["cohort"] or "everybody"
            click.echo(f"{row['study_slice']:<32} {row['slice_hash']}  {row['slice_n']} visits of {cohort_name}")
        return
    if every and (cohort or roles):
        raise click.UsageError("--all and --cohort or --role: choose one.")
    if withdraw:
        slices.withdraw(name, getpass.getuser())
        click.echo(f"{name}: withdrawn")
        return
    wanted = {k: v for k, v in methods.items() if v}
    if not (cohort or roles or every or dry_run or event or note or wanted):
        changed = slices.changes(name)
        for text in changed:
            click.echo(text)
        click.echo(f"{name}: {'not ' if changed else ''}as it was frozen")
        if changed:
            raise click.exceptions.Exit(1)
        return
    made = slices.freeze(name, cohort, [code_of("role", r) for r in roles], wanted, event, note, dry_run)
    for subject, visit, reason in made.visits if dry_run else ():
        click.echo(f"{subject} {visit}: {f'does not count: {reason}' if reason else 'counts'}")
    done = "would be frozen: " if dry_run else ""
    click.echo(f"{made.name}: {done}{made.n} visits, {made.n_included} count, hash {made.hash}")


@click.command(epilog="Example: pbl study export --slice spine2026 --out spine2026 --key spine2026_key.csv")
@click.option("--slice", "name", required=True, metavar="NAME", help="A slice (`pbl study slice`).")
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="DIR", help="Folder to write.")
@click.option(
    "--key", type=click.Path(path_type=Path), metavar="FILE", help="Where to keep which code became which; apart."
)
@click.option("--keep-codes", is_flag=True, help="The codes of persons and visits as they are here.")
@click.option("--no-curves", is_flag=True, help="Without the mean curves, whose files take the longest to read.")
def export(name: str, out: Path, key: Path | None, keep_codes: bool, no_curves: bool) -> None:
    """The rows and curves of a slice as a folder of CSV files with new codes for persons and visits (docs/study.md).

    `pbl study report DIR` makes figures and tables of it, without a database.
    """
    from pbl_pipeline.csv_cells import frame_to_csv
    from pbl_pipeline.errors import os_errors_as
    from pbl_pipeline.study import deidentified, write_study
    from pbl_schemas.operations.folders import write_text

    data = load_slice(name, curves=not no_curves)
    if not keep_codes:
        data, codes = deidentified(data)
        if key is not None:
            with os_errors_as("FILE_UNWRITABLE", "a file for the key to the codes", "pass another --key", key):
                write_text(key, frame_to_csv(codes))
    paths = write_study(data, out)
    click.echo(f"{data.n_subjects} persons, {data.n_visits} visits: {len(paths)} files in {out}")


@click.group()
def instrument() -> None:
    """Custom clinical scores, in addition to those that ship."""


@instrument.command(
    epilog="Example: pbl study instrument add FAC --title 'Functional Ambulation Categories' --unit points --low 0 "
    "--high 5 --better higher --ordinal"
)
@click.argument("name")
@click.option("--title", "instrument_name", required=True, metavar="TEXT", help="Full name.")
@click.option(
    "--unit",
    "instrument_unit",
    required=True,
    metavar="UNIT",
    help="Of its values; an ordinal score in points is whole.",
)
@click.option("--low", "instrument_low", default="", metavar="VALUE", help="A lower value is refused.")
@click.option("--high", "instrument_high", default="", metavar="VALUE", help="A higher value is refused.")
@click.option("--source", "instrument_source", default="", metavar="TEXT", help="Source of the scale.")
@click.option("--better", type=click.Choice(["higher", "lower"]), required=True, help="Which values are better.")
@click.option("--ordinal", is_flag=True, help="Its values are ranks.")
@click.option("--minimal-change", default="", metavar="VALUE", help="Minimal important change.")
@click.option(
    "--change-source",
    "minimal_change_source",
    default="",
    metavar="TEXT",
    help="Who found the minimal important change, in whom.",
)
def add(name: str, better: str, ordinal: bool, **stated: str) -> None:
    """Add the instrument NAME, which is then a column of sheets and a field of the web page."""
    import pbl_schemas
    from pbl_schemas.studies.study_sheets import add_instrument

    values = stated | {"higher_is_better": "yes" if better == "higher" else "no", "ordinal": "yes" if ordinal else "no"}
    pbl_schemas.activate()
    errors = add_instrument({"instrument": name, **values}, getpass.getuser())
    for error in errors.values():
        click.echo(error.text(), err=True)
    if errors:
        raise click.exceptions.Exit(1)
    click.echo(f"{name}: added")


def load_slice(name: str, curves: bool = True) -> StudyData:
    """Return the `StudyData` of a slice, also for `pbl study report --slice` (entry point `pbl.study_data`); what
    changed since it was frozen is printed on stderr. Raises as `slices.study_data`."""
    import pbl_schemas
    from pbl_schemas.studies import slices

    pbl_schemas.activate(methods=False)
    data = slices.study_data(name, curves)
    for text in slices.changes(name):
        click.echo(f"changed since it was frozen: {text}", err=True)
    return data
