"""Registering a trial that several calibrated cameras film at once: what `pbl ingest --rig` does."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from . import fit, ingest, lab, sensors, video  # noqa: F401  a definition refers to lab
from ._datajoint import DuplicateError, dj
from .conditions import set_condition
from .ingest import Ingested, Methods, Visit
from .rows import utc_now
from .stored_files import new_folder


def ingest_rig(
    paths: Sequence[str | Path], calibration: str | Path, visit: Visit, methods: Methods | None = None
) -> list[Ingested]:
    """Register the videos of one trial, one of each camera, in one transaction: all of them or none.

    A file belongs to the camera that it is named after (`cam_01.mp4`, `walk.cam_01.mp4`), else the files are in the
    order of the calibration. One picture of each is decoded, and the time stamps of its container are read: videos that
    were not started together are refused before anything is computed. A copy of the calibration is kept in the store.
    Persons and keypoints of each video are found as of any other; the fit is one of all views together. The trial has
    the number of the first video. The same files again take activity, pace, population and the methods that are named.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name, a label too long, or a visit with a camera or a person's number;
        SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods. What is wrong with the trial stands in each result:
        CAMERA_INVALID (calibration, or files that are not one of each camera), FIT_INPUT (fewer than two, or other
        frames or times), VIDEO_DUPLICATE, USAGE; a video's own error in its own result.
    """
    ingest.check_visit(visit)
    if visit.camera_file is not None or visit.person is not None or visit.camera_motion not in (None, _MOTION):
        raise _usage(
            "a camera, its motion or a person's number with --rig",
            "the calibration alone, and cameras that stand still",
        )
    methods = methods or Methods()
    chosen = ingest.resolve(methods)
    files = [Path(p).absolute() for p in paths]
    try:
        return _ingest(files, Path(calibration), visit, methods, chosen)
    except _OfVideo as wrong:
        return [Ingested(p, "refused", error=wrong.error if p == wrong.path else _with(p, wrong)) for p in files]
    except PblError as error:
        return [Ingested(p, "refused", error=error) for p in files]


_MOTION = video.ONE_OF_SEVERAL


class _OfVideo(Exception):
    """One video of the trial cannot be registered."""

    def __init__(self, path: Path, error: PblError) -> None:
        super().__init__(str(error))
        self.path, self.error = path, error


def _with(path: Path, wrong: _OfVideo) -> PblError:
    return _usage(
        f"{path.name} with {wrong.path.name}, which is refused ({wrong.error.code})",
        "all videos of the trial",
        path,
        "correct that one, then register the trial again",
    )


def _ingest(
    files: list[Path], calibration: Path, visit: Visit, methods: Methods, chosen: dict[str, str]
) -> list[Ingested]:
    from pbl_pipeline.keypoints import cameras_of_files, check_same_times
    from pbl_pipeline.video import load_camera_poses, packet_times, read_first, sha256_of

    cameras = list(load_camera_poses(calibration))
    if len(files) < 2:
        raise PblError(
            "FIT_INPUT",
            found=f"{len(files)} video of a trial of several cameras",
            expected="a video of each of at least two cameras",
            next_step="name the videos of all cameras; one camera alone is registered without --rig",
            key=files[0] if files else None,
        )
    for camera in cameras:
        check_label("camera of the calibration", camera, 64)
    _, seen_by = cameras_of_files([p.stem for p in files], calibration)
    sha256, lenses, times = [], [], []
    for path, camera in zip(files, seen_by, strict=True):
        try:
            ingest.check_path(path)
            sha256.append(sha256_of(path))
            lenses.append(_lens(calibration, camera, read_first(path)))
            times.append(packet_times(path))
        except PblError as error:
            raise _OfVideo(path, error) from error
    if len(set(sha256)) < len(sha256):
        twice = next(p for i, p in enumerate(files) if sha256[i] in sha256[:i])
        raise _usage("the same video as two cameras", "a video of each camera", twice, "name each camera's own video")
    check_same_times(times, files[0])
    about = {"sha256": sha256_of(calibration), "cameras": cameras}
    if any(known := [ingest.with_sha256(s) for s in sha256]):
        return _known(files, known, visit, chosen, methods, about["sha256"], seen_by)
    numbers: list[int] = []

    def insert() -> None:
        session_id = ingest.session_of(visit)
        check_same_number(session_id, len(files), files[0])
        rig_id = _rig_id(calibration, about)
        first = ingest.next_id(video.Video, "video_id", len(files))
        numbers[:] = range(first, first + len(files))
        for number, path, sha, lens in zip(numbers, files, sha256, lenses, strict=True):
            size, camera_id = path.stat().st_size, ingest.camera_id_of(lens)
            video.Video.insert1(
                ingest.video_row(number, session_id, path, sha, size, visit.activity, _MOTION, camera_id)
            )
        video.RigView.insert(
            {"video_id": number, "rig_id": rig_id, "rig_trial": first, "rig_camera": camera}
            for number, camera in zip(numbers, seen_by, strict=True)
        )
        set_condition(first, pace=visit.pace)
        for table, rows in ingest.selections(numbers, [session_id], chosen, ingest.METHOD_FIELDS):
            table.insert(rows, skip_duplicates=True)  # the session may have its plans already

    try:
        ingest.in_transaction(insert, until=lambda: any(ingest.with_sha256(s) for s in sha256))
    except DuplicateError:
        if not any(known := [ingest.with_sha256(s) for s in sha256]):
            raise
        return _known(files, known, visit, chosen, methods, about["sha256"], seen_by)
    said = f"subject {visit.subject}, session {visit.session_label}; trial {numbers[0]}, camera "
    return [
        Ingested(path, "registered", number, said + camera)
        for path, number, camera in zip(files, numbers, seen_by, strict=True)
    ]


def _lens(calibration: Path, camera: str, first: Any) -> dict[str, Any]:
    """The lens of a camera as a row of CameraCalibration, for the size of its video's first picture."""
    from pbl_pipeline.video import load_camera

    size = (first.width_px, first.height_px)
    return ingest.camera_row(load_camera(calibration, size, camera), size)


def _rig_id(calibration: Path, about: dict[str, Any]) -> int:
    """The number of the rig of these bytes, which is registered where it is new."""
    found = (video.Rig & {"rig_sha256": about["sha256"]}).to_arrays("rig_id")
    if len(found):
        return int(found[0])
    number = ingest.next_id(video.Rig, "rig_id")
    with new_folder() as folder:
        # Not its own name, which may name somebody.
        copy = Path(shutil.copyfile(calibration, folder / "rig.toml"))
        row = {"rig_id": number, "rig_sha256": about["sha256"], "rig_cameras": about["cameras"]}
        video.Rig.insert1({**row, "rig_created": utc_now(), "rig_file": copy})
    return number


def check_same_number(session_id: int, n: int, path: Path) -> None:
    """Raise `PblError` USAGE where the session has trials of another number of cameras: they are fitted together."""
    views = video.RigView * video.Video.proj("session_id") & {"session_id": session_id}
    for row in dj.U("rig_trial").aggr(views, n_views="count(*)").to_dicts(limit=1):
        if int(row["n_views"]) != n:
            raise _usage(
                f"{n} cameras in a session whose trial {row['rig_trial']} has {row['n_views']}",
                "the same cameras in all trials of a session: they are fitted with one body",
                path,
                "register it in a session of its own",
            )


def _known(
    files: list[Path],
    known: Sequence[dict[str, Any] | None],
    visit: Visit,
    chosen: dict[str, str],
    methods: Methods,
    rig_sha256: str,
    seen_by: Sequence[str],
) -> list[Ingested]:
    """Update the videos of a registered trial. Raises `PblError` where they are not registered as these views of it."""
    for path, row in zip(files, known, strict=True):
        if row is not None:
            ingest.check_owner(row, visit.subject, visit.session_label, path)
    numbers = [int(row["video_id"]) for row in known if row is not None]
    views = video.RigView * video.Rig.proj("rig_sha256") & [{"video_id": v} for v in numbers]
    found = {int(r["video_id"]): r for r in views.to_dicts()}
    trials = {r["rig_trial"] for r in found.values()}
    same = len(found) == len(files) == len(numbers) and len(trials) == 1
    same = same and all(
        (found[v]["rig_camera"], found[v]["rig_sha256"]) == (camera, rig_sha256)
        for v, camera in zip(numbers, seen_by, strict=True)
    )
    if not same:
        raise _usage(
            f"{len(files)} videos, {len(numbers)} of them registered (video_id {', '.join(map(str, numbers))}), not as "
            "these cameras of one trial with this calibration",
            "videos that are new, or registered together with this calibration",
            files[0],
            "register them as they were, or delete these rows of video.Video and register them again",
        )
    more = {key for key, field in ingest.METHOD_FIELDS.items() if getattr(methods, field) is not None}
    nothing = sensors.read(sensors.Sensors())
    return [
        ingest.update_known(path, row, visit, chosen, more, nothing)
        for path, row in zip(files, known, strict=True)
        if row is not None
    ]


def _usage(found: str, expected: str, key: object = None, next_step: str = "see `pbl ingest --help`") -> PblError:
    return PblError("USAGE", found=found, expected=expected, next_step=next_step, key=key)
