"""`pbl ingest`: register videos, trials of several cameras, and laboratory markers."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbl_pipeline.cli.options import DEPTH, IMU, check_one_each

if TYPE_CHECKING:
    from pbl_schemas.intake import Methods, Registered, Sensors, VisitRecord


#: Parameters that name methods: fields of `Methods`.
_METHODS = ("tracking", "keypoint", "fit", "gdi", "norm", "kinetics")


@click.command()
@click.argument("videos", nargs=-1, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--markers",
    type=click.Path(path_type=Path, readable=False),
    multiple=True,
    metavar="FILE",
    help="Markers of a laboratory (.trc or .npz) instead of videos; repeat it for each recording.",
)
@click.option("--marker-set", metavar="SET", help="Of --markers: a name, or a table (CSV) of your own; for .trc files.")
@click.option(
    "--up", type=click.Choice(["y", "z"]), default="y", show_default=True, help="Vertical axis of .trc files."
)
@click.option(
    "--rig",
    type=click.Path(path_type=Path, readable=False),
    metavar="FILE",
    help="Calibration (TOML) of several cameras: VIDEOS are one trial, a view each, named like them or in order.",
)
@click.option(
    "--sheet",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Instead of VIDEOS: a sheet (.csv, .xlsx) with a row for each, of any people and visits (docs/files.md).",
)
@click.option(
    "--template",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write an empty sheet (.csv, .xlsx) for --sheet, with all its columns; nothing else is done.",
)
@click.option("--dry-run", is_flag=True, help="With --sheet: read all, change nothing, print the outcome.")
@click.option("--subject", metavar="CODE", help="Pseudonymous code of the person, never a name.")
@click.option(
    "--session",
    "session_label",
    metavar="LABEL",
    help="Visit: a date (YYYY-MM-DD) or your own label (else: unlabelled). Its videos are fitted with one body.",
)
@click.option(
    "--name-pattern",
    metavar="REGEX",
    help="Pattern of the files' names, without suffix, with named groups subject, session, pace, activity.",
)
@click.option("--project", metavar="NAME", help="Study or clinic, for a subject that is new.")
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Calibration of the camera.",
)
@click.option(
    "--camera-motion",
    type=click.Choice(["static", "handheld", "one of several"]),
    help="How the camera was held (else: handheld with --attitude, static without).",
)
@click.option(
    "--attitude",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="LOG",
    help="Sensor log of the phone (docs/phone_capture.md), once for each video, in their order; 'none' for no log.",
)
@DEPTH
@IMU
@click.option("--activity", help="What the person does, such as tug or sit_to_stand (else: walking).")
@click.option(
    "--pace", help="How fast: self_selected, fast, slow, dual_task, ... (else: unknown, which counts as self_selected)."
)
@click.option("--population", metavar="NAME", help="Group of the subject, such as healthy (else: as it was).")
@click.option("--height-m", type=float, help="Measured body height of the subject, such as 1.72 (else: as it was).")
@click.option("--mass-kg", type=float, help="Measured body mass at the visit, such as 68.5 (else: as it was).")
@click.option("--person", type=click.IntRange(min=1), help="Measure this person of the tracking (else: automatic).")
@click.option("--tracking-method", "tracking", metavar="NAME", help="Method of person tracking (else: the default).")
@click.option("--keypoint-method", "keypoint", metavar="NAME", help="Keypoint method or model (else: default).")
@click.option("--fit-method", "fit", metavar="NAME", help="Method of the session fit (else: chosen by the keypoints).")
@click.option(
    "--index", "gdi", metavar="NAME", help="Gait Deviation Index: pbl-2025-three-angles (default) or gillette-2008."
)
@click.option("--norm", metavar="NAME", help="Normative set of the Gait Deviation Index (else: the index's own).")
@click.option(
    "--kinetics-method", "kinetics", metavar="NAME", help="Method of forces and joint moments (else: the default)."
)
def ingest(
    videos: tuple[Path, ...],
    sheet: Path | None,
    template: Path | None,
    dry_run: bool,
    markers: tuple[Path, ...],
    marker_set: str | None,
    up: str,
    rig: Path | None,
    name_pattern: str | None,
    attitude: tuple[Path, ...],
    depth: tuple[str, ...],
    imu: tuple[str, ...],
    **stated: Any,
) -> None:
    """Register videos, with --rig the views of one trial by several calibrated cameras, or with --markers recordings of
    laboratory markers, of one visit; `pbl populate` then computes them. No video is decoded here.

    A file whose bytes are registered already is not registered twice, but takes a new camera (what was computed with
    another is deleted and listed), a sensor log of the phone (the same), depths, activity, pace and further methods.
    Logs, depth recordings, IMU files, markers and calibrations of a rig are copied. Videos of one camera, trials of
    several and markers of a visit are fitted apart. Exit code 1 when a file was refused; the others are registered all
    the same, but a trial of several cameras whole or not at all.

    \b
    Example: pbl ingest walk1.mp4 walk2.mp4 --subject P017 --session 2026-03-01
    Example: pbl ingest walk.mov --subject P018 --camera iphone.toml --person 2
    Example: pbl ingest walk.mov --subject P018 --attitude 2026-03-01_09-15-30.zip
    Example: pbl ingest *.mp4 --session 2026-03-01 --name-pattern '(?P<subject>[^_]+)_(?P<pace>[^_]+)_.*'
    Example: pbl ingest cam_01.mp4 cam_02.mp4 cam_03.mp4 --rig Calib.toml --subject P017 --session 2026-03-01
    Example: pbl ingest --template visits.xlsx
    Example: pbl ingest --sheet visits.csv --dry-run
    Example: pbl ingest --markers walk1.trc --marker-set our_lab.csv --subject P017 --session 2026-03-01
    """
    import pbl_schemas
    from pbl_schemas.intake import LaboratoryMarkers, Methods, OneCamera, SeveralCameras, register
    from pbl_schemas.intake.videos import check_person

    if template is not None:
        from pbl_schemas.intake.recording_sheet import COLUMNS, NEEDED
        from pbl_schemas.intake.sheets import write_template

        write_template(template, COLUMNS)
        click.echo(f"written: {template}; a row for each video, {', '.join(NEEDED)} are needed (docs/files.md)")
        return
    methods = Methods(**{name: stated.pop(name) for name in _METHODS})
    stated = {option: value for option, value in stated.items() if value is not None}
    if sheet is not None:
        if any((videos, markers, marker_set, rig, name_pattern, attitude, depth, imu, stated)):
            raise click.UsageError("--sheet: its columns state files, people and visits; only methods are options.")
        _sheet(sheet, methods, dry_run)
        return
    if dry_run:
        raise click.UsageError("--dry-run goes with --sheet.")
    _one_kind(videos, markers, marker_set, bool(attitude or depth), bool(imu), rig is not None)
    files = _files(len(videos), attitude, depth, imu)
    visits, results = _visits(videos or markers, name_pattern, stated)
    if imu and len({visit for _, visit in visits}) > 1:
        raise click.UsageError("--imu: all videos are of one visit, so their names must state the same.")
    if rig is not None and (results or len({visit for _, visit in visits}) > 1):
        raise click.UsageError("--rig: all videos are of one trial, so their names must state the same.")
    if videos and rig is None:
        check_person(stated.get("person"), len(videos))
    pbl_schemas.activate()
    if methods.fit is not None:
        _warn(methods, bool(markers))
    if rig is not None:
        results += register([SeveralCameras(videos, rig, visits[0][1], files[0])], methods)
    elif markers:
        results += register([LaboratoryMarkers(markers[i], visit, marker_set, up) for i, visit in visits], methods)
    else:
        results += register([OneCamera(videos[i], visit, files[i]) for i, visit in visits], methods)
    for result in results:
        if result.error is not None:
            click.echo(result.error.text(), err=True)
        else:
            click.echo(f"video_id {result.video_id}: {result.path.name} {result.status} ({result.note})")
        if result.status in ("known", "moved", "updated") and "person" in stated:
            click.echo(f"  to measure another person of it: pbl choose {result.video_id} {stated['person']}")
    if any(r.error for r in results):
        raise click.exceptions.Exit(1)


def _warn(methods: Methods, markers: bool) -> None:
    """Print a warning where the fit method was made for other points."""
    from pbl_schemas.intake.registration import resolve
    from pbl_schemas.plan import unsuited

    chosen = resolve(methods, markers)
    if said := unsuited(chosen["fit_method"], chosen.get("keypoint_method")):
        click.echo(f"warning: {said}", err=True)


def _sheet(sheet: Path, methods: Methods, dry_run: bool) -> None:
    import pbl_schemas
    from pbl_schemas.intake.recording_sheet import ingest_sheet

    pbl_schemas.activate()
    if methods.fit is not None:
        _warn(methods, markers=False)
    found = ingest_sheet(sheet, methods, dry_run)
    for line in found.lines:
        for error in line.errors:
            click.echo(error.text(), err=True)
        for text in line.doubts:
            click.echo(f"warning: {line.where}: {text}", err=True)
        for text in filter(None, (*line.changes, line.kept)):
            click.echo(f"{line.where}: {text}")
    wrong = sum(bool(line.errors) for line in found.lines)
    new = sum(bool(line.changes) for line in found.lines)
    word = "registered" if found.done else "would be registered" if dry_run and not wrong else "not registered"
    click.echo(f"{new} videos {word}, {len(found.lines) - wrong - new} known, {wrong} rows refused")
    if wrong:
        raise click.exceptions.Exit(1)


def _visits(
    paths: tuple[Path, ...], name_pattern: str | None, stated: dict[str, Any]
) -> tuple[list[tuple[int, VisitRecord]], list[Registered]]:
    """Return (position of a file, its visit) of all files, and the refused files whose name does not fit the pattern.

    Raises `PblError` USAGE for an invalid pattern; `click.UsageError` where it and an option state the same, or neither
    states the subject.
    """
    from pbl_pipeline.name_pattern import read_names, unfit
    from pbl_schemas.intake import Registered, VisitRecord

    groups, names = ((), [{}] * len(paths)) if name_pattern is None else read_names(name_pattern, paths)
    options = {option.removesuffix("_label") for option in stated}
    if twice := sorted(set(groups) & options):
        raise click.UsageError(f"--{twice[0]} and the name pattern state the same: leave one out.")
    visits, refused = [], []
    for i, (path, name) in enumerate(zip(paths, names, strict=True)):
        if name is None:
            refused.append(Registered(path, "refused", error=unfit(name_pattern or "", path)))
            continue
        said: dict[str, Any] = {"session_label" if k == "session" else k: text for k, text in name.items()}
        if "subject" not in said | stated:
            raise click.UsageError("Missing option '--subject' (or a group 'subject' in --name-pattern).")
        visits.append((i, VisitRecord(**stated, **said)))
    return visits, refused


def _one_kind(
    videos: tuple[Path, ...], markers: tuple[Path, ...], marker_set: str | None, of_phone: bool, worn: bool, rig: bool
) -> None:
    """Raise `click.UsageError` unless there are videos, or views of a rig without a phone's files, or markers without
    any."""
    for wrong, text in (
        (not videos and not markers, "Missing argument 'VIDEOS...' (or --markers FILE)."),
        (videos and markers, "Videos and --markers in one call: register each in a separate call."),
        (
            (markers or rig) and of_phone,
            "--attitude and --depth belong to videos of one camera, not to --markers or --rig.",
        ),
        (markers and worn, "--imu goes with videos, not with --markers."),
        (markers and rig, "--rig goes with videos, not with --markers."),
        (marker_set is not None and not markers, "--marker-set goes with --markers."),
    ):
        if wrong:
            raise click.UsageError(text)


def _files(n: int, attitude: tuple[Path, ...], depth: tuple[str, ...], imu: tuple[str, ...]) -> list[Sensors]:
    """Sensor files of each of the n videos; the first has those that the person wore. Raises `PblError` USAGE where
    files and videos do not match, what `given_sensors` raises."""
    from pbl_pipeline.depth import DepthFile
    from pbl_pipeline.sensors import given_sensors, named, read_samples
    from pbl_schemas.intake import Sensors
    from pbl_schemas.intake.records import usage
    from pbl_schemas.intake.sensors import NONE

    for what, given in (("--attitude", attitude), ("--depth", depth)):
        check_one_each(what, given, n, "name a file for each video, 'none' for one without")
    read = functools.cache(read_samples)
    worn = [sensor for text in imu for one in given_sensors(text) for sensor in named(one, read)]
    if n > 1 and (files := [one.file.name for one in worn if one.segment is None and str(one.file) != NONE]):
        alone = "name the segment, such as --imu shank_r=FILE, or ingest that video in a separate call"
        raise usage(f"--imu {files[0]} for {n} videos", "the segment of a sensor", next_step=alone)
    logs, depths = list(attitude) or [None] * n, [DepthFile.of(text) for text in depth] or [None] * n
    return [Sensors(a, d, worn if i == 0 else (), read) for i, (a, d) in enumerate(zip(logs, depths, strict=True))]
