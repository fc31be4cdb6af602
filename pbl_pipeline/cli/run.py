"""`pbl run`: the whole chain on files, without a database."""

from __future__ import annotations

import dataclasses
import datetime
from pathlib import Path

import click

from .options import (
    CAMERA_MOTION_HELP,
    CAMERA_MOTIONS,
    COMPARE,
    DEPTH,
    DEVICE,
    HEIGHT,
    IMU,
    KEYPOINTS,
    LANGUAGE,
    MASS,
    PEOPLE,
    Person,
    check_one_each,
    depth_files,
    fit_paramset,
    keypoint_method,
    sensor_logs,
    show_changes,
    tracking_method,
)


@click.command(epilog="Example: pbl run walk1.mp4 walk2.mp4 --out results --camera phone.toml")
@click.argument("videos", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the results.")
@click.option("--camera", type=click.Path(path_type=Path), help="Calibration file; without it a phone is assumed.")
@click.option(
    "--attitude",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Sensor log of the phone (docs/phone_capture.md), once for each VIDEO, in their order.",
)
@IMU
@DEPTH
@click.option("--camera-motion", type=click.Choice(CAMERA_MOTIONS), help=CAMERA_MOTION_HELP)
@click.option(
    "--person",
    type=Person(),
    default="auto",
    show_default=True,
    help="ID of the person to measure (single video only).",
)
@PEOPLE
@KEYPOINTS
@DEVICE
@click.option("--solver", help="Such as gauss-newton or implicit-adam; without it the solver of the paramset.")
@click.option("--params", help="Name of a paramset, or a JSON file with changes to one (docs/files.md).")
@click.option("--norm", help="Normative set of the GDI.")
@HEIGHT
@MASS
@click.option("--activity", help="Activity in all VIDEOS: tug, sit_to_stand, squat (default: walking).")
@click.option("--subject", default="-", help="Code of the subject on the report; never a name.")
@COMPARE
@LANGUAGE
def run(
    videos: tuple[Path, ...],
    out: Path,
    camera: Path | None,
    attitude: tuple[Path, ...],
    imu: tuple[str, ...],
    depth: tuple[str, ...],
    camera_motion: str | None,
    person: int | None,
    people: str | None,
    keypoints: str | None,
    device: str | None,
    solver: str | None,
    params: str | None,
    norm: str | None,
    height_m: float | None,
    mass_kg: float | None,
    activity: str | None,
    subject: str,
    earlier: Path | None,
    language: str,
) -> None:
    """Process VIDEOS, the trials of one session, with the whole chain.

    Writes report.html, metrics.json, kinetics.json, session.json, and per trial the keypoints, the fit, the angles, the
    events, the forces and a video with the body drawn over it. A video that cannot be used is reported and left out;
    the others are processed, and the exit code is 1.
    """
    from pbl_pipeline import progress
    from pbl_pipeline.errors import PblError

    # Wrong arguments are found before minutes of work.
    if person is not None and len(videos) > 1:
        raise PblError(
            "USAGE",
            found=f"person {person} for {len(videos)} videos",
            expected="a person's number with one video: people are numbered anew in each",
            next_step="leave out --person; if the automatic choice is wrong, run that video alone with --person, "
            "or use `pbl ingest` and `pbl choose`, which keep a choice for each video of a visit",
        )
    next_step = "name a log for each video; run videos without a log in another call"
    check_one_each("--attitude", attitude, len(videos), next_step)
    progress.note(f"{', '.join(p.name for p in videos)}: loading")
    from pbl_pipeline.change import earlier_visit
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.pipeline import run_visit, write_results
    from pbl_pipeline.visit import METRICS

    before = None if earlier is None else earlier_visit(earlier, out, subject, height_m)
    check_out_folder(out)
    sensors, depths = sensor_logs(imu), depth_files(depth, len(videos))
    method, finder = keypoint_method(keypoints, device), tracking_method(people)
    paramset = fit_paramset(solver, params, [method.params.points()])
    visit, problems = run_visit(
        videos,
        out,
        camera,
        person,
        paramset,
        camera_motion,
        norm,
        attitude,
        method,
        finder,
        height_m,
        mass_kg,
        activity,
        sensors,
        depths,
    )
    today = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    visit = dataclasses.replace(visit, subject=subject, label=f"computed {today}")
    paths = write_results(out, visit, language=language)
    if (judged := visit.judged) is not None:
        click.echo(judged.table())
    for origin in sorted({r.keypoints.origin for r in visit.fitted if r.keypoints and r.keypoints.origin}):
        click.echo(f"keypoints by {origin}")
    for name, error in problems.items():
        click.echo(f"left out {name}\n{error.text()}", err=True)
    click.echo("\n".join(str(p) for p in paths))
    if before is not None:
        show_changes(visit, before, out / METRICS)
    if problems:
        raise click.exceptions.Exit(1)
