"""`pbl fit`: keypoints of one session to joint angles."""

from __future__ import annotations

from pathlib import Path

import click

from ._options import fit_paramset


@click.command(epilog="Example: pbl fit walk1.keypoints.npz walk2.keypoints.npz --out results")
@click.argument("keypoints", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the results.")
@click.option("--solver", default="implicit-adam", show_default=True, help="Name of the solver.")
@click.option("--params", help="Name of a paramset, or a JSON file with changes to the default one.")
@click.option("--camera-motion", type=click.Choice(["static", "handheld"]), default="static", show_default=True)
def fit(keypoints: tuple[Path, ...], out: Path, solver: str, params: str | None, camera_motion: str) -> None:
    """Fit one body to the KEYPOINTS files, the trials of one session.

    Writes <name>.fit.npz and <name>.angles.csv for each trial, and session.json.
    """
    from pbl_pipeline.export import write_angles_csv
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.fit import fit_session
    from pbl_pipeline.keypoints import Keypoints
    from pbl_pipeline.pipeline import distinct_names, write_session_json

    check_out_folder(out)
    paramset = fit_paramset(solver, params)
    trials = [Keypoints.load(path) for path in keypoints]
    names = distinct_names([Path(p.name.removesuffix(".npz").removesuffix(".keypoints")) for p in keypoints])
    session = fit_session(trials, names, paramset, camera_motion)
    out.mkdir(parents=True, exist_ok=True)
    for trial in session.trials:
        trial.save(out / f"{trial.name}.fit.npz")
        write_angles_csv(trial, out / f"{trial.name}.angles.csv")
        click.echo(f"{out / trial.name}.fit.npz, .angles.csv")
    write_session_json(session, out / "session.json")
    click.echo(f"{out / 'session.json'}: {session.seconds:.0f} s, of which {session.compile_seconds:.0f} s compiling")
    for check in session.qc:
        if check.outcome != "PASS":
            click.echo(f"{check.outcome} {check.check}: {check.advice}")
