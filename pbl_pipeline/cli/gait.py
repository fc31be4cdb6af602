"""`pbl gait`: all gait measures of a session."""

from __future__ import annotations

import functools
from pathlib import Path

import click

from pbl_pipeline.errors import PblError

from .options import COMPARE, MASS, show_changes

METHOD_HELP = "Event method, such as phase-transformer, zeni-2008 or oconnor-2007."
PERSON_HELP = "Person to measure of C3D files with several: the prefix of the points, the subject of the events."
_EPILOG = """\b
Example: pbl gait out/walk1.fit.npz out/walk2.fit.npz --out out/metrics.json
Example: pbl gait lab/walk1.c3d lab/walk2.c3d --out lab/metrics.json
Example: pbl gait opencap/walk1.mot --out opencap/metrics.json"""
_usage = functools.partial(PblError, "USAGE", next_step="see `pbl gait --help`")


@click.command(epilog=_EPILOG)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="metrics.json to write.")
@click.option(
    "--index",
    help="pbl-2025-three-angles (default of fits and motions), paper-2025, or gillette-2008 (nine angles; default of "
    "C3D files).",
)
@click.option("--norm", help="Normative set of the index: a name, or a .json file (`pbl norm list`).")
@click.option("--method", default="phase-transformer", show_default=True, help=METHOD_HELP)
@click.option(
    "--events",
    "event_files",
    multiple=True,
    type=click.Path(path_type=Path),
    help="events.csv of `pbl events` for C3D files or motions, once for each in their order (default: the labels in a "
    "C3D, else by --method).",
)
@click.option("--person", metavar="NAME", help=PERSON_HELP)
@click.option(
    "--accept-cadence",
    is_flag=True,
    help="Also measure recordings whose cadence is over 150 steps/min: you counted the steps.",
)
@COMPARE
@MASS
def gait(
    files: tuple[Path, ...],
    out: Path,
    index: str | None,
    norm: str | None,
    method: str,
    event_files: tuple[Path, ...],
    person: str | None,
    accept_cadence: bool,
    earlier: Path | None,
    mass_kg: float | None,
) -> None:
    """Events, cycles, spatiotemporal measures and GDI of one session.

    FILES are fits (fit.npz of `pbl fit`), a laboratory's recordings (C3D with the nine angles of Plug-in Gait), or
    OpenSim motions of other programs (.mot, .sto).
    Measures that cannot be trusted are null with a reason. The session.json of `pbl fit` next to a fit states whether
    it lies on the person: without it that is not known. If metrics.json is written to the folder of the fits, so are
    their events.csv and cycles.npz and the kinetics, which belong to it.
    """
    from pbl_pipeline import progress
    from pbl_pipeline.change import earlier_visit
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.gait import (
        EVENT_METHODS,
        GDI_METHODS,
        GILLETTE_MODEL,
        GaitParams,
        gait_metrics,
        read_lab_trial,
        read_motion_trial,
    )
    from pbl_pipeline.kinetics import METHODS as KINETICS_METHODS
    from pbl_pipeline.kinetics import visit_kinetics
    from pbl_pipeline.names import check_mass
    from pbl_pipeline.visit import load_kinetics, save_beside, save_kinetics, visit_of_fits

    check_out_file(out)
    check_mass(mass_kg)
    kinds = {"C3D files" if is_c3d(path) else "motions" if is_motion(path) else "fits" for path in files}
    if len(kinds) > 1:
        raise _usage(f"{' and '.join(sorted(kinds))} together", "one kind of file in a session")
    (kind,) = kinds
    if event_files and (kind == "fits" or len(event_files) != len(files)):
        found = f"{len(event_files)} --events for {len(files)} {kind}"
        raise _usage(found, "C3D files or motions, and one --events for each")
    if person is not None and kind != "C3D files":
        raise _usage(f"--person for {kind}", "C3D files")
    if earlier is not None and kind != "fits":
        raise _usage(f"--compare for {kind}", "fits")
    if index is None and kind == "C3D files":
        index = GILLETTE_MODEL
    visit = before = None
    params = GaitParams(events=EVENT_METHODS.find(method).paramset, gdi=GDI_METHODS.find(index).params)
    if kind != "fits":
        given = event_files or (None,) * len(files)
        pairs = progress.track(list(zip(files, given, strict=True)), "read files", unit="trial")
        read = functools.partial(read_lab_trial, person=person) if kind == "C3D files" else read_motion_trial
        metrics = gait_metrics([read(path, events, method) for path, events in pairs], norm, params, model=index)
    else:
        visit = visit_of_fits(files, measures=False)
        before = None if earlier is None else earlier_visit(earlier, out.parent, visit.subject, visit.height_m)
        fits = [r.fit for r in visit.fitted if r.fit is not None]
        of_fit = visit.fit_checks
        metrics = gait_metrics(fits, norm, params, of_fit, model=index, accept_cadence=accept_cadence)
        metrics = metrics.with_checks(of_fit)
        save_beside(metrics.trials, files, out)
        if all(path.resolve().parent == out.resolve().parent for path in files):
            known = load_kinetics(out.parent, [])
            mass = mass_kg if mass_kg is not None or known is None else known.mass_kg
            save_kinetics(visit_kinetics(fits, metrics.trials, KINETICS_METHODS.find(), mass_kg=mass), out.parent)
    metrics.save(out)
    click.echo(metrics.table())
    click.echo(f"written: {out}")
    if visit is not None and before is not None:
        show_changes(visit.with_measures(metrics), before, out)


def is_c3d(path: Path) -> bool:
    """True for the name of a laboratory's recording, possibly gzipped."""
    return path.name.lower().removesuffix(".gz").endswith(".c3d")


def is_motion(path: Path) -> bool:
    """True for the name of an OpenSim motion."""
    return path.suffix.lower() in (".mot", ".sto")
