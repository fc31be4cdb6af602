"""`pbl fit`: keypoints or markers of one session to joint angles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbl_pipeline import filming
from pbl_pipeline.errors import PblError

from .options import (
    CAMERA_MOTION_HELP,
    CAMERA_MOTIONS,
    DEPTH,
    HEIGHT,
    IMU,
    depth_files,
    fit_paramset,
    sensor_logs,
)

if TYPE_CHECKING:
    from pbl_pipeline.body import MarkerSet
    from pbl_pipeline.fit import RecordingFacts
    from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers

_ENDS = (".npz", ".keypoints", ".markers", ".csv", ".h5", ".hdf5", ".dlc", ".analysis")


@click.command(epilog="Example: pbl fit walk1.keypoints.npz walk2.keypoints.npz --out results")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the results.")
@click.option("--solver", help="Such as gauss-newton or implicit-adam; without it the solver of the paramset.")
@click.option("--params", help="Name of a paramset, or a JSON file with changes to one (docs/files.md).")
@click.option("--camera-motion", type=click.Choice(CAMERA_MOTIONS), help=CAMERA_MOTION_HELP)
@click.option("--cameras", type=click.Path(path_type=Path), help="Calibration (TOML): FILES are views of one trial.")
@click.option("--marker-set", help="Name of a marker set, or your own table (CSV); needed for .trc files.")
@click.option("--video", type=click.Path(path_type=Path), multiple=True, help="Video of 2D keypoints; once a file.")
@click.option("--fps", type=float, help="Frames a second of 2D keypoints, without --video.")
@click.option("--width", type=int, help="Width (px) of the upright picture of 2D keypoints, without --video.")
@click.option("--height", type=int, help="Its height (px).")
@click.option("--camera", type=click.Path(path_type=Path), help="Calibration file of the camera of 2D keypoints.")
@click.option("--person", multiple=True, metavar="NAME", help="Person or individual of 2D keypoints; once, or a file.")
@HEIGHT
@IMU
@DEPTH
@click.option(
    "--up", type=click.Choice(["y", "z"]), default="y", show_default=True, help="Vertical axis of .trc files."
)
def fit(
    files: tuple[Path, ...],
    out: Path,
    solver: str | None,
    params: str | None,
    camera_motion: str | None,
    cameras: Path | None,
    marker_set: str | None,
    video: tuple[Path, ...],
    fps: float | None,
    width: int | None,
    height: int | None,
    camera: Path | None,
    person: tuple[str, ...],
    height_m: float | None,
    imu: tuple[str, ...],
    depth: tuple[str, ...],
    up: str,
) -> None:
    """Fit one body to FILES, the trials of one session.

    FILES are keypoints.npz, markers of a laboratory as .npz or .trc, or 2D keypoints of another program: a folder of
    OpenPose's JSON, DeepLabCut's .csv or .h5, SLEAP's analysis .h5, Sports2D's .trc in pixels (docs/files.md). With
    --cameras they are the views of one trial, named like the cameras of the calibration or in its order.

    Writes <name>.fit.npz and <name>.angles.csv for each trial, and session.json.
    """
    import numpy as np

    from pbl_pipeline.depth import with_recordings
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.fit import fit_session, points_of
    from pbl_pipeline.keypoints import WorldMarkers
    from pbl_pipeline.pipeline import distinct_names
    from pbl_pipeline.visit import Recording, Visit, save_visit, solution_of

    check_out_folder(out)
    fit_paramset(solver, params)  # raises for a wrong name before anything is read
    if cameras and depth:
        raise PblError("USAGE", "--depth with --cameras", "keypoints of one camera", "leave out --depth")
    sensors, recordings_of_depth = sensor_logs(imu), depth_files(depth, len(files))
    table = _marker_set(marker_set)
    facts = _facts(len(files), video, fps, width, height, camera, person)
    trials: Sequence[Any] = [_load(path, table, up, f) for path, f in zip(files, facts, strict=True)]
    trials, depths = with_recordings(trials, recordings_of_depth)
    paramset = fit_paramset(solver, params, points_of(trials))
    stems = [_stem(path) for path in files]
    if cameras:
        trial, name = _views_of_one(trials, stems, cameras)
        trials, names = [trial], [name]
    else:
        names = distinct_names([Path(stem + ".npz") for stem in stems])
    motions = [camera_motion or _motion(trial) for trial in trials]
    more: dict[str, Any] = {} if table is None else {"markers": table}
    if sensors:
        more |= {"sensors": sensors, "sensor_clock_s": [None] * len(trials)}
    if any(depths):
        more |= {"depths": depths}
    motion = motions[0] if len(set(motions)) == 1 else motions
    session = fit_session(trials, names, paramset, motion, height_m=height_m, **more)
    recordings = tuple(Recording.of(trial.name, trial) for trial in session.trials)
    laboratory = all(isinstance(trial, WorldMarkers) for trial in trials)
    kind = filming.RIG if cameras else filming.MARKERS if laboratory else filming.SINGLE
    visit = Visit(recordings, solution_of(session), session.qc, kind=kind, methods={"Fit": paramset.key})
    for path in save_visit(visit, out):
        click.echo(path)
    for trial in session.trials:
        for s in trial.sensors:
            found = f"clock {s.clock_s:.3f} s, error {s.z:.2f} standard deviations, {s.dropped:.0%} left out"
            click.echo(f"{trial.name}, sensor on {s.segment}: {found if np.isfinite(s.clock_s) else 'not used'}")
    click.echo(f"fitted in {session.seconds:.0f} s, of which {session.compile_seconds:.0f} s compiling")
    for check in session.qc:
        if check.outcome != "PASS":
            click.echo(f"{check.outcome} {check.check}: {check.advice}")


def _marker_set(given: str | None) -> MarkerSet | None:
    """Return the table of `--marker-set`: a file if it ends in .csv, else the name of an included set."""
    from pbl_pipeline.body import load_marker_set, marker_set

    if given is None:
        return None
    return load_marker_set(Path(given)) if given.lower().endswith(".csv") else marker_set(given)


def _facts(
    n: int,
    videos: Sequence[Path],
    fps: float | None,
    width: int | None,
    height: int | None,
    camera: Path | None,
    people: Sequence[str],
) -> list[RecordingFacts]:
    """Facts of the recording of each of `n` files."""
    from pbl_pipeline.fit import RecordingFacts

    for option, values, allowed in (("--video", videos, (0, n)), ("--person", people, (0, 1, n))):
        if len(values) not in allowed:
            found, expected = f"{option} {len(values)} times, {n} files", "once for each file, in their order"
            raise PblError("USAGE", found, expected, "see `pbl fit --help`")
    for option, value in (("--fps", fps), ("--width", width), ("--height", height)):
        if value is not None and not 0 < value < 1e5:
            raise PblError("USAGE", f"{option} {value:g}", "a number above 0", "see `pbl fit --help`")
    size = (width, height) if width and height else None
    each = [[*values] * (n if len(values) == 1 else 1) or [None] * n for values in (videos, people)]
    return [RecordingFacts(v, fps, size, camera, p) for v, p in zip(*each, strict=True)]


def _load(path: Path, table: MarkerSet | None, up: str, facts: RecordingFacts) -> Keypoints | WorldMarkers:
    """Load one file as a trial; markers of a laboratory are sorted as in their marker set."""
    import dataclasses

    from pbl_pipeline.files import fields_of
    from pbl_pipeline.fit import read_keypoints, read_markers
    from pbl_pipeline.keypoints import Keypoints, check_keypoints
    from pbl_pipeline.keypoints.pose_files import is_pose_file

    if is_pose_file(path):
        trial, text = read_keypoints(path, facts, table)
        click.echo(f"{path.name}: {text}\n  camera {trial.camera.source}")
        for check in check_keypoints(trial):
            if check.advice:
                click.echo(f"  {check.outcome} {check.check} = {check.value:.3g}: {check.advice}")
        return trial
    if path.suffix.lower() != ".trc" and "xyz_world_m" not in fields_of(path):
        keypoints = Keypoints.load(path)
        return keypoints if table is None else dataclasses.replace(keypoints, marker_set=table.name)
    found = read_markers(path, table, up)
    click.echo(f"{path.name}: {found.text()}")
    for what, names in (("  not in the file", found.absent), ("  not in the marker set", found.unused)):
        if names:
            click.echo(f"{what}: {', '.join(names)}")
    return found.trial


def _views_of_one(
    views: Sequence[Keypoints | WorldMarkers], stems: Sequence[str], calibration: Path
) -> tuple[MultiView, str]:
    """Return the files as views of one trial, and the trial's name."""
    from pbl_pipeline.keypoints import Keypoints, MultiView, cameras_of_files

    seen = [view for view in views if isinstance(view, Keypoints)]
    if len(seen) < len(views):
        raise PblError(
            "USAGE",
            found="markers of a laboratory with --cameras",
            expected="the keypoints of each camera",
            next_step="leave out --cameras: such markers are in the world already",
        )
    name, cameras = cameras_of_files(stems, calibration)
    for stem, camera in zip(stems, cameras, strict=True):
        click.echo(f"{stem}: camera {camera}")
    return MultiView.from_calibration(seen, calibration, cameras), name


def _motion(trial: object) -> str:
    return "handheld" if getattr(trial, "phone_time_s", None) is not None else "static"


def _stem(path: Path) -> str:
    stem = path.name or path.resolve().name
    if path.suffix.lower() == ".trc":
        return path.stem
    for end in _ENDS:
        stem = stem.removesuffix(end)
    return stem
