"""`pbl validate`: errors of the fits against reference movements."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbl_pipeline.errors import PblError

if TYPE_CHECKING:
    import pandas as pd

#: Printed where no error was computed yet.
NOTHING = """\
No error of a fit against a reference is in the database yet. What to do:
  pbl validate add VIDEO --reference FILE    for each video that another instrument recorded as well
  pbl populate                               computes the errors of its fits
  pbl validate                               prints the tables
References are there and populate has run? Then pbl status lists what failed.
Without a database: pbl validate FIT.npz --reference FILE"""

_SHIFT = click.option(
    "--shift",
    "shift_s",
    type=float,
    default=0.0,
    show_default=True,
    metavar="SECONDS",
    help="Added to the reference's time stamps. They must be the video's within 0.1 s; that lag is found.",
)


class _WithDefault(click.Group):
    """A group whose command `tables` runs where none is named."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args or args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["tables", *args]
        return super().parse_args(ctx, args)


@click.group(cls=_WithDefault)
def validate() -> None:
    """Compare fits with reference movements and print the paper's tables, with the published figures for comparison.

    Without a command it is `tables`: everything in the database, or the FITS that are named.

    \b
    Example: pbl validate add walk1.mp4 --reference walk1.mot --dataset OURLAB
    Example: pbl populate && pbl validate --out accuracy
    Example: pbl validate walk1.fit.npz --reference walk1.mot
    """


@validate.command(epilog="Example: pbl validate --dataset OURLAB --where population=healthy --out accuracy")
@click.argument("fits", nargs=-1, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--reference",
    "references",
    multiple=True,
    type=click.Path(path_type=Path, readable=False),
    metavar="FILE",
    help="Reference of the FITS: once for all of them, or once for each, in their order.",
)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write CSV, LaTeX, HTML and curves there.")
@click.option("--dataset", metavar="NAME", help="Only this dataset; with FITS the name to report them under.")
@click.option(
    "--where", multiple=True, metavar="COLUMN=VALUE", help="Only these rows, such as population=healthy; repeatable."
)
@click.option("--source", help="Instrument of the references (with FITS), where the file does not say it.")
@_SHIFT
def tables(
    fits: tuple[Path, ...],
    references: tuple[Path, ...],
    out: Path | None,
    dataset: str | None,
    where: tuple[str, ...],
    source: str | None,
    shift_s: float,
) -> None:
    """Print the tables of errors: by dataset and camera, joint, population, activity and view.

    Without FITS: of all rows in the database whose fit and reference are current. With FITS (`fit.npz`): of these
    files, no database needed; references as in docs/files.md. A fit that cannot be compared is reported on stderr, the
    others are shown, and the exit code is 1.
    """
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.names import check_label

    for what, text in (("--dataset", dataset), ("--source", source)):
        check_label(what, text or "", 64)
    if out is not None:
        check_out_folder(out)
    refused: list[PblError] = []
    if fits:
        frame, refused = _of_files(fits, references, dataset or "files", source, shift_s)
    elif references or source or shift_s:
        raise click.UsageError("--reference, --source and --shift go with FITS; in the database: pbl validate add")
    else:
        import pbl_schemas
        from pbl_schemas.reading.frames import validation_frame

        pbl_schemas.activate(methods=False)
        frame = validation_frame()
    for error in refused:
        click.echo(error.text(), err=True)
    if not frame.empty:
        _show(frame, [*where, *([f"dataset={dataset}"] if dataset else [])], out, in_database=not fits)
    elif not fits:
        click.echo(NOTHING)
    if refused:
        raise click.exceptions.Exit(1)


def _show(frame: pd.DataFrame, where: Sequence[str], out: Path | None, in_database: bool) -> None:
    """Print the tables of the rows that `where` leaves, and write them where a folder is given."""
    from pbl_pipeline.validation import paper_tables, print_tables, save_curves

    chosen = select(frame, where)
    if chosen.empty:
        click.echo(f"None of {len(frame)} errors is left by --dataset and --where.")
        return
    made = paper_tables(chosen)
    print_tables(made)
    if out is None:
        return
    _write(out, made, errors=chosen)
    if in_database:
        from pbl_schemas.reading.frames import validation_curves

        curves = validation_curves(chosen)
        n = len(curves[["trial", "cycle"]].drop_duplicates())
        if n:
            save_curves(curves, out / "curves.npz")
        click.echo(f"{n} gait cycles of fit and reference in pairs" + (f": {out / 'curves.npz'}" if n else ""))


def _write(out: Path, made: dict[str, Any], **frames: pd.DataFrame | None) -> None:
    """Write tables, and the frames that they are made from as CSV files of these names (None: no such file)."""
    from pbl_pipeline.csv_cells import frame_to_csv
    from pbl_pipeline.validation import write_tables

    write_tables(made, out)
    known = {f"{name}.csv": frame for name, frame in frames.items() if frame is not None}
    for name, frame in known.items():
        (out / name).write_bytes(frame_to_csv(frame).encode())
    click.echo(f"tables, and what they are made from ({', '.join(known)}): {out}")


@validate.command(epilog="Example: pbl validate index --where method=paper-2025-v1 --out agreement")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write CSV, LaTeX and HTML there.")
@click.option(
    "--where", multiple=True, metavar="COLUMN=VALUE", help="Only these rows, such as method=paper-2025-v1; repeatable."
)
def index(out: Path | None, where: tuple[str, ...]) -> None:
    """Compare the index of one camera with that of several cameras, of visits that have both.

    Each is taken against a norm of the same kind: `pbl norm build NAME --kind single` and `--kind rig`, and both norms
    named when the visits are ingested. The published figure is printed for comparison.
    """
    import pbl_schemas
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.validation import index_agreement, index_pairs, print_tables
    from pbl_schemas.reading.frames import index_frame

    if out is not None:
        check_out_folder(out)
    pbl_schemas.activate(methods=False)
    pairs = index_pairs(select(index_frame(), where))
    if pairs.empty:
        click.echo("No visit has an index of one camera and one of several, each against a norm of the same kind.")
        click.echo("next: pbl norm build NAME --kind single, pbl norm build NAME --kind rig, then ingest with --norm")
        return
    made = {"index_agreement": index_agreement(pairs)}
    print_tables(made)
    if out is not None:
        _write(out, made, pairs=pairs)


@validate.command(
    epilog="\b\nExample: pbl validate bridge blazepose gauss-newton --keep bridge\n"
    "Example: pbl validate bridge of_0.2/blazepose-v7 blazepose\n"
    "Example: pbl validate bridge pbl-2025-three-angles-v7 pbl-2025-three-angles-v8 --tables"
)
@click.argument("old")
@click.argument("new", required=False)
@click.option("--tables", "in_tables", is_flag=True, help="Results in the tables by two methods, instead of refits.")
@click.option("--keep", type=click.Path(path_type=Path), metavar="DIR", help="Keep what is refitted, in DIR/METHOD.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write CSV, LaTeX and HTML there.")
def bridge(old: str, new: str | None, in_tables: bool, keep: Path | None, out: Path | None) -> None:
    """Shift of index and measures from OLD to NEW, with intervals, on the same recordings.

    Each is a method of the fit, the events or the index, by which a frozen set of ten synthetic walks is refitted, or a
    folder of visits: of `pbl run`, or what --keep wrote with another version of pbl. With OLD alone and --keep that set
    is only refitted. With --tables both are methods, and every visit that has results by both counts; the comparisons
    between visits that the change touches are listed.
    """
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.temporary import new_folder
    from pbl_pipeline.validation import bridge_pairs, bridge_table, print_tables

    if new is None and (keep is None or in_tables):
        raise click.UsageError("Missing argument 'NEW' (or --keep DIR, which refits by OLD alone).")
    if in_tables and keep is not None:
        raise click.UsageError("--keep with --tables: nothing is refitted")
    for folder in (keep, out):
        if folder is not None:
            check_out_folder(folder)
    comparisons = None
    if in_tables:
        import pbl_schemas
        from pbl_schemas.reading.comparison import values_by

        pbl_schemas.activate(methods=False)
        values, comparisons = values_by(old, str(new))
    else:
        with new_folder() as spare:
            values = [_bridge_values(name, keep or spare) for name in (old, new) if name is not None]
        if new is None:
            return
    pairs = bridge_pairs(values[0], values[1])
    made = {"bridge": bridge_table(pairs, (old, str(new)))}
    print_tables(made)
    if comparisons is not None:
        across: Any = comparisons[comparisons["what"] == "across"]
        click.echo(f"{len(across)} successive visits of a person are compared across the change and cannot be judged:")
        for row in across.head(20).to_dict("records"):
            click.echo(f"  {row['subject']}: {row['before']} by {old}, {row['visit']} by {new}, or the other way round")
        click.echo(f"{(comparisons['what'] == 'old').sum()} more have only {old} in common (pbl reprocess adds {new})")
    if out is not None:
        _write(out, made, pairs=pairs, comparisons=comparisons)


def _bridge_values(name: str, keep: Path) -> pd.DataFrame:
    """Values of a folder, or of the frozen set refitted by a method into a folder below `keep`."""
    from pbl_pipeline import progress
    from pbl_pipeline.validation import folder_values, refit_bridge_set
    from pbl_pipeline.validation.bridge import BRIDGE_SET

    folder = Path(name)
    if not folder.is_dir():
        folder = keep / name
        with progress.bar(name, len(BRIDGE_SET), "walk") as update:
            refit_bridge_set(name, folder, update)
    return folder_values(folder)


@validate.command()
@click.argument("video")
@click.option(
    "--reference",
    type=click.Path(path_type=Path, readable=False),
    metavar="FILE",
    help="Reference movement: .npz, fit.npz, truth.npz, .json.gz, .mot or .sto.",
)
@click.option(
    "--of-trial",
    type=int,
    metavar="VIDEO_ID",
    help="Instead of a file: the current fit of a trial of several cameras, or of a marker recording, in the tables.",
)
@click.option("--fit-method", metavar="KEY", help="With --of-trial, where that was fitted by several methods.")
@click.option("--dataset", metavar="NAME", help="Collection of recordings to report it with (else: unnamed).")
@click.option("--source", metavar="TEXT", help="Instrument, such as 'optical markers' (default: what the file states).")
@click.option("--origin", metavar="TEXT", help="Where the file comes from (else: its path).")
@_SHIFT
def add(
    video: str,
    reference: Path | None,
    of_trial: int | None,
    fit_method: str | None,
    dataset: str | None,
    source: str | None,
    origin: str | None,
    shift_s: float,
) -> None:
    """Register the reference movement of VIDEO (number, path or file name of a registered video).

    `pbl populate` then computes the errors of its fits. The same file is registered once; another file of the same
    source takes its place. Population, activity and camera are those of the video (`pbl ingest`).

    \b
    Example: pbl validate add 3 --reference walk1_mocap.mot --dataset OURLAB
    Example: pbl validate add 3 --of-trial 4 --dataset OURLAB
    """
    import pbl_schemas
    from pbl_schemas.intake.references import add_reference, add_trial

    if (reference is None) == (of_trial is None):
        raise click.UsageError("Name one reference: --reference FILE or --of-trial VIDEO_ID.")
    if of_trial is None and fit_method is not None:
        raise click.UsageError("--fit-method goes with --of-trial.")
    if of_trial is not None and source is not None:
        raise click.UsageError("--source goes with --reference: the tables know what a trial was recorded with.")
    pbl_schemas.activate()
    if reference is not None:
        done = add_reference(video, reference, dataset, source, origin, shift_s)
    else:
        assert of_trial is not None
        done = add_trial(video, of_trial, dataset, origin, shift_s, fit_method)
    click.echo(f"video_id {done.video_id}: reference {done.reference} {done.status} ({done.note})")
    if done.status in ("registered", "replaced"):
        click.echo("next: pbl populate")


def _of_files(
    fits: Sequence[Path], references: Sequence[Path], dataset: str, source: str | None, shift_s: float
) -> tuple[pd.DataFrame, list[PblError]]:
    """Return the errors of fits in files, by the library alone, and the refusals."""
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.validation import TrialErrors, compare, error_frame
    from pbl_schemas.intake.references import read_reference

    if len(references) not in (1, len(fits)):
        raise click.UsageError(f"{len(references)} of --reference for {len(fits)} FITS: one for all, or one for each")
    rows, refused = [], []
    of_each = [references[0]] * len(fits) if len(references) == 1 else references
    for path, truth in zip(fits, of_each, strict=True):
        try:
            fit = TrialFit.load(path)
            reference = read_reference(truth, source, shift_s)
            errors = compare(fit, reference)
        except PblError as error:
            refused.append(error)
            continue
        for note in reference.notes:
            click.echo(f"{truth}: {note}", err=True)
        rows.append(
            TrialErrors(
                errors=errors,
                dataset=dataset,
                subject="",
                population="unknown",
                activity="unknown",
                camera=fit.camera_motion,
                trial=fit.name,
                detector=fit.marker_set,
                solver=fit.solver,
            )
        )
    return error_frame(rows), refused


def select(frame: pd.DataFrame, where: Sequence[str]) -> pd.DataFrame:
    """Rows of the frame in which every `COLUMN=VALUE` holds. Raises USAGE for an unknown column or another form."""
    for condition in where:
        column, equals, value = condition.partition("=")
        if not equals or column not in frame.columns:
            raise PblError(
                "USAGE",
                found=f"--where {condition}",
                expected="COLUMN=VALUE with one of " + ", ".join(map(str, frame.columns)),
                next_step="name one of these columns",
            )
        frame = frame.loc[frame[column].astype(str) == value]
    return frame
