"""`pbl camera`: calibrations for every video of a phone."""

from __future__ import annotations

from pathlib import Path

import click


@click.group(epilog="Example: pbl camera add camera.json")
def camera() -> None:
    """Calibrations that serve every video of a phone's lens (docs/camera.md): add, list, remove.

    A video takes the calibration that was ingested with it (`pbl ingest --camera`); else the one that is registered
    here for its phone's make, model and lens, the size and the rate of its frames; else the file's metadata.
    """


@camera.command(epilog="Example: pbl camera add camera.json && pbl populate")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--like",
    type=click.Path(path_type=Path),
    metavar="VIDEO",
    help="An original recording of the phone, where FILE does not name it (not of `pbl calibrate`).",
)
def add(file: Path, like: Path | None) -> None:
    """Register the calibration in FILE, in the place of an older one of the same lens, size and rate.

    Results of another calibration than now counts are deleted and listed; `pbl populate` recomputes them.
    """
    import pbl_schemas
    from pbl_schemas.intake import calibrations as cameras

    pbl_schemas.activate(methods=False)
    _say(cameras.add_calibration(file, like))


@camera.command("list", epilog="Example: pbl camera list")
def list_() -> None:
    """The registered calibrations: number, phone, focal length and how many keypoints were made with each."""
    import pbl_schemas
    from pbl_schemas.intake import calibrations as cameras

    pbl_schemas.activate(methods=False)
    rows = cameras.calibrations()
    for row in rows:
        focal, sd = (row["camera_fx"] + row["camera_fy"]) / 2, row["camera_focal_sd"]
        click.echo(f"{row['camera_id']:>4}  {row['device']}: {row['lens'].text()}")
        spread = "" if sd is None else f" +- {sd:.1f}"
        click.echo(f"      focal length {focal:.1f} px{spread}; {row['camera_note']}")
        click.echo(f"      {row['device_calibrated']} UTC; keypoints made with it: {row['n_keypoints']}")
    if not rows:
        click.echo("no calibration of a phone is registered; `pbl calibrate` measures one, `pbl camera add` registers")


@camera.command(epilog="Example: pbl camera remove 3")
@click.argument("camera_id", metavar="NUMBER", type=int)
def remove(camera_id: int) -> None:
    """Withdraw calibration NUMBER of `pbl camera list` from the phones that have it.

    Its results are deleted and listed. Videos that were ingested with it keep it.
    """
    import pbl_schemas
    from pbl_schemas.intake import calibrations as cameras

    pbl_schemas.activate(methods=False)
    for change in cameras.remove_calibration(camera_id):
        _say(change)


def _say(change) -> None:
    before = "" if change.before in (None, change.camera_id) else f", in the place of {change.before}"
    what = f"has calibration {change.camera_id} now{before}" if change.camera_id else "has no calibration now"
    click.echo(f"{change.device} {what}")
    for name, n in change.deleted.items():
        click.echo(f"  deleted {n} rows of {name}")
    if change.deleted:
        click.echo("next: pbl populate")
