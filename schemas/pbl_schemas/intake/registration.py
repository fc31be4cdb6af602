"""Registration of recordings and their plans: the only way into the tables.

Commands, sheets, the drop folder and pages make records (`OneCamera`, `SeveralCameras`, `LaboratoryMarkers`), whose
files are read and checked (`Recording.read`), and then written, or compared with what is registered.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import of_stage

from .. import fit, gait, gdi, keypoints, kinetics, session, tracking, video
from ..datajoint_setup import DuplicateError, dj
from ..method_rows import resolve_method
from ..methods import insert_once
from ..operations import catalog
from ..plan import default_fit
from ..queues import forget_errors
from ..rows import PART, insert_in_parts, inside, rows_inside, utc_now
from ..transactions import in_transaction, keep_files, next_id
from .calibrations import camera_id_of
from .records import (
    File,
    Methods,
    Recording,
    RefusedFile,
    Registered,
    session_ids,
    set_condition,
    set_height,
    set_mass,
    set_population,
)

#: Keys of selections and plans that name a method: fields of `Methods` with this ending.
_ENDING = "_method"
METHOD_KEYS = ("norm", *(f"{name}{_ENDING}" for name in ("tracking", "keypoint", "fit", "gait", "gdi", "kinetics")))
#: Method of the fit that markers get where none is named (`pbl_pipeline.fit.default_fit`).
DEFAULT_MARKER_FIT = "markers"


def resolve(named: Methods, markers: bool = False) -> dict[str, str]:
    """Return the keys of the method rows of a video, or of laboratory markers, with defaults filled in. Raises
    `PblError` SOLVER_UNKNOWN, NORM_UNKNOWN."""
    insert_once()  # a page activates without, and may be the first of a new version

    def key(table: Any, name: str | None) -> str:
        return resolve_method(table, name or of_stage(table.stage).default)

    after_fit = {
        "gait_method": key(gait.GaitEventMethod, named.gait),
        **gdi.resolve(named.gdi, named.norm),
        "kinetics_method": key(kinetics.KineticsMethod, named.kinetics),
    }
    if markers:
        return {"fit_method": resolve_method(fit.FitMethod, named.fit or DEFAULT_MARKER_FIT), **after_fit}
    points = key(keypoints.KeypointMethod, named.keypoint)
    return {
        "tracking_method": key(tracking.TrackingMethod, named.tracking),
        "subject_method": key(tracking.SubjectMethod, named.subject),
        "keypoint_method": points,
        "fit_method": resolve_method(fit.FitMethod, named.fit) if named.fit else default_fit(points),
        **after_fit,
    }


def plan_named(video_id: int, session_id: int, chosen: Mapping[str, str], named: Collection[str]) -> list[str]:
    """Enter a registered recording into those of the methods whose keys are `named`; return the additions in words."""
    added = []
    for table, rows in _selections([video_id], [session_id], chosen, set(named)):
        for values in rows:
            key = {k: v for k, v in values.items() if k in table.primary_key}
            if not table & key:
                table.insert1(values)
                names = [str(v) for k, v in key.items() if k not in ("video_id", "session_id")]
                added.append(f"{table.__name__} {', '.join(names)} was added")
    return added


def _selections(
    videos: Sequence[int], sessions: Collection[int], chosen: Mapping[str, str], named: set[str]
) -> Iterable[tuple[Any, list[dict[str, Any]]]]:
    """Yield (table, rows) that recordings and their sessions need for the methods `named`; without a tracking method in
    `chosen` the recordings are laboratory markers."""
    if "tracking_method" in chosen:
        yield from _of_videos(videos, sessions, chosen, named)
    elif "fit_method" in named:
        yield fit.MarkerPlan, [{"video_id": v, "fit_method": chosen["fit_method"]} for v in videos]
    for table in (gait.GaitPlan, gdi.GdiPlan, kinetics.KineticsPlan):
        keys = [k for k in table.primary_key if k != "session_id"]
        if named & set(keys):
            yield table, [{"session_id": s, **{k: chosen[k] for k in keys}} for s in sessions]


def _of_videos(
    videos: Sequence[int], sessions: Collection[int], chosen: Mapping[str, str], named: set[str]
) -> Iterable[tuple[Any, list[dict[str, Any]]]]:
    """Yield (table, rows) of videos: keypoints of the tracking selected with them, else of every tracking."""
    points = {"keypoint_method": chosen["keypoint_method"]}
    trackings: list[Any] = [{"video_id": v, "tracking_method": chosen["tracking_method"]} for v in videos]
    if "tracking_method" in named:
        subject = {"subject_method": chosen["subject_method"]}
        yield tracking.TrackingSelection, [{**t, **subject} for t in trackings]
    elif "keypoint_method" in named:
        trackings = (tracking.TrackingSelection & inside("video_id", videos)).keys()
    if named & {"tracking_method", "keypoint_method"}:
        yield keypoints.KeypointSelection, [{**t, **points} for t in trackings]
    if named & {"keypoint_method", "fit_method"}:
        by = {"fit_method": chosen["fit_method"]}
        methods = {s: points.values() if "keypoint_method" in named else _keypoint_methods(s) for s in sessions}
        yield fit.FitPlan, [{"session_id": s, **by, "keypoint_method": m} for s, of in methods.items() for m in of]


def _keypoint_methods(session_id: int) -> list[str]:
    selected = keypoints.KeypointSelection & (video.Video & {"session_id": session_id})
    return sorted((dj.U("keypoint_method") & selected).to_arrays("keypoint_method"))


#: Errors about a file that is missing or changed.
_FILE_ERRORS = ("VIDEO_MISSING", "VIDEO_CHANGED")


def register(recordings: Iterable[Recording], methods: Methods | None = None) -> list[Registered]:
    """Register recordings with the methods they go through, each in a separate transaction.

    A file whose bytes are registered already takes what is new: a calibration or sensor log of the phone (what was
    computed with another is deleted: keypoints and after), activity, pace, population, height, mass, and the methods
    that are named, which are added to its selections and the plans of its session.

    Raises `PblError` USAGE for a subject code that could be a name, a label too long, or a statement that does not
    apply to the kind of recording; FIT_INPUT for a height or mass; MARKER_SET_UNKNOWN, FILE_FORMAT for a marker set;
    SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods. Nothing is registered then.

    Returns a `Registered` for each file, in their order. Missing, empty and unreadable files are refused with their
    error, all videos of a trial of several cameras together; the other recordings are registered.
    """
    recordings, named = list(recordings), methods or Methods()
    for recording in recordings:
        recording.check(named)
    chosen = {markers: resolve(named, markers) for markers in {r.markers for r in recordings}}
    keys = {key for key in METHOD_KEYS if getattr(named, key.removesuffix(_ENDING)) is not None}
    done: list[Registered] = []
    for recording in recordings:
        try:
            recording.read()
            done += _register(recording, chosen[recording.markers], keys)
        except RefusedFile as wrong:
            done += [Registered(path, "refused", error=wrong.error_of(path)) for path in recording.paths]
        except PblError as error:
            done += [Registered(path, "refused", error=error) for path in recording.paths]
        finally:
            if recording.sensors:
                recording.sensors.remove_copies()
    if len(done) > PART:
        catalog.analyse()
    return done


def _register(one: Recording, chosen: Mapping[str, str], named: set[str]) -> list[Registered]:
    if known := registered(one.files):
        return _update(one, known, chosen, named)
    one.complete(chosen)
    read_together(one, {})
    try:
        return insert_new([one], chosen, lambda: bool(registered(one.files)))
    except DuplicateError:
        if not (known := registered(one.files)):
            raise
        return _update(one, known, chosen, named)


def registered(files: Iterable[File]) -> dict[str, dict[str, Any]]:
    """Return the rows of Video with the bytes of these files, by SHA-256, with subject and label of the session."""
    videos = video.Video * session.Session.proj("subject", "session_label")
    rows = rows_inside(videos, "video_sha256", (file.sha256 for file in files))
    return {row["video_sha256"]: row for row in rows}


def read_together(one: Recording, known: Mapping[str, Mapping[str, Any]]) -> None:
    """Read the logs of wearable sensors of a recording with those of its visit, outside of a transaction. Raises
    `PblError` as `Sensors.at_visit`. `known`: `registered` of its files."""
    if one.sensors and one.sensors.imu:
        label = {"subject": one.visit.subject, "session_label": one.visit.session_label}
        visits = [{"session_id": row["session_id"]} for row in known.values()]
        visits = visits or [session.Session & session.as_registered(label)]
        one.sensors = one.sensors.at_visit(*fit.worn_logs(visits))


def check_owner(one: Recording, known: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise `PblError` VIDEO_DUPLICATE if the bytes of a file are registered (`known`) for another subject."""
    visit = one.visit
    for file in one.files:
        row = known.get(file.sha256)
        if row is not None and row["subject"] != visit.subject:
            owner = f"subject {row['subject']}, session {row['session_label']}"
            found = f"video_id {row['video_id']} of {owner}, has these bytes"
            expected = f"a recording of subject {visit.subject} (session {visit.session_label}) and of no one else"
            move = f"pbl move {row['video_id']} --to {visit.subject}/{visit.session_label}"
            next_step = f"find out whose recording it is; if not {row['subject']}'s: {move}"
            raise PblError("VIDEO_DUPLICATE", found, expected, next_step, key=file.path)


def insert_new(
    recordings: Sequence[Recording], chosen: Mapping[str, str], until: Callable[[], bool] = lambda: False
) -> list[Registered]:
    """`write` in a transaction (`keep_files`)."""
    done = keep_files(lambda: write(recordings, chosen), until)
    numbers = iter(result.video_id for result in done)
    for one in recordings:
        first, *_ = (next(numbers) for _ in one.files)
        if one.sensors:
            forget_errors(int(first or 0))  # fits of the visit may have failed by its older sensors
    return done


def write(recordings: Sequence[Recording], chosen: Mapping[str, str]) -> list[Registered]:
    """Insert recordings that are new, with people, sessions, selections and plans. Call it in a transaction.

    `chosen`: keys of the methods (`plans.resolve`). Returns the outcome of each file.
    """
    sessions = session_ids(one.visit for one in recordings)
    of_session = [sessions[one.visit.subject, one.visit.session_label] for one in recordings]
    first = next_id(video.Video, "video_id", sum(len(one.files) for one in recordings))
    counter = itertools.count(first)
    numbers = [[next(counter) for _ in one.files] for one in recordings]
    for one, session_id in zip(recordings, of_session, strict=True):
        one.check_session(session_id)
    new = list(zip(recordings, of_session, numbers, strict=True))
    insert_in_parts(video.Video, (row for one, session_id, own in new for row in _video_rows(one, session_id, own)))
    paced = [(number, one.visit.pace) for one, _, own in new for number in own if one.visit.pace is not None]
    for number, pace in paced:
        set_condition(number, pace=pace)
    notes = [one.insert(own) for one, _, own in new]
    for table, rows in _selections([n for own in numbers for n in own], {*of_session}, chosen, set(METHOD_KEYS)):
        insert_in_parts(table, rows, skip_duplicates=True)  # the session may have its plans already
    for one, _, own in new:
        if one.visit.person is not None:
            tracking.set_override({"video_id": own[0], "tracking_method": chosen["tracking_method"]}, one.visit.person)
    return [
        Registered(file.path, "registered", number, "; ".join(filter(None, (one.visit.text(), note))))
        for (one, _, own), noted in zip(new, notes, strict=True)
        for file, number, note in zip(one.files, own, noted, strict=True)
    ]


def _video_rows(one: Recording, session_id: int, numbers: Sequence[int]) -> Iterable[dict[str, Any]]:
    for number, file in zip(numbers, one.files, strict=True):
        yield {
            "video_id": number,
            "session_id": session_id,
            "camera_id": camera_id_of(file.camera) if file.camera else None,
            "video_path": str(file.path),
            "video_name": file.path.name[-255:],
            "video_sha256": file.sha256,
            "video_size": file.size,
            "activity": one.visit.activity or "walking",
            "camera_motion": one.motion,
            "video_created": utc_now(),
        }


def _update(
    one: Recording, known: Mapping[str, Mapping[str, Any]], chosen: Mapping[str, str], named: set[str]
) -> list[Registered]:
    """Add what is new to a recording whose bytes are registered."""
    check_owner(one, known)
    one.check_known([known[file.sha256] for file in one.files if file.sha256 in known])
    read_together(one, known)
    return [_update_file(one, file, known[file.sha256], chosen, named) for file in one.files]


def _update_file(
    one: Recording, file: File, row: Mapping[str, Any], chosen: Mapping[str, str], named: set[str]
) -> Registered:
    number, session_id, visit = int(row["video_id"]), int(row["session_id"]), one.visit
    status, notes = "known", [f"already video_id {number} of subject {row['subject']}, session {row['session_label']}"]
    if str(file.path) != row["video_path"] and not Path(row["video_path"]).is_file():
        video.Video.update1({"video_id": number, "video_path": str(file.path), "video_name": file.path.name[-255:]})
        forget_errors(number, _FILE_ERRORS)
        status = "moved"
        notes.append(f"it was {row['video_path']}, which is gone")

    def work() -> list[str]:
        done = plan_named(number, session_id, chosen, named)
        done += set_condition(number, visit.activity, visit.pace) + set_population(row["subject"], visit.population)
        if visit.height_m is not None:
            done += set_height(row["subject"], visit.height_m)
        if visit.mass_kg is not None:
            done += set_mass(session_id, visit.mass_kg)
        return done

    changes = one.update(row) + in_transaction(work)
    if changes and status == "known":
        status = "updated"
    if visit.camera_motion not in (None, row["camera_motion"]):
        changes.append(f"camera motion {visit.camera_motion} was ignored, it stays {row['camera_motion']}")
    if status == "known" and not changes:
        changes = ["nothing was inserted"]
    return Registered(file.path, status, number, "; ".join(notes + changes))
