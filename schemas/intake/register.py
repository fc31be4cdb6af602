"""Registering video files: what `pbl ingest` does."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import of_stage
from pbl_pipeline.names import check_height, check_label, is_plain
from pbl_pipeline.paramset import canonical_json

from . import fit, gait, gdi, keypoints, lab, sensors, session, tracking, video
from ._datajoint import DuplicateError, dj
from .chain import computed_tables
from .coded_errors import error_code
from .codes import check_subject, day_of
from .conditions import set_condition, set_height
from .jobs import jobs_of
from .method_rows import resolve_method
from .plan import default_fit
from .rows import delete_below, utc_now

if TYPE_CHECKING:
    from pbl_pipeline.video import Camera

T = TypeVar("T")

_ATTEMPTS = 20


@dataclasses.dataclass(frozen=True)
class Methods:
    """Names of the methods that a registered video goes through; None takes the default of the library."""

    tracking: str | None = None
    subject: str | None = None
    keypoint: str | None = None
    fit: str | None = None
    gait: str | None = None
    gdi: str | None = None
    norm: str | None = None


@dataclasses.dataclass(frozen=True)
class Ingested:
    """What became of one path: "registered", "known" (nothing changed), "moved" (path updated), "updated" (camera or
    methods added) or "refused"; `note` says it in words."""

    path: Path
    status: str
    video_id: int | None = None
    note: str = ""
    error: PblError | None = None


@dataclasses.dataclass(frozen=True)
class Visit:
    """What all files of one call share. None: camera motion handheld where the phone's log is known, else static;
    activity walking; pace unknown; population and height (m) unchanged."""

    subject: str
    session_label: str = session.UNLABELLED
    project: str | None = None
    camera_file: str | Path | None = None
    camera_motion: str | None = None
    activity: str | None = None
    person: int | None = None
    population: str | None = None
    pace: str | None = None
    height_m: float | None = None


#: Key of a selection or plan -> field of `Methods` that names it.
METHOD_FIELDS = {
    "tracking_method": "tracking",
    "keypoint_method": "keypoint",
    "fit_method": "fit",
    "gait_method": "gait",
    "gdi_method": "gdi",
    "norm": "norm",
}
#: Errors that say that the file was not where, or what, it should be.
_FILE_ERRORS = ("VIDEO_MISSING", "VIDEO_CHANGED")


def ingest(
    paths: Sequence[str | Path],
    visit: Visit,
    methods: Methods | None = None,
    files: Sequence[sensors.Sensors] = (),
) -> list[Ingested]:
    """Register videos of one session with the methods they go through. At most one picture of each is decoded.

    Files that are not videos are taken as well: their failure then stands in the table of the stage that meets it,
    with a code and a next step. Missing and empty files are refused at once; the other files are still registered.

    A file that is registered already takes what is given with it: a camera replaces its own, and what was computed with
    that is deleted (keypoints and after), and so does a sensor log of the phone; methods that are named are added to
    its selections and its session's plans. `files`: what belongs to each path, in their order; empty for none at all.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name, a label too long, or one person's number for several videos;
        SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods. Errors of single files are in the result.
    """
    check_visit(visit)
    if visit.person is not None and len(paths) > 1:
        raise PblError(
            "USAGE",
            found=f"person {visit.person} for {len(paths)} videos",
            expected="a person's number with one video: people are numbered anew in each",
            next_step="ingest them without --person, then `pbl choose VIDEO_ID PERSON` where needed",
        )
    if files and len(files) != len(paths):
        raise PblError(
            "USAGE",
            found=f"sensor files for {len(files)} of {len(paths)} videos",
            expected="none, or those of each video in the same order",
            next_step=f"name a file for each video, '{sensors.NONE}' where there is none",
        )
    methods = methods or Methods()
    chosen = resolve(methods)
    more = {key for key, field in METHOD_FIELDS.items() if getattr(methods, field) is not None}
    done = []
    for path, given in zip((Path(p).absolute() for p in paths), files or [sensors.Sensors()] * len(paths), strict=True):
        try:
            done.append(_ingest_one(path, visit, chosen, more, given))
        except PblError as error:
            done.append(Ingested(path, "refused", error=error))
    return done


def check_visit(visit: Visit) -> None:
    """Raise `PblError` USAGE for a subject code that could be a name, or a label too long."""
    check_subject(visit.subject, "pass such a code with --subject")
    for what, text, longest in (
        ("session", visit.session_label, 64),
        ("project", visit.project or "", 32),
        ("activity", visit.activity or "", 32),
        ("pace", visit.pace or "", 32),
        ("population", visit.population or "", 32),
    ):
        check_label(f"--{what}", text, longest)
    check_height(visit.height_m)


def resolve(named: Methods) -> dict[str, str]:
    """Keys of the method rows, defaults filled in. Raises SOLVER_UNKNOWN, NORM_UNKNOWN."""

    def key(table: Any, name: str | None) -> str:
        return resolve_method(table, name or of_stage(table.stage).default)

    points = key(keypoints.KeypointMethod, named.keypoint)
    return {
        "tracking_method": key(tracking.TrackingMethod, named.tracking),
        "subject_method": key(tracking.SubjectMethod, named.subject),
        "keypoint_method": points,
        "fit_method": resolve_method(fit.FitMethod, named.fit) if named.fit else default_fit(points),
        "gait_method": gait_method(named.gait),
        **gdi.resolve(named.gdi, named.norm),
    }


def gait_method(name: str | None) -> str:
    """Key of the method of events of this name, None for the default. Raises SOLVER_UNKNOWN."""
    return resolve_method(gait.GaitEventMethod, name or of_stage(gait.GaitEventMethod.stage).default)


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A video and what comes with it, read and found good; nothing of it is in the tables yet. camera: a row."""

    path: Path
    visit: Visit
    sha256: str
    size: int
    found: sensors.Read
    camera: dict[str, Any] | None


def prepare(path: Path, visit: Visit, given: sensors.Sensors) -> Prepared:
    """Read a video's bytes and its sensor files; no picture is decoded.

    Raises
    ------
    PblError
        VIDEO_MISSING, VIDEO_EMPTY, USAGE (a path that no row can keep), FILE_MISSING, PHONE_LOG.
    """
    from pbl_pipeline.video import sha256_of

    if not os.path.isfile(path):  # not Path.is_file: that raises where a folder on the way may not be entered
        raise PblError(
            "VIDEO_MISSING",
            found="no such file" if not os.path.exists(path) else "it is not a file",
            expected="a video file",
            next_step="check the path",
            key=path,
        )
    check_path(path)
    size = path.stat().st_size
    if size == 0:
        raise PblError(
            "VIDEO_EMPTY",
            found="0 bytes",
            expected="a video file",
            next_step="copy it from the phone again",
            key=path,
        )
    found = sensors.read(given)
    return Prepared(path, visit, sha256_of(path), size, found, None)


def with_camera(one: Prepared) -> Prepared:
    """With the calibration of the visit as a row, for the size of the video's first picture. Raises CAMERA_INVALID."""
    file = one.visit.camera_file
    return dataclasses.replace(one, camera=_camera(file, one.path)) if file else one


def _ingest_one(path: Path, visit: Visit, chosen: dict[str, str], more: set[str], given: sensors.Sensors) -> Ingested:
    one = prepare(path, visit, given)
    known = with_sha256(one.sha256)
    if known:
        return update_known(path, known, visit, chosen, more, one.found)
    one = with_camera(one)
    try:
        return in_transaction(lambda: insert(one, chosen), until=lambda: bool(with_sha256(one.sha256)))
    except DuplicateError:
        known = with_sha256(one.sha256)
        if not known:
            raise
        return update_known(path, known, visit, chosen, more, one.found)


def video_row(
    number: int,
    session_id: int,
    path: str | PurePath,
    sha256: str,
    size: int,
    activity: str | None,
    camera_motion: str,
    camera_id: int | None = None,
) -> dict[str, Any]:
    """A new row of Video; without an activity it is walking."""
    return {
        "video_id": number,
        "session_id": session_id,
        "camera_id": camera_id,
        "video_path": str(path),
        "video_name": PurePath(path).name[-255:],
        "video_sha256": sha256,
        "video_size": size,
        "activity": activity or "walking",
        "camera_motion": camera_motion,
        "video_created": utc_now(),
    }


def insert(one: Prepared, chosen: dict[str, str]) -> Ingested:
    """Register a video that is new. Call it in a transaction."""
    visit = one.visit
    session_id, number = session_of(visit), next_id(video.Video, "video_id")
    motion = visit.camera_motion or ("handheld" if one.found.given.has_log else "static")
    camera_id = camera_id_of(one.camera) if one.camera else None
    row = video_row(number, session_id, one.path, one.sha256, one.size, visit.activity, motion, camera_id)
    video.Video.insert1(row)
    set_condition(number, pace=visit.pace)
    _select(number, session_id, visit.person, chosen)
    notes = sensors.register(number, one.found)
    said = "; ".join([f"subject {visit.subject}, session {visit.session_label}", *notes])
    return Ingested(one.path, "registered", number, said)


def check_path(path: Path) -> None:
    """Raise `PblError` USAGE for a path that cannot be kept in a row."""
    if not is_plain(str(path)):
        raise PblError(
            "USAGE",
            found="a path with line breaks, other control characters, or bytes that are no UTF-8",
            expected="a path of ordinary characters",
            next_step="rename the file or folder",
            key=ascii(str(path)),
        )
    if len(str(path)) > 1000:
        raise PblError(
            "USAGE",
            found=f"a path of {len(str(path))} characters",
            expected="at most 1000",
            next_step="move the file to a shorter path",
            key=path,
        )


def with_sha256(sha256: str) -> dict[str, Any] | None:
    """The row of Video with these bytes, with subject and label of its session; None where there is none."""
    rows = (video.Video * session.Session.proj("subject", "session_label") & {"video_sha256": sha256}).to_dicts()
    return rows[0] if rows else None


def in_transaction(work: Callable[[], T], until: Callable[[], bool] = lambda: False) -> T:
    """Run `work` in a transaction; again where another process inserted the same at that moment, unless `until` holds
    then."""
    for attempt in range(_ATTEMPTS):
        try:
            with video.schema.connection.transaction:  # type: ignore[union-attr]
                return work()
        except DuplicateError:
            if until() or attempt == _ATTEMPTS - 1:
                raise
    raise AssertionError("unreachable")


def check_owner(row: dict[str, Any], subject: str, session_label: str, path: str | Path) -> None:
    """Raise `PblError` VIDEO_DUPLICATE where the bytes of `path` are registered (`row`) for another subject."""
    if row["subject"] != subject:
        owner = f"subject {row['subject']}, session {row['session_label']}"
        raise PblError(
            "VIDEO_DUPLICATE",
            found=f"video_id {row['video_id']} of {owner}, has these bytes",
            expected=f"a recording of subject {subject} (session {session_label}) and of nobody else",
            next_step=f"find out whose recording it is; if not {row['subject']}'s: "
            f"pbl move {row['video_id']} --to {subject}/{session_label}",
            key=path,
        )


def update_known(
    path: Path, row: dict[str, Any], visit: Visit, chosen: dict[str, str], more: set[str], found: sensors.Read
) -> Ingested:
    """Update a registered video: its path if the old one is gone, and the camera, files and methods that were given."""
    check_owner(row, visit.subject, visit.session_label, path)
    number = int(row["video_id"])
    if video.MarkerRecording & {"video_id": number}:
        raise PblError(
            "USAGE",
            found=f"bytes that are registered as laboratory markers, video_id {number}",
            expected="a video",
            next_step="name the file with --markers",
            key=path,
        )
    status, notes = "known", [f"already video_id {number} of subject {row['subject']}, session {row['session_label']}"]
    if str(path) != row["video_path"] and not Path(row["video_path"]).is_file():
        video.Video.update1({"video_id": number, "video_path": str(path), "video_name": path.name[-255:]})
        forget_errors(number, _FILE_ERRORS)
        status = "moved"
        notes.append(f"it was {row['video_path']}, which is gone")
    if visit.camera_file is not None and fit.trials_of([number]):
        raise PblError(
            "USAGE",
            found=f"--camera for one of several cameras, video_id {number}",
            expected="the lens of its rig's calibration",
            next_step="to use another calibration, delete the trial's rows of video.Video and register it with that",
            key=path,
        )
    changes = _new_camera(path, row, visit.camera_file) if visit.camera_file else []
    changes += _new_files(row, visit, found)
    changes += _new_methods(row, chosen, more)
    changes += in_transaction(lambda: set_condition(number, visit.activity, visit.pace))
    changes += new_population(row["subject"], visit.population)
    changes += in_transaction(lambda: set_height(row["subject"], visit.height_m))
    if changes and status == "known":
        status = "updated"
    if visit.camera_motion not in (None, row["camera_motion"]):
        changes.append(f"camera motion {visit.camera_motion} was ignored, it stays {row['camera_motion']}")
    if status == "known" and not changes:
        changes = ["nothing was inserted"]
    return Ingested(path, status, number, "; ".join(notes + changes))


def _new_camera(path: Path, row: dict[str, Any], camera_file: str | Path) -> list[str]:
    """Give a registered video this camera and delete what was computed with another; what was done, in words."""
    number = int(row["video_id"])
    camera = _camera(camera_file, path)
    if camera is None:
        return ["the camera was not attached, because no picture of the video can be decoded"]
    if row["camera_id"] is not None and int(row["camera_id"]) == _known_camera(camera):
        return []
    deleted: dict[str, int] = {}

    def attach() -> None:
        deleted.clear()
        video.Video.update1({"video_id": number, "camera_id": camera_id_of(camera)})
        deleted.update(delete_below(keypoints.Keypoints, (keypoints.Keypoints & {"video_id": number}).keys()))

    in_transaction(attach)
    # What failed with the other camera may do with this one.
    forget_errors(number)
    rows = ", ".join(f"{n} of {name}" for name, n in deleted.items())
    return ["the camera was attached" + (f", and what depends on it was deleted: {rows}" if rows else "")]


def _new_files(row: dict[str, Any], visit: Visit, found: sensors.Read) -> list[str]:
    """Register further files of a known video; what was done, in words."""
    if not found.given:
        return []
    number = int(row["video_id"])
    done: list[str] = []

    def attach() -> None:
        done[:] = sensors.register(number, found)
        # Without a log the camera counted as static; with one it is handheld.
        if done and found.given.has_log and row["camera_motion"] == "static" and visit.camera_motion is None:
            video.Video.update1({"video_id": number, "camera_motion": "handheld"})
            done.append("the camera counts as handheld now")

    in_transaction(attach)
    if done:
        forget_errors(number)
    return done


def new_population(subject: str, population: str | None) -> list[str]:
    """Put a subject into the population that was named; what was done, in words."""
    key = {"subject": subject}
    if not population or (lab.Subject & key).fetch1("population") == population:
        return []
    lab.Population.insert1({"population": population, "population_description": ""}, skip_duplicates=True)
    lab.Subject.update1({**key, "population": population})
    return [f"population of {subject} is {population} now"]


def _new_methods(row: dict[str, Any], chosen: dict[str, str], more: set[str]) -> list[str]:
    """Add the selections and plans of the methods that were named; returns those that are new, in words."""
    with video.schema.connection.transaction:  # type: ignore[union-attr]
        return insert_new(selections([int(row["video_id"])], [int(row["session_id"])], chosen, more))


def insert_new(planned: Sequence[tuple[Any, list[dict[str, Any]]]]) -> list[str]:
    """Insert the rows of selections and plans that are not there; returns those that are new, in words."""
    added = []
    for table, rows in planned:
        for values in rows:
            key = {k: v for k, v in values.items() if k in table.primary_key}
            if not table & key:
                table.insert1(values)
                names = [str(v) for k, v in key.items() if k not in ("video_id", "session_id")]
                added.append(f"{table.__name__} {', '.join(names)} was added")
    return added


def selections(
    videos: Sequence[int], sessions: Sequence[int], chosen: dict[str, str], named: Collection[str]
) -> list[tuple[Any, list[dict[str, Any]]]]:
    """(table, rows) of the selections and plans that videos and their sessions need for the methods whose keys are
    `named`.

    Keypoints are selected for the tracking that is selected with them, or else for every tracking the videos have.
    """
    named = set(named)
    trackings: list[Any] = [{"video_id": v, "tracking_method": chosen["tracking_method"]} for v in videos]
    out: list[tuple[Any, list[dict[str, Any]]]] = []
    if "tracking_method" in named:
        subject = {"subject_method": chosen["subject_method"]}
        out.append((tracking.TrackingSelection, [{**t, **subject} for t in trackings]))
    elif "keypoint_method" in named:
        trackings = (tracking.TrackingSelection & [{"video_id": v} for v in videos]).keys()
    if named & {"tracking_method", "keypoint_method"}:
        points = {"keypoint_method": chosen["keypoint_method"]}
        out.append((keypoints.KeypointSelection, [{**t, **points} for t in trackings]))
    if named & {"keypoint_method", "fit_method"}:
        fitted = [
            {"session_id": s, "fit_method": chosen["fit_method"], "keypoint_method": points}
            for s in sessions
            for points in ([chosen["keypoint_method"]] if "keypoint_method" in named else _keypoint_methods(s))
        ]
        out.append((fit.FitPlan, fitted))
    for table, keys in ((gait.GaitPlan, ("gait_method",)), (gdi.GdiPlan, ("gdi_method", "norm"))):
        if named & set(keys):
            out.append((table, [{"session_id": s, **{k: chosen[k] for k in keys}} for s in sessions]))
    return out


def _keypoint_methods(session_id: int) -> list[str]:
    """Keys of the keypoint methods that are selected for videos of a session."""
    selected = keypoints.KeypointSelection & (video.Video & {"session_id": session_id})
    return sorted((dj.U("keypoint_method") & selected).to_arrays("keypoint_method"))


def forget_errors(video_id: int, codes: Sequence[str] | None = None) -> None:
    """Delete the error rows of a video (with these codes), so that the next populate tries again."""
    for table in computed_tables():
        if "video_id" not in table.primary_key:
            continue
        jobs = jobs_of(table)
        for row in (jobs.errors & {"video_id": video_id}).to_dicts():
            if codes is None or error_code(row["error_message"]) in codes:
                (jobs & {k: row[k] for k in jobs.primary_key}).delete_quick()


def session_of(visit: Visit) -> int:
    """Number of the session of a visit; subject and session are inserted where they are new."""
    if visit.project:
        lab.Project.insert1({"project": visit.project}, skip_duplicates=True)
    subject = {"subject": visit.subject}
    if not lab.Subject & subject:
        more = {"project": visit.project, "population": "unknown", "subject_created": utc_now()}
        lab.Subject.insert1({**subject, **more})
    new_population(visit.subject, visit.population)
    set_height(visit.subject, visit.height_m)
    label = {**subject, "session_label": visit.session_label}
    found = (session.Session & label).to_dicts()
    if found:
        return int(found[0]["session_id"])
    number = next_id(session.Session, "session_id")
    day = {"session_date": day_of(visit.session_label), "session_created": utc_now()}
    session.Session.insert1({"session_id": number, **label, **day})
    return number


def _camera(camera_file: str | Path, path: Path) -> dict[str, Any] | None:
    """Figures of the calibration in a file, for the size of this video's first picture.

    None when no picture can be decoded: the tables will say why, and there is nothing to calibrate.
    """
    from pbl_pipeline.video import calibrated_camera, read_first

    try:
        first = read_first(path)
    except PblError:
        return None
    return camera_row(calibrated_camera(camera_file, first), (first.width_px, first.height_px))


def camera_row(camera: Camera, size_px: tuple[int, int]) -> dict[str, Any]:
    """The library's `Camera` of upright pictures (width, height) as a row of CameraCalibration, without its number."""
    return {
        "camera_width": size_px[0],
        "camera_height": size_px[1],
        "camera_fx": float(camera.matrix[0, 0]),
        "camera_fy": float(camera.matrix[1, 1]),
        "camera_cx": float(camera.matrix[0, 2]),
        "camera_cy": float(camera.matrix[1, 2]),
        "camera_distortion": [float(d) for d in camera.distortion],
        "camera_origin": "measured",
        "camera_note": camera.source.removeprefix("file:").strip()[:255],
        # Only where it is known: calibrations that were stored without it keep their hash.
        **({"camera_focal_sd": sd} if math.isfinite(sd := camera.focal_rel_sd * camera.focal_px) else {}),
    }


def camera_id_of(camera: dict[str, Any]) -> int:
    """Number of the calibration of this `camera_row`, which is inserted where it is new."""
    known = _known_camera(camera)
    if known is not None:
        return known
    number = next_id(lab.CameraCalibration, "camera_id")
    lab.CameraCalibration.insert1({**camera, "camera_id": number, "camera_sha256": _camera_sha256(camera)})
    return number


def _known_camera(camera: dict[str, Any]) -> int | None:
    known = (lab.CameraCalibration & {"camera_sha256": _camera_sha256(camera)}).keys()
    return int(known[0]["camera_id"]) if known else None


def _camera_sha256(camera: dict[str, Any]) -> str:
    return hashlib.sha256(canonical_json(camera).encode()).hexdigest()


def _select(video_id: int, session_id: int, person: int | None, chosen: dict[str, str]) -> None:
    for table, rows in selections([video_id], [session_id], chosen, METHOD_FIELDS):
        table.insert(rows, skip_duplicates=True)  # the session may have its plans already
    if person is not None:
        tracking.set_override({"video_id": video_id, "tracking_method": chosen["tracking_method"]}, person)


def next_id(table: Any, attribute: str, n: int = 1) -> int:
    """The first of n numbers that no row of the table has or has had. Inside a transaction others wait for its end."""
    highest = dj.U().aggr(table, highest=f"max({attribute})").fetch1("highest") or 0
    table.connection.query(
        f"INSERT INTO {lab.Numbered.full_table_name} VALUES (%s, %s)"  # noqa: S608
        " ON DUPLICATE KEY UPDATE numbered_last = GREATEST(numbered_last, %s) + %s",
        args=(attribute, int(highest) + n, int(highest), n),
    )
    return int((lab.Numbered & {"numbered": attribute}).fetch1("numbered_last")) - n + 1
