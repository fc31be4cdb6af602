"""`pbl gait`: all gait measures of a session."""

from __future__ import annotations

from pathlib import Path

import click

_EPILOG = "Example: pbl gait out/walk1.fit.npz out/walk2.fit.npz --out out/metrics.json"


@click.command(epilog=_EPILOG)
@click.argument("fits", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="metrics.json to write.")
@click.option("--norm", help="Normative set of the index: a name, or a .json file of build_norm.")
@click.option("--method", default="zeni-2008", show_default=True, help="Name of the event method.")
def gait(fits: tuple[Path, ...], out: Path, norm: str | None, method: str) -> None:
    """Events, cycles, spatiotemporal measures and GDI of the trials FITS of one session.

    Measures that cannot be trusted are null with a reason.
    """
    from pbl_pipeline import progress
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.gait import EventParams, GaitParams, gait_metrics
    from pbl_pipeline.gait.events import resolve_params

    check_out_file(out)
    params = GaitParams(events=EventParams(**resolve_params(method).params))
    trials = [TrialFit.load(path) for path in progress.track(fits, "read fits", unit="trial")]
    metrics = gait_metrics(trials, norm, params)
    metrics.save(out)
    click.echo(metrics.table())
    click.echo(f"written: {out}")
