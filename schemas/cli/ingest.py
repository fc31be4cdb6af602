"""`pbl ingest`: register videos, trials of several cameras, and laboratory markers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from schemas.ingest import Ingested, Methods
    from schemas.sensors import Sensors


@click.command()
@click.argument("videos", nargs=-1, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--markers",
    type=click.Path(path_type=Path, readable=False),
    multiple=True,
    metavar="FILE",
    help="Markers of a laboratory (.trc or .npz) in place of videos; repeat it for each recording.",
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
    help="In place of VIDEOS: a sheet (.csv, .xlsx) with a row for each, of any people and visits (docs/files.md).",
)
@click.option("--dry-run", is_flag=True, help="With --sheet: read all, change nothing, say what would happen.")
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
    help="What the files' names, without suffix, say: named groups subject, session, pace, activity.",
)
@click.option("--project", metavar="NAME", help="Study or clinic, for a subject that is new.")
@click.option("--camera", type=click.Path(path_type=Path), metavar="FILE", help="Calibration of the camera.")
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
@click.option(
    "--depth", type=click.Path(path_type=Path), multiple=True, metavar="FILE", help="Depth video, once for each video."
)
@click.option(
    "--imu",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="Files of wearable IMUs, of one video.",
)
@click.option("--activity", help="What the person does, such as tug or sit_to_stand (else: walking).")
@click.option(
    "--pace", help="How fast: self_selected, fast, slow, dual_task, ... (else: unknown, which counts as self_selected)."
)
@click.option("--population", metavar="NAME", help="Group of the subject, such as healthy (else: as it was).")
@click.option("--height-m", type=float, help="Measured body height of the subject, such as 1.72 (else: as it was).")
@click.option("--person", type=click.IntRange(min=1), help="Measure this person of the tracking (else: automatic).")
@click.option("--tracking-method", metavar="NAME", help="Method of person tracking (else: the default).")
@click.option("--keypoint-method", metavar="NAME", help="Keypoint method or model (else: default).")
@click.option("--fit-method", metavar="NAME", help="Method of the session fit (else: what suits the keypoints).")
@click.option("--index", metavar="NAME", help="Gait Deviation Index: pbl-2025-three-angles (default) or gillette-2008.")
@click.option("--norm", metavar="NAME", help="Normative set of the Gait Deviation Index (else: the index's own).")
def ingest(
    videos: tuple[Path, ...],
    markers: tuple[Path, ...],
    marker_set: str | None,
    up: str,
    rig: Path | None,
    sheet: Path | None,
    dry_run: bool,
    subject: str | None,
    session_label: str | None,
    name_pattern: str | None,
    project: str | None,
    camera: Path | None,
    camera_motion: str | None,
    attitude: tuple[Path, ...],
    depth: tuple[Path, ...],
    imu: tuple[Path, ...],
    activity: str | None,
    pace: str | None,
    population: str | None,
    height_m: float | None,
    person: int | None,
    tracking_method: str | None,
    keypoint_method: str | None,
    fit_method: str | None,
    index: str | None,
    norm: str | None,
) -> None:
    """Register videos, with --rig the views of one trial by several calibrated cameras, or with --markers recordings of
    laboratory markers, of one visit; `pbl populate` then computes them. No video is decoded here.

    A file whose bytes are registered already is not registered twice, but takes a new camera (what was computed with
    another is deleted and listed), a sensor log of the phone (the same), activity, pace and further methods. Logs,
    depth videos, IMU files, markers and calibrations of a rig are copied. Videos of one camera, trials of several and
    markers of a visit are fitted apart. Exit code 1 when a file was refused; the others are registered all the same,
    but a trial of several cameras whole or not at all.

    \b
    Example: pbl ingest walk1.mp4 walk2.mp4 --subject P017 --session 2026-03-01
    Example: pbl ingest walk.mov --subject P018 --camera iphone.toml --person 2
    Example: pbl ingest walk.mov --subject P018 --attitude 2026-03-01_09-15-30.zip
    Example: pbl ingest *.mp4 --session 2026-03-01 --name-pattern '(?P<subject>[^_]+)_(?P<pace>[^_]+)_.*'
    Example: pbl ingest cam_01.mp4 cam_02.mp4 cam_03.mp4 --rig Calib.toml --subject P017 --session 2026-03-01
    Example: pbl ingest --sheet visits.csv --dry-run
    Example: pbl ingest --markers walk1.trc --marker-set our_lab.csv --subject P017 --session 2026-03-01
    """
    import schemas
    from schemas.ingest import Methods, Visit
    from schemas.ingest import ingest as register
    from schemas.marker_recordings import ingest_markers
    from schemas.rigs import ingest_rig
    from schemas.session import UNLABELLED

    methods = Methods(tracking=tracking_method, keypoint=keypoint_method, fit=fit_method, gdi=index, norm=norm)
    if sheet is not None:
        of_rows = (videos, markers, marker_set, rig, subject, session_label, name_pattern, project, camera)
        of_rows += (camera_motion, attitude, depth, imu, activity, pace, population, height_m, person)
        if any(of_rows):
            raise click.UsageError("--sheet: its columns state files, people and visits; only methods are options.")
        _sheet(sheet, methods, dry_run)
        return
    if dry_run:
        raise click.UsageError("--dry-run goes with --sheet.")
    _one_kind(videos, markers, marker_set, bool(attitude or depth or imu), rig is not None)
    files = _files(len(videos), attitude, depth, imu)
    options = {"subject": subject, "session": session_label, "pace": pace, "activity": activity}
    calls, results = _visits(videos or markers, name_pattern, {k: v for k, v in options.items() if v is not None})
    if person is not None and len(videos) > 1 and len(calls) > 1:
        raise click.UsageError("--person goes with one video: people are numbered anew in each.")
    if rig is not None and (results or len(calls) > 1):
        raise click.UsageError("--rig: all videos are of one trial, so their names must state the same.")
    schemas.activate()
    if fit_method is not None:
        _warn(methods, bool(markers))
    for said, numbers in calls:
        visit = Visit(
            subject=said["subject"],
            session_label=said.get("session", UNLABELLED),
            project=project,
            camera_file=camera,
            camera_motion=camera_motion,
            activity=said.get("activity"),
            person=person,
            population=population,
            pace=said.get("pace"),
            height_m=height_m,
        )
        if markers:
            results += ingest_markers([markers[i] for i in numbers], visit, marker_set, up, methods)
        elif rig is not None:
            results += ingest_rig([videos[i] for i in numbers], rig, visit, methods)
        else:
            results += register([videos[i] for i in numbers], visit, methods, [files[i] for i in numbers])
    for result in results:
        if result.error is not None:
            click.echo(result.error.text(), err=True)
        else:
            click.echo(f"video_id {result.video_id}: {result.path.name} {result.status} ({result.note})")
        if result.status in ("known", "moved", "updated") and person is not None:
            click.echo(f"  to measure another person of it: pbl choose {result.video_id} {person}")
    if any(r.error for r in results):
        raise click.exceptions.Exit(1)


def _warn(methods: Methods, markers: bool) -> None:
    """Say on the terminal where the fit method was made for other points."""
    from schemas.ingest import resolve
    from schemas.plan import unsuited

    chosen = resolve(methods)
    if said := unsuited(chosen["fit_method"], None if markers else chosen["keypoint_method"]):
        click.echo(f"warning: {said}", err=True)


def _sheet(sheet: Path, methods: Methods, dry_run: bool) -> None:
    import schemas
    from schemas.ingest_sheet import ingest_sheet

    schemas.activate()
    if methods.fit is not None:
        _warn(methods, markers=False)
    found = ingest_sheet(sheet, methods, dry_run)
    for line in found.lines:
        for error in line.errors:
            click.echo(error.text(), err=True)
        if line.note and not line.errors:
            number = "" if line.video_id is None else f"video_id {line.video_id}: "
            click.echo(f"{line.where}: {line.file}: {number}{line.note}")
    wrong = sum(bool(line.errors) for line in found.lines)
    known = sum(line.note.startswith("registered already") for line in found.lines if not line.errors)
    word = "registered" if found.done else "would be registered" if dry_run and not wrong else "not registered"
    click.echo(f"{len(found.lines) - wrong - known} videos {word}, {known} known, {wrong} rows refused")
    if wrong:
        raise click.exceptions.Exit(1)


def _visits(
    paths: tuple[Path, ...], name_pattern: str | None, options: dict[str, str]
) -> tuple[list[tuple[dict[str, str], list[int]]], list[Ingested]]:
    """(what is stated, positions of the files it is stated of), and the files whose name does not fit the pattern.

    Raises `PblError` USAGE for a pattern that is none; `click.UsageError` where it and an option state the same, or
    nobody states the subject.
    """
    from pbl_pipeline.errors import PblError
    from schemas.ingest import Ingested
    from schemas.name_pattern import compiled, read_name, together

    pattern = compiled(name_pattern) if name_pattern is not None else None
    if pattern is not None and (twice := sorted(set(pattern.groupindex) & set(options))):
        raise click.UsageError(f"--{twice[0]} and the name pattern state the same: leave one out.")
    stated, positions, refused = [], [], []
    for i, path in enumerate(paths):
        try:
            said = options | (read_name(pattern, path) if pattern is not None else {})
        except PblError as error:
            refused.append(Ingested(path, "refused", error=error))
            continue
        if "subject" not in said:
            raise click.UsageError("Missing option '--subject' (or a group 'subject' in --name-pattern).")
        stated.append(said)
        positions.append(i)
    return [(stated[g[0]], [positions[i] for i in g]) for g in together(stated)], refused


def _one_kind(
    videos: tuple[Path, ...], markers: tuple[Path, ...], marker_set: str | None, with_files: bool, rig: bool
) -> None:
    """Raises `click.UsageError` unless there are videos, or markers or views of a rig without a phone's files."""
    if not videos and not markers:
        raise click.UsageError("Missing argument 'VIDEOS...' (or --markers FILE).")
    if videos and markers:
        raise click.UsageError("Videos and --markers in one call: register each in a call of its own.")
    if (markers or rig) and with_files:
        raise click.UsageError(
            "--attitude, --depth and --imu belong to videos of one camera, not to --markers or --rig."
        )
    if markers and rig:
        raise click.UsageError("--rig goes with videos, not with --markers.")
    if marker_set is not None and not markers:
        raise click.UsageError("--marker-set goes with --markers.")


def _files(n: int, attitude: tuple[Path, ...], depth: tuple[Path, ...], imu: tuple[Path, ...]) -> list[Sensors]:
    """What belongs to each of the n videos. Raises `PblError` USAGE where files and videos do not match."""
    from pbl_pipeline.errors import PblError
    from schemas.sensors import Sensors

    for what, given in (("--attitude", attitude), ("--depth", depth)):
        if given and len(given) != n:
            raise PblError(
                "USAGE",
                found=f"{len(given)} times {what} for {n} videos",
                expected="none, or one for each video, in the same order",
                next_step="name a file for each video"
                + (", 'none' for one without a log" if what == "--attitude" else "; ingest the others in another call"),
            )
    if imu and n > 1:
        raise PblError(
            "USAGE",
            found=f"--imu for {n} videos",
            expected="IMU files with one video",
            next_step="ingest that video in a call of its own",
        )
    logs, depths = (list(given) or [None] * n for given in (attitude, depth))
    return [Sensors(a, d, imu) for a, d in zip(logs, depths, strict=True)]
