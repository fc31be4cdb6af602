"""Registering video files: what `pbl ingest` does."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from datajoint.errors import DuplicateError

from pbl_pipeline.errors import PblError

from . import fit, gait, gdi, keypoints, lab, session, tracking, video
from ._base import library, resolve_method, utc_now

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


def ingest(
    paths: Sequence[str | Path],
    *,
    subject: str,
    session_label: str = session.UNLABELLED,
    project: str | None = None,
    camera_file: str | Path | None = None,
    camera_motion: str = "static",
    activity: str = "walking",
    person: int | None = None,
    methods: Methods | None = None,
) -> list[Ingested]:
    """Register videos of one session with the methods they go through. Nothing is decoded.

    Files that are not videos are taken as well: their failure then stands in the table of the stage that meets it,
    with a code and a next step. Missing and empty files are refused at once; the other files are still registered.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name; SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods; the camera
        file's own errors. Errors of single files are in the result.
    """
    if not _SUBJECT.fullmatch(subject):
        raise PblError(
            "USAGE",
            found=f"subject code {subject!r}",
            expected="a pseudonymous code of letters, digits, '-', '_' and '.', at most 32 long (never a name)",
            next_step="pass such a code with --subject",
        )
    chosen = resolve(methods or Methods())
    done = []
    for path in (Path(p).absolute() for p in paths):
        try:
            done.append(
                _ingest_one(path, subject, session_label, project, camera_file, camera_motion, activity, person, chosen)
            )
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


def _ingest_one(
    path: Path,
    subject: str,
    session_label: str,
    project: str | None,
    camera_file: str | Path | None,
    camera_motion: str,
    activity: str,
    person: int | None,
    chosen: dict[str, str],
) -> Ingested:
    if not path.is_file():
        raise PblError(
            "VIDEO_MISSING",
            found="no such file" if not path.exists() else "it is not a file",
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
    row = {
        "video_path": str(path),
        "video_name": path.name[-255:],
        "video_sha256": sha256,
        "video_size": size,
        "activity": activity,
        "camera_motion": camera_motion,
        "video_created": utc_now(),
    }
    # Numbers are taken as the highest plus one; another process that takes the same one makes us take the next.
    for attempt in range(20):
        try:
            with video.schema.connection.transaction:  # type: ignore[union-attr]
                row["session_id"] = _session(subject, session_label, project)
                row["camera_id"] = _camera(camera_file, path) if camera_file else None
                row["video_id"] = next_id(video.Video, "video_id")
                video.Video.insert1(row)
                _select(row["video_id"], row["session_id"], person, chosen)
            return Ingested(path, "registered", row["video_id"], f"subject {subject}, session {session_label}")
        except DuplicateError:
            known = _with_sha256(sha256)
            if known:
                return _known(path, known)
            if attempt == 19:
                raise
    raise AssertionError("unreachable")


def _with_sha256(sha256: str) -> dict[str, Any] | None:
    rows = (video.Video * session.Session.proj("subject", "session_label") & {"video_sha256": sha256}).to_dicts()
    return rows[0] if rows else None


def _known(path: Path, row: dict[str, Any]) -> Ingested:
    where = f"video_id {row['video_id']} of subject {row['subject']}, session {row['session_label']}"
    if str(path) != row["video_path"] and not Path(row["video_path"]).is_file():
        video.Video.update1({"video_id": row["video_id"], "video_path": str(path), "video_name": path.name[-255:]})
        return Ingested(path, "moved", int(row["video_id"]), f"{where}; it was {row['video_path']}, which is gone")
    return Ingested(path, "known", int(row["video_id"]), f"already {where}; nothing was inserted")


def _session(subject: str, label: str, project: str | None) -> int:
    now = utc_now()
    if project:
        lab.Project.insert1({"project": project}, skip_duplicates=True)
    if not lab.Subject & {"subject": subject}:
        lab.Subject.insert1({"subject": subject, "project": project, "population": "unknown", "subject_created": now})
    found = (session.Session & {"subject": subject, "session_label": label}).to_dicts()
    if found:
        return int(found[0]["session_id"])
    number = next_id(session.Session, "session_id")
    session.Session.insert1(
        {
            "session_id": number,
            "subject": subject,
            "session_label": label,
            "session_date": _date(label),
            "session_created": now,
        }
    )
    return number


def _date(label: str) -> datetime.date | None:
    try:
        return datetime.date.fromisoformat(label)
    except ValueError:
        return None


def _camera(camera_file: str | Path, path: Path) -> int:
    """Row of the calibration in a file. Intrinsics hold for one picture size, so the video's header is read."""
    size = library("video").image_size_of(path)
    camera = library("video").load_camera(camera_file, size)
    figures = {
        "camera_width": size[0],
        "camera_height": size[1],
        "camera_fx": float(camera.matrix[0, 0]),
        "camera_fy": float(camera.matrix[1, 1]),
        "camera_cx": float(camera.matrix[0, 2]),
        "camera_cy": float(camera.matrix[1, 2]),
        "camera_distortion": [float(d) for d in camera.distortion],
    }
    sha256 = hashlib.sha256(json.dumps(figures, sort_keys=True).encode()).hexdigest()
    known = (lab.CameraCalibration & {"camera_sha256": sha256}).keys()
    if known:
        return int(known[0]["camera_id"])
    number = next_id(lab.CameraCalibration, "camera_id")
    origin, _, note = camera.source.partition(":")
    lab.CameraCalibration.insert1(
        {
            **figures,
            "camera_id": number,
            "camera_origin": origin if origin in ("measured", "exif", "preset", "estimated") else "measured",
            "camera_note": (note.strip() or str(camera_file))[:255],
            "camera_sha256": sha256,
        }
    )
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
    from ._base import dj

    highest = dj.U().aggr(table, highest=f"max({attribute})").fetch1("highest")
    return 1 if highest is None else int(highest) + 1
