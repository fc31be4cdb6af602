"""`pbl export`: fits in the formats of other programs, from files or from the tables."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.errors import PblError

from ._kind import kind_option

if TYPE_CHECKING:
    from pbl_pipeline.export import ExportOptions
    from pbl_pipeline.visit import Visit

_EPILOG = """\b
Example: pbl export walk1.fit.npz walk2.fit.npz --to osim --to trc --to mot --out for_opensim
Example: pbl export --subject P017 --session 2026-03-01 --to c3d --to parquet --out P017
Example: pbl export --slice paper --to parquet --out paper_visits"""
_usage = functools.partial(PblError, "USAGE", next_step="see `pbl export --help`")


@click.command(epilog=_EPILOG)
@click.argument("files", nargs=-1, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--to",
    "formats",
    multiple=True,
    required=True,
    metavar="FORMAT",
    help="trc, mot, forces, osim, c3d, dlc, csv, parquet or bids; once for each.",
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder; one below it for each trial.")
@click.option("--subject", help="Code of the subject: from the tables instead of FILES.")
@click.option("--session", "session_label", help="Date or label of the visit; needed where the subject has several.")
@click.option("--all", "every", is_flag=True, help="All fitted visits of the tables, or all of --subject.")
@click.option("--slice", "slice_name", help="The visits that count in this slice (`pbl study slice`).")
@click.option("--fit-method", help="Name of the fit method; needed where several were used.")
@kind_option
@click.option(
    "--attitude",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Sensor log of the phone, once for each of FILES: its sensors become analog channels of the C3D.",
)
@click.option("--marker-set", type=click.Path(path_type=Path), help="Table (CSV) that FILES were fitted with.")
@click.option("--name", default="", help="Name of the person or trial for the headers; without it they are anonymous.")
@click.option("--names", default="", metavar="plug-in-gait", help="Plug-in Gait's markers and angles in the C3D.")
@click.option("--number-trials", is_flag=True, help="trial_1, trial_2, ... instead of the recordings' names.")
@click.option("--markers-only", is_flag=True, help="No further points on each body in .trc and .osim.")
@click.option("--allow-failed", is_flag=True, help="Export a fit that failed a check; the files say so.")
@click.option("--overwrite", is_flag=True, help="Write into a folder that has files; those of the same name go.")
def export(
    files: tuple[Path, ...],
    formats: tuple[str, ...],
    out: Path,
    every: bool,
    slice_name: str | None,
    attitude: tuple[Path, ...],
    marker_set: Path | None,
    name: str,
    names: str,
    number_trials: bool,
    markers_only: bool,
    allow_failed: bool,
    overwrite: bool,
    **named: str | None,
) -> None:
    """Write the trials of one visit, or of many, for OpenSim, Visual3D, Mokka, R, pandas, movement or as Motion-BIDS.

    FILES are fits (fit.npz) of `pbl fit` or `pbl run`, with their keypoints.npz and session.json beside them. Axes,
    units and signs of each format: docs/export.md. c3d and parquet need the extra `export`. With --all and --slice each
    visit has a folder OUT/SUBJECT/SESSION; one that cannot be exported is named, the others are written, and the exit
    status is 1.
    """
    from pbl_pipeline.export import GAIT_FORMATS, ExportOptions, check_export, write_export

    many = every or slice_name is not None
    if not files and named["subject"] is None and not many:
        raise _usage("neither FILES nor --subject, --all or --slice", "one of them")
    if files and (any(named.values()) or many):
        raise _usage("FILES with an option that picks visits of the tables", "FILES, or visits of the tables")
    if slice_name is not None and (every or any(named.values())):
        raise _usage("--slice with --all, --subject, --session, --fit-method or --kind", "--slice alone: it names them")
    if every and named["session_label"]:
        raise _usage("--all with --session", "one of them")
    if not files and (attitude or marker_set):
        raise _usage("--attitude or --marker-set without FILES", "them with FILES: the tables have the log")
    options = ExportOptions(name, number_trials, not markers_only, allow_failed, overwrite, names)
    check_export(formats, out, options)
    wanted = {column: value for column, value in named.items() if value is not None}
    if many:
        _write_many(wanted, slice_name, formats, out, options)
        return
    if files:
        visit = _of_files(files, formats, attitude, marker_set)
    else:
        import pbl_schemas
        from pbl_schemas.reading import fitted_visit

        pbl_schemas.activate(methods=False)
        visit = fitted_visit(wanted, gait=bool(GAIT_FORMATS & set(formats)))
    for path in write_export(visit, formats, out, options):
        click.echo(path)


def _of_files(
    files: tuple[Path, ...], formats: tuple[str, ...], attitude: tuple[Path, ...], marker_set: Path | None
) -> Visit:
    from pbl_pipeline.body import load_marker_set
    from pbl_pipeline.export import GAIT_FORMATS
    from pbl_pipeline.pipeline import measured
    from pbl_pipeline.visit import visit_of_fits

    markers = None if marker_set is None else load_marker_set(marker_set)
    gait = bool(GAIT_FORMATS & set(formats))
    visit = visit_of_fits(files, markers=markers, measures=gait).with_logs(attitude)
    unmeasured = [r.name for r in visit.fitted if r.measured is None] if gait else []
    if len(unmeasured) == len(visit.fitted):
        return measured(visit) if unmeasured else visit
    if unmeasured:
        raise PblError(
            "EXPORT_INPUT",
            found=f"no measures of {', '.join(unmeasured)} beside fits that have some",
            expected="fits that were all measured, by methods that their files name, or none",
            next_step="`pbl gait *.fit.npz --out metrics.json` in the folder of these fits, then export again",
        )
    return visit


def _write_many(
    wanted: dict[str, str], slice_name: str | None, formats: tuple[str, ...], out: Path, options: ExportOptions
) -> None:
    """Each visit into its folder; those that cannot be exported are named at the end of their line."""
    import pbl_schemas
    from pbl_pipeline import progress
    from pbl_pipeline.export import GAIT_FORMATS, Labels, write_export
    from pbl_pipeline.files import check_no_link
    from pbl_schemas.reading import list_fitted, load_visits
    from pbl_schemas.studies.slices import changes

    pbl_schemas.activate(methods=False)
    visits = list_fitted(wanted, slice_name)
    for text in [] if slice_name is None else changes(slice_name):
        click.echo(f"changed since it was frozen: {text}", err=True)
    gait = bool(GAIT_FORMATS & set(formats))
    refused = 0
    with progress.bar("export", len(visits), "visit") as update:
        for row, visit in load_visits(visits, measures=gait):
            try:
                if isinstance(visit, PblError):
                    raise visit
                labels = Labels.of(row["subject"], row["session_label"])
                check_no_link(out, out / row["folder"])
                own = dataclasses.replace(options, bids=(out / "bids", labels))
                write_export(visit, formats, out / row["folder"], own)
            except PblError as error:
                refused += 1
                click.echo(f"{row['folder']}: {error.code}: {error.found}. Next: {error.next_step}", err=True)
            update()
    click.echo(f"{len(visits) - refused} of {len(visits)} visits in {out}")
    if refused:
        raise click.exceptions.Exit(1)
