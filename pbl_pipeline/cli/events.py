"""`pbl events`: initial contacts and toe-offs of one file."""

from __future__ import annotations

import functools
from pathlib import Path

import click

from pbl_pipeline.errors import PblError

from .gait import METHOD_HELP, PERSON_HELP, is_c3d, is_motion

_EPILOG = """\b
Example: pbl events walk.fit.npz --out walk.events.csv
Example: pbl events walk.c3d --out walk.events.csv"""
_format_error = functools.partial(
    PblError,
    "FILE_FORMAT",
    expected="a fit.npz (qpos), a keypoints.npz (xyz_cam_m or xyz_world_m), a C3D, or a .mot",
    next_step="make one with `pbl detect` or `pbl fit`",
)


@click.command(epilog=_EPILOG)
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="events.csv to write.")
@click.option("--method", default="phase-transformer", show_default=True, help=METHOD_HELP)
@click.option("--person", metavar="NAME", help=PERSON_HELP)
def events(file: Path, out: Path, method: str, person: str | None) -> None:
    """Find initial contacts and toe-offs in FILE and write them as CSV.

    FILE is a fit.npz, a keypoints.npz with 3D markers (its fields decide), a laboratory's C3D, whose markers are
    searched (its own events are ignored), or an OpenSim motion (.mot, .sto) with hips, knees and ankles. Without
    walking, the CSV has only its header and the reason is printed.
    """
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.gait import detect_events

    check_out_file(out)
    found = detect_events(_feet(file, person), method)
    found.save(out)
    if found.status == "EMPTY":
        click.echo(f"{out}: no events: {found.reason}")
        return
    count = {k: sum(e.event == k for e in found.events) for k in ("foot_down", "foot_up")}
    bouts = ", ".join(f"{a:.2f}-{b:.2f} s" for a, b in found.walking_s)
    click.echo(f"{out}: {count['foot_down']} initial contacts, {count['foot_up']} toe-offs; walking {bouts}")
    for check in found.qc:
        if check.advice:
            click.echo(f"  {check.outcome} {check.check}: {check.advice}")


def _feet(path: Path, person: str | None):
    from pbl_pipeline.files import fields_of
    from pbl_pipeline.gait import (
        check_feet,
        feet_from_fit,
        feet_from_keypoints,
        feet_from_markers,
        read_lab_feet,
        read_motion_feet,
    )
    from pbl_pipeline.keypoints import Keypoints, WorldMarkers

    if is_c3d(path):
        return read_lab_feet(path, person)
    if is_motion(path):
        return read_motion_feet(path)
    fields = fields_of(path)
    if "qpos" in fields:
        from pbl_pipeline.fit import TrialFit  # loads the fit's libraries

        return feet_from_fit(TrialFit.load(path))
    if "xyz_cam_m" in fields:
        return feet_from_keypoints(Keypoints.load(path))
    if "xyz_world_m" in fields:
        from pbl_pipeline.body import MARKER_SETS
        from pbl_pipeline.fit import in_upright_world, read_markers

        seen = WorldMarkers.load(path)
        if seen.marker_set in MARKER_SETS:
            found = read_markers(path)
            upright = in_upright_world(found.trial, path.name, found.markers)
            if upright.axis:
                click.echo(f"{path}: the body stands along {upright.axis} of the world as read, which was turned")
            seen = upright.trial
        feet = feet_from_markers(seen.time_s, seen.names, seen.marker_set, seen.xyz_world_m, seen.confidence)
        check_feet(feet, str(path))
        return feet
    raise _format_error(f"fields {', '.join(sorted(fields)) or 'none'}", key=path)
