"""Registering video files: what `pbl ingest` does."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import canonical_json

from . import fit, gait, gdi, keypoints, lab, session, tracking, video
from ._base import DuplicateError, dj, library, resolve_method, utc_now

_ATTEMPTS = 20
_SUBJECT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")


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
    """What became of one path: "registered", "known" (nothing inserted), "moved" (path updated) or "refused"."""

    path: Path
    status: str
    video_id: int | None = None
    note: str = ""
    error: PblError | None = None


@dataclasses.dataclass(frozen=True)
class Visit:
    """What all files of one call share."""

    subject: str
    session_label: str = session.UNLABELLED
    project: str | None = None
    camera_file: str | Path | None = None
    camera_motion: str = "static"
    activity: str = "walking"
    person: int | None = None


def ingest(paths: Sequence[str | Path], visit: Visit, methods: Methods | None = None) -> list[Ingested]:
    """Register videos of one session with the methods they go through. At most one picture of each is decoded.

    Files that are not videos are taken as well: their failure then stands in the table of the stage that meets it,
    with a code and a next step. Missing and empty files are refused at once; the other files are still registered.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name; SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods. Errors of
        single files are in the result.
    """
    if not _SUBJECT.fullmatch(visit.subject):
        raise PblError(
            "USAGE",
            found=f"subject code {visit.subject!r}",
            expected="a pseudonymous code of letters, digits, '-', '_' and '.', at most 32 long (never a name)",
            next_step="pass such a code with --subject",
        )
    chosen = resolve(methods or Methods())
    done = []
    for path in (Path(p).absolute() for p in paths):
        try:
            done.append(_ingest_one(path, visit, chosen))
        except PblError as error:
            done.append(Ingested(path, "refused", error=error))
    return done


def resolve(methods: Methods) -> dict[str, str]:
    """Keys of the method rows, defaults filled in. Raises SOLVER_UNKNOWN, NORM_UNKNOWN."""
    names = library("tracking"), library("keypoints"), library("fit"), library("gait")
    tracks, points, fits, gaits = names
    return {
        "tracking_method": resolve_method(tracking.TrackingMethod, "tracking", methods.tracking or tracks.DEFAULT),
        "subject_method": resolve_method(tracking.SubjectMethod, "subject", methods.subject or tracks.SUBJECT_DEFAULT),
        "keypoint_method": resolve_method(keypoints.KeypointMethod, "keypoint", methods.keypoint or points.DEFAULT),
        "fit_method": resolve_method(fit.FitMethod, "fit", methods.fit or fits.DEFAULT),
        "gait_method": resolve_method(gait.GaitEventMethod, "gait", methods.gait or gaits.DEFAULT_EVENT_PARAMSET),
        **gdi.resolve(methods.gdi, methods.norm),
    }


def _ingest_one(path: Path, visit: Visit, chosen: dict[str, str]) -> Ingested:
    if not os.path.isfile(path):  # not Path.is_file: that raises where a folder on the way may not be entered
        raise PblError(
            "VIDEO_MISSING",
            found="no such file" if not os.path.exists(path) else "it is not a file",
            expected="a video file",
            next_step="check the path",
            key=path,
        )
    if len(str(path)) > 1000:
        raise PblError(
            "USAGE",
            found=f"a path of {len(str(path))} characters",
            expected="at most 1000",
            next_step="move the file to a shorter path",
            key=path,
        )
    size = path.stat().st_size
    if size == 0:
        raise PblError(
            "VIDEO_EMPTY",
            found="0 bytes",
            expected="a video file",
            next_step="copy it from the phone again",
            key=path,
        )
    sha256 = library("video").sha256_of(path)
    known = _with_sha256(sha256)
    if known:
        return _known(path, known)
    camera = _camera(visit.camera_file, path) if visit.camera_file else None
    row = {
        "video_path": str(path),
        "video_name": path.name[-255:],
        "video_sha256": sha256,
        "video_size": size,
        "activity": visit.activity,
        "camera_motion": visit.camera_motion,
        "video_created": utc_now(),
    }
    # Numbers are taken as the highest plus one; where another process took the same one, we try again.
    for attempt in range(_ATTEMPTS):
        try:
            with video.schema.connection.transaction:  # type: ignore[union-attr]
                row["session_id"] = _session(visit)
                row["camera_id"] = _camera_id(camera) if camera else None
                row["video_id"] = next_id(video.Video, "video_id")
                video.Video.insert1(row)
                _select(row["video_id"], row["session_id"], visit.person, chosen)
        except DuplicateError:
            known = _with_sha256(sha256)
            if known:
                return _known(path, known)
            if attempt == _ATTEMPTS - 1:
                raise
        else:
            break
    return Ingested(path, "registered", row["video_id"], f"subject {visit.subject}, session {visit.session_label}")


def _with_sha256(sha256: str) -> dict[str, Any] | None:
    rows = (video.Video * session.Session.proj("subject", "session_label") & {"video_sha256": sha256}).to_dicts()
    return rows[0] if rows else None


def _known(path: Path, row: dict[str, Any]) -> Ingested:
    where = f"video_id {row['video_id']} of subject {row['subject']}, session {row['session_label']}"
    if str(path) != row["video_path"] and not Path(row["video_path"]).is_file():
        video.Video.update1({"video_id": row["video_id"], "video_path": str(path), "video_name": path.name[-255:]})
        return Ingested(path, "moved", int(row["video_id"]), f"{where}; it was {row['video_path']}, which is gone")
    return Ingested(path, "known", int(row["video_id"]), f"already {where}; nothing was inserted")


def _session(visit: Visit) -> int:
    if visit.project:
        lab.Project.insert1({"project": visit.project}, skip_duplicates=True)
    subject = {"subject": visit.subject}
    if not lab.Subject & subject:
        more = {"project": visit.project, "population": "unknown", "subject_created": utc_now()}
        lab.Subject.insert1({**subject, **more})
    label = {**subject, "session_label": visit.session_label}
    found = (session.Session & label).to_dicts()
    if found:
        return int(found[0]["session_id"])
    number = next_id(session.Session, "session_id")
    day = {"session_date": _date(visit.session_label), "session_created": utc_now()}
    session.Session.insert1({"session_id": number, **label, **day})
    return number


def _date(label: str) -> datetime.date | None:
    try:
        return datetime.date.fromisoformat(label)
    except ValueError:
        return None


def _camera(camera_file: str | Path, path: Path) -> dict[str, Any] | None:
    """Figures of the calibration in a file, for the size of this video's first picture.

    None when no picture can be decoded: the tables will say why, and there is nothing to calibrate.
    """
    frames = library("video").read_frames(path, stop=1)
    try:
        height, width = next(iter(frames)).image.shape[:2]
    except PblError:
        return None
    camera = library("video").load_camera(camera_file, (int(width), int(height)))
    return {
        "camera_width": int(width),
        "camera_height": int(height),
        "camera_fx": float(camera.matrix[0, 0]),
        "camera_fy": float(camera.matrix[1, 1]),
        "camera_cx": float(camera.matrix[0, 2]),
        "camera_cy": float(camera.matrix[1, 2]),
        "camera_distortion": [float(d) for d in camera.distortion],
        "camera_origin": "measured",
        "camera_note": camera.source.removeprefix("file:").strip()[:255],
    }


def _camera_id(camera: dict[str, Any]) -> int:
    sha256 = hashlib.sha256(canonical_json(camera).encode()).hexdigest()
    known = (lab.CameraCalibration & {"camera_sha256": sha256}).keys()
    if known:
        return int(known[0]["camera_id"])
    number = next_id(lab.CameraCalibration, "camera_id")
    lab.CameraCalibration.insert1({**camera, "camera_id": number, "camera_sha256": sha256})
    return number


def _select(video_id: int, session_id: int, person: int | None, chosen: dict[str, str]) -> None:
    tracked = {"video_id": video_id, "tracking_method": chosen["tracking_method"]}
    tracking.TrackingSelection.insert1({**tracked, "subject_method": chosen["subject_method"]})
    keypoints.KeypointSelection.insert1({**tracked, "keypoint_method": chosen["keypoint_method"]})
    if person is not None:
        tracking.set_override(tracked, person)
    planned = {"session_id": session_id}
    fit.FitPlan.insert1({**planned, "fit_method": chosen["fit_method"]}, skip_duplicates=True)
    gait.GaitPlan.insert1({**planned, "gait_method": chosen["gait_method"]}, skip_duplicates=True)
    gdi.GdiPlan.insert1({**planned, "gdi_method": chosen["gdi_method"], "norm": chosen["norm"]}, skip_duplicates=True)


def next_id(table: Any, attribute: str) -> int:
    """The highest number in use plus one."""
    highest = dj.U().aggr(table, highest=f"max({attribute})").fetch1("highest")
    return 1 if highest is None else int(highest) + 1
