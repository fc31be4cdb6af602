"""The whole chain on files: videos of one visit in, a `Visit` and its report out. The tables do the same row by row."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.deidentify import to_show
from pbl_pipeline.depth import DepthFile, PointDepths, at_points, read_depth
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.fit import METHODS as FIT_METHODS
from pbl_pipeline.fit import Params as FitParams
from pbl_pipeline.fit import TrialFit, check_trial, default_fit, fit_session
from pbl_pipeline.gait import DEFAULT_NORM, UNKNOWN, Condition, GaitParams, gait_metrics, load_norm
from pbl_pipeline.keypoints import METHODS as KEYPOINT_METHODS
from pbl_pipeline.keypoints import KeypointParams, detect_keypoints
from pbl_pipeline.kinetics import METHODS as KINETICS_METHODS
from pbl_pipeline.kinetics import visit_kinetics
from pbl_pipeline.methods import Method
from pbl_pipeline.models import gpu_wanted
from pbl_pipeline.names import check_height, check_label, check_mass, distinct
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.render import overlay_frames, render_overlay, report_indices
from pbl_pipeline.report import Picture, write_report
from pbl_pipeline.resources import processes_at_once, shared_cores
from pbl_pipeline.sensors import SensorLog, check_day, places
from pbl_pipeline.temporary import new_folder
from pbl_pipeline.texts import LANGUAGES
from pbl_pipeline.tracking import METHODS as TRACKING_METHODS
from pbl_pipeline.tracking import TrackingParams, choose_subject, require_subject, track_people
from pbl_pipeline.video import PhoneLog, attitude_of, check_file, find_camera, frames_kept, probe, read_phone_log
from pbl_pipeline.visit import OVERLAY, REPORT, Held, Recording, Visit, save_visit, solution_of


def run_visit(
    paths: Sequence[Path],
    out: Path,
    camera_file: Path | None = None,
    person: int | None = None,
    paramset: Method[FitParams] | Paramset | str | None = None,
    camera_motion: str | None = None,
    norm: str | None = None,
    attitude_files: Sequence[Path] = (),
    keypoints: Method[KeypointParams] | None = None,
    people: Method[TrackingParams] | None = None,
    height_m: float | None = None,
    mass_kg: float | None = None,
    activity: str | None = None,
    sensors: Sequence[SensorLog] = (),
    depth_files: Sequence[DepthFile | None] = (),
) -> tuple[Visit, Mapping[str, PblError]]:
    """Compute a visit from its videos. Returns it with the errors of the videos that were left out, by their names.

    A video that fails is left out, and so is one with the bytes of another, whose steps would count twice; the others
    go on. Only one file is written to `out`: the numbered people of a video in which one must be chosen.

    `paramset` is the method of the fit; None: the one that suits the keypoints (`fit.default_fit`). `attitude_files`
    holds a sensor log of the phone for each path, or nothing; one that does not belong to its video leaves that out.
    `camera_motion` None stands for "handheld" where there are logs, else "static". `height_m`: as in `fit_session`;
    `mass_kg`: as in `visit_kinetics`. `activity`: what the person does in the videos; None: unknown, which counts
    as walking. `sensors`: logs of the wearable sensors of the visit, as `read_given` returns them. `depth_files`: of
    each video, None where there is none; one that does not belong to its video leaves that out.

    Raises the error of the video where no video of the visit can be fitted: the VIDEO_ codes,
    TRACK_NO_PERSON, TRACK_TOO_SHORT, SUBJECT_NEEDS_CHOICE, SUBJECT_UNKNOWN_PERSON, ASSET_ codes, CAMERA_INVALID, MODEL_
    codes, DEVICE_UNAVAILABLE. NORM_UNKNOWN, NORM_INVALID; FILE_MISSING, PHONE_LOG for a log that cannot be read;
    SENSOR_LOG for sensors of another day.
    """
    # A wrong name or log must not cost a fit.
    keypoints, people = KEYPOINT_METHODS.find(keypoints), TRACKING_METHODS.find(people)
    method = FIT_METHODS.find(paramset or default_fit(keypoints.params.points()))
    load_norm(norm or DEFAULT_NORM)
    check_height(height_m)
    check_mass(mass_kg)
    condition = Condition(activity or UNKNOWN)
    logs = [(file, read_phone_log(file)) for file in attitude_files] or [None] * len(paths)
    camera_motion = camera_motion or ("handheld" if attitude_files else "static")
    problems: dict[str, PblError] = {}
    seen: dict[str, str] = {}
    inputs = []
    depths = depth_files or [None] * len(paths)
    for path, name, log, depth in zip(paths, distinct_names(paths), logs, depths, strict=True):
        one = _Input(path, name, log, out, camera_file, person, people.paramset, keypoints.paramset, method.paramset)
        one = dataclasses.replace(one, depth=depth)
        try:
            first = seen.setdefault(sha256_of(check_file(path)), name)
            if first != name:
                raise _named_twice(path, first)
        except PblError as error:
            one = dataclasses.replace(one, error=error)
        inputs.append(one)
    found: list[Recording] = []
    depths = list[PointDepths | None]()
    for one, (recording, error, depth) in zip(inputs, _side_by_side(inputs), strict=True):
        found.append(dataclasses.replace(recording, condition=condition))
        depths += [] if recording.problem else [depth]
        if error is not None:
            problems[one.name] = error
    recordings = [r for r in found if not r.problem]
    if not recordings:
        raise next(iter(problems.values()))
    check_day(sensors, {r.name: r.video.recorded_utc for r in recordings if r.video is not None})
    points = [r.keypoints for r in recordings if r.keypoints is not None]
    recorded = [None if r.video is None else r.video.recorded_utc for r in recordings]
    more: dict[str, Any] = {}
    if sensors:
        more = {"sensors": sensors, "sensor_clock_s": places(sensors, recorded, points)}
    more |= {"depths": depths} if any(d is not None for d in depths) else {}
    names = [r.name for r in recordings]
    fit = fit_session(points, names, method, camera_motion, height_m=height_m, **more)
    fitted = [dataclasses.replace(r, load_fit=Held(t)) for r, t in zip(recordings, fit.trials, strict=True)]
    left_out = [r for r in found if r.problem]
    methods = {"Tracking": people.key, "Keypoints": keypoints.key, "Fit": method.key}
    visit = Visit((*fitted, *left_out), solution_of(fit), fit.qc, methods=methods)
    return measured(visit, norm=norm, mass_kg=mass_kg), problems


@dataclasses.dataclass(frozen=True)
class _Input:
    """A video of `run_visit`: its sensor log and the log's file, its methods, and its error, if it has one already."""

    path: Path
    name: str
    log: tuple[Path, PhoneLog] | None
    out: Path
    camera_file: Path | None
    person: int | None
    people: Paramset
    keypoints: Paramset
    fit: Paramset
    error: PblError | None = None
    depth: DepthFile | None = None


#: Keypoints of a video with the error that leaves it out, and the depths at them.
_Output = tuple[Recording, PblError | None, PointDepths | None]


def _side_by_side(inputs: Sequence[_Input]) -> Iterator[_Output]:
    """Detect in each video, in order: in several processes if a GPU computes the networks, else in this one, whose
    threads use the cores."""
    videos = sum(i.error is None for i in inputs)
    n = min(videos, processes_at_once(gpu_detects=True)) if gpu_wanted() else 1
    if n < 2:
        yield from map(_detected, inputs)
        return
    # Not forked: threads of the libraries do not survive that.
    with shared_cores(n), ProcessPoolExecutor(n, multiprocessing.get_context("spawn")) as pool:
        yield from progress.track(pool.map(_detected, inputs), "videos", total=len(inputs), unit="video")


@frames_kept()
def _detected(one: _Input) -> _Output:
    """Keypoints of a video, checked, with the depths at them, or the error that leaves it out."""
    video = choice = recorded = None
    try:
        if one.error is not None:
            raise one.error
        video = probe(one.path)
        camera = find_camera(video, one.camera_file)
        if one.depth is not None:
            size = video.width_px, video.height_px
            recorded = read_depth(one.depth.file, np.asarray(video.time_s), size, one.depth.scale_m)
            camera = recorded.camera(camera)
        tracking = track_people(one.path, one.people, info=video)
        choice = choose_subject(tracking, override=one.person)
        subject = require_subject(choice, tracking, one.path, one.out / f"{one.name}.persons.png")
        points = detect_keypoints(one.path, tracking, subject, camera, params=one.keypoints)
        if one.log is not None:
            points = points.with_attitude(attitude_of(one.log[1], one.log[0], video))
        check_trial(points, one.name, one.fit)
        depths = None if recorded is None else at_points(recorded, points)
        return Recording.of(one.name, keypoints=points, path=one.path, video=video, choice=choice), None, depths
    except PblError as error:
        problem = choice.reason if choice is not None and choice.person_id is None else error.short()
        return Recording(one.name, one.path, video, choice, problem=problem), error, None


def measured(
    visit: Visit, gait: GaitParams | None = None, norm: str | None = None, mass_kg: float | None = None
) -> Visit:
    """Return a fitted visit with its gait measures and its kinetics, by the default methods where none are given.

    Raises what `gait_metrics` raises.
    """
    fits = [dataclasses.replace(r.fit, name=r.name) for r in visit.fitted if r.fit is not None]
    conditions = [r.condition for r in visit.fitted]
    measures = gait_metrics(fits, norm, gait, fit_checks=visit.fit_checks, conditions=conditions)
    kinetics = visit_kinetics(fits, measures.trials, KINETICS_METHODS.find(), mass_kg=mass_kg)
    return dataclasses.replace(visit.with_measures(measures), kinetics=kinetics)


def write_results(out: Path, visit: Visit, language: str = LANGUAGES[0]) -> list[Path]:
    """Write all results of a visit into `out` and return the paths, the report first.

    The files of `visit.save_visit`, `<name>.overlay.mp4` of each recording whose video is known, and `report.html`
    (docs/files.md). With PBL_DEIDENTIFY, overlays and pictures show the recordings with hidden heads.

    Raises the `PblError`s of `render_overlay` and `deidentify.to_show`.
    """
    out.mkdir(parents=True, exist_ok=True)
    with _as_shown(visit) as shown:
        filmed = [r for r in shown.fitted if r.shown or r.path]
        overlays = [out / f"{r.name}.{OVERLAY}" for r in filmed]
        for recording, path in zip(filmed, overlays, strict=True):
            draw_overlay(recording, path)
        report = write_visit_report(out / REPORT, shown, language=language)
    return [report, *(p for p in overlays if p.exists()), *save_visit(visit, out)]


def draw_overlay(recording: Recording, path: Path) -> None:
    """Draw the body of a fitted recording over its video, or over the copy with hidden heads if only that may be shown.

    Raises the `PblError`s of `render_overlay`.
    """
    video = recording.shown or recording.path
    assert recording.fit is not None
    assert video is not None
    events = recording.events.events if recording.events else ()
    render_overlay(video, recording.fit, path, keypoints=recording.keypoints, events=events)


def write_visit_report(path: Path, visit: Visit, language: str = LANGUAGES[0]) -> Path:
    """Write the report of a visit with pictures from its videos and return its path.

    Raises the `PblError`s of `overlay_frames` and `deidentify.to_show`.
    """
    with _as_shown(visit) as shown:
        pictures = {r.name: _pictures(r, r.fit) for r in shown.fitted if r.fit is not None}
        return write_report(path, shown, pictures, language=language)


@contextlib.contextmanager
def _as_shown(visit: Visit) -> Iterator[Visit]:
    """Yield the visit with the videos of its recordings that may be shown."""
    with new_folder() as folder:
        recordings = tuple(
            dataclasses.replace(r, shown=r.shown or to_show(r.path, folder, r.video)) if r.fitted and r.path else r
            for r in visit.recordings
        )
        yield dataclasses.replace(visit, recordings=recordings)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """A name for each path: its stem, numbered where stems repeat. Raises `PblError` USAGE for control characters."""
    for path in paths:
        check_label("file name", path.stem, 255, least=1)
    return distinct([p.stem for p in paths], range(1, len(paths) + 1))


def _named_twice(path: Path, first: str) -> PblError:
    return PblError(
        "USAGE",
        found=f"the same bytes as {first}",
        expected="every recording once",
        next_step="name it once; if these should be two recordings, copy them from the phone again",
        key=path,
    )


def _pictures(recording: Recording, fit: TrialFit) -> tuple[Picture, ...]:
    """Return frames for the report, cut to the person; none where the video is not known."""
    video = recording.shown or recording.path
    if video is None:
        return ()
    index = report_indices(fit)
    images = overlay_frames(video, fit, index, crop_to_body=True, max_side_px=760)
    return tuple(
        Picture(int(fit.frame_numbers[i]), float(fit.time_s[i]), image) for i, image in zip(index, images, strict=True)
    )
