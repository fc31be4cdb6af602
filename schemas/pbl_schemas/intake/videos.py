"""Videos of one camera, and trials that several calibrated cameras film at once (`pbl ingest --rig`)."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.names import check_label
from pbl_pipeline.temporary import new_folder

from .. import fit, video
from ..datajoint_setup import dj
from ..queues import forget_errors
from ..rows import utc_now
from ..transactions import in_transaction, keep_files, next_id
from .calibrations import camera_id_of, camera_row, known_camera
from .records import File, Methods, Recording, RefusedFile, Registered, VisitRecord, usage
from .registration import register
from .sensors import NONE, Sensors, attach, attach_now, delete_keypoints

if TYPE_CHECKING:
    from pbl_pipeline.video import PhoneLog


@dataclasses.dataclass
class SeveralCameras(Recording):
    """The videos of one trial, one of each camera, and the calibration of the cameras; registered together or not.

    A file belongs to the camera that it is named after (`cam_01.mp4`, `walk.cam_01.mp4`), else the files are in the
    order of the calibration. The trial has the number of the first video. Persons and keypoints of each video are found
    as of any other; the fit is one of all views together.
    """

    videos: Sequence[Path]
    calibration: Path
    visit: VisitRecord
    sensors: Sensors = dataclasses.field(default_factory=Sensors)  # those that the person wore
    motion: ClassVar[str] = video.ONE_OF_SEVERAL  # type: ignore[misc]
    rig: dict[str, Any] = dataclasses.field(default_factory=dict, init=False)  # columns of Rig
    seen_by: list[str] = dataclasses.field(default_factory=list, init=False)  # the camera of each video

    @property
    def paths(self) -> tuple[Path, ...]:
        return tuple(Path(p).absolute() for p in self.videos)

    def check(self, methods: Methods) -> None:
        super().check(methods)
        own_camera = self.visit.camera_file is not None or self.visit.camera_motion not in (None, self.motion)
        if own_camera or self.visit.person is not None:
            raise usage(
                "a camera, its motion or a person's number with --rig",
                "the calibration alone, and cameras that stand still",
            )

    def read(self) -> None:
        """Read the calibration, the bytes and first picture of each video, and the time stamps of its container: videos
        that were not started together are refused.

        Raises `PblError` CAMERA_INVALID (calibration, or files that are not one of each camera), FIT_INPUT (fewer than
        two, or other frames or times), USAGE; RefusedFile: one of the videos cannot be read.
        """
        from pbl_pipeline.keypoints import cameras_of_files, check_same_times
        from pbl_pipeline.video import load_camera_poses, packet_times

        paths, names = self.paths, list(load_camera_poses(self.calibration))
        if len(paths) < 2:
            raise PblError(
                "FIT_INPUT",
                found=f"{len(paths)} video of a trial of several cameras",
                expected="a video of each of at least two cameras",
                next_step="name the videos of all cameras; one camera alone is registered without --rig",
                key=paths[0] if paths else None,
            )
        for name in names:
            check_label("camera of the calibration", name, 64)
        _, self.seen_by = cameras_of_files([p.stem for p in paths], self.calibration)
        files, times = [], []
        for path, name in zip(paths, self.seen_by, strict=True):
            try:
                files.append(dataclasses.replace(File.of(path), camera=_lens(self.calibration, name, path)))
                times.append(packet_times(path))
            except PblError as error:
                raise RefusedFile(path, error) from error
        sha256 = [file.sha256 for file in files]
        if twice := [p for i, p in enumerate(paths) if sha256[i] in sha256[:i]]:
            found = "the same video as two cameras"
            raise usage(found, "a video of each camera", next_step="name each camera's own video", key=twice[0])
        check_same_times(times, paths[0])
        self.files, (self.sensors, _) = tuple(files), self.sensors.read()
        self.rig = {"rig_sha256": sha256_of(self.calibration), "rig_cameras": names}

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        numbers = [int(row["video_id"]) for row in rows]
        views = video.RigView * video.Rig.proj("rig_sha256") & [{"video_id": v} for v in numbers]
        found = {int(r["video_id"]): r for r in views.to_dicts()}
        stated = [(camera, self.rig["rig_sha256"]) for camera in self.seen_by]
        same = len(found) == len(self.files) and len({r["rig_trial"] for r in found.values()}) == 1
        if not same or [(found[v]["rig_camera"], found[v]["rig_sha256"]) for v in numbers] != stated:
            raise usage(
                f"{len(self.files)} videos, {len(numbers)} of them registered "
                f"(video_id {', '.join(map(str, numbers))}), not as these cameras of one trial with this calibration",
                "videos that are new, or registered together with this calibration",
                next_step="register them as they were, or delete these rows of video.Video and register them again",
                key=self.files[0].path,
            )

    def update(self, row: Mapping[str, Any]) -> list[str]:
        return attach_now(int(row["video_id"]), self.sensors) if self.sensors else []

    def check_session(self, session_id: int) -> None:
        check_same_number(session_id, len(self.files), self.files[0].path)

    def insert(self, numbers: Sequence[int]) -> list[str]:
        rig_id = self._rig_id()
        video.RigView.insert(
            {"video_id": number, "rig_id": rig_id, "rig_trial": numbers[0], "rig_camera": camera}
            for number, camera in zip(numbers, self.seen_by, strict=True)
        )
        first, *others = (f"trial {numbers[0]}, camera {camera}" for camera in self.seen_by)
        return ["; ".join((first, *attach(numbers[0], self.sensors, None))), *others]

    def _rig_id(self) -> int:
        """The number of the rig of this calibration, which is registered where it is new."""
        found = (video.Rig & {"rig_sha256": self.rig["rig_sha256"]}).to_arrays("rig_id")
        if len(found):
            return int(found[0])
        number = next_id(video.Rig, "rig_id")
        with new_folder() as folder:
            # Not its own name, which may identify a person.
            copy = Path(shutil.copyfile(self.calibration, folder / "rig.toml"))
            video.Rig.insert1({"rig_id": number, **self.rig, "rig_created": utc_now(), "rig_file": copy})
        return number


def check_same_number(session_id: int, n: int, path: Path) -> None:
    """Raise `PblError` USAGE where the session has trials of another number of cameras: they are fitted together."""
    views = video.RigView * video.Video.proj("session_id") & {"session_id": session_id}
    for row in dj.U("rig_trial").aggr(views, n_views="count(*)").to_dicts(limit=1):
        if int(row["n_views"]) != n:
            raise usage(
                f"{n} cameras in a session whose trial {row['rig_trial']} has {row['n_views']}",
                "the same cameras in all trials of a session: they are fitted with one body",
                next_step="register it in a separate session",
                key=path,
            )


def _lens(calibration: Path, camera: str, path: Path) -> dict[str, Any]:
    from pbl_pipeline.video import load_camera, read_first

    first = read_first(path)
    size = (first.width_px, first.height_px)
    return camera_row(load_camera(calibration, size, camera), size)


@dataclasses.dataclass
class OneCamera(Recording):
    """A video of one camera, with the files that its phone or the person's sensors recorded beside it."""

    path: Path
    visit: VisitRecord
    sensors: Sensors = dataclasses.field(default_factory=Sensors)
    sha256: str = ""  # of its bytes, where they were hashed as they were written
    log: PhoneLog | None = dataclasses.field(default=None, init=False)

    @property
    def paths(self) -> tuple[Path, ...]:
        return (Path(self.path).absolute(),)

    @property
    def motion(self) -> str:
        return self.visit.camera_motion or ("handheld" if self.sensors.has_log else "static")

    def read(self) -> None:
        self.files = (File.of(self.paths[0], self.sha256),)  # no picture is decoded
        self.sensors, self.log = self.sensors.read()

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        number, path = int(rows[0]["video_id"]), self.files[0].path
        if video.MarkerRecording & {"video_id": number}:
            raise usage(
                f"bytes that are registered as laboratory markers, video_id {number}",
                "a video",
                next_step="name the file with --markers",
                key=path,
            )
        if self.sensors.depth is not None and fit.trials_of([number]):
            found = f"--depth for one of several cameras, video_id {number}"
            raise usage(found, "depths of a video of one camera", next_step="leave out --depth", key=path)
        if self.visit.camera_file is not None and fit.trials_of([number]):
            raise usage(
                f"--camera for one of several cameras, video_id {number}",
                "the lens of its rig's calibration",
                next_step="for another calibration, delete the trial's rows of video.Video and register it with that",
                key=path,
            )

    def update(self, row: Mapping[str, Any]) -> list[str]:
        done = self._new_camera(row) if self.visit.camera_file else []
        if self.sensors:
            done += keep_files(lambda: self._new_sensors(row))
        if done:
            forget_errors(int(row["video_id"]))  # a failure with the other camera or log may not recur
        return done

    def _new_camera(self, row: Mapping[str, Any]) -> list[str]:
        self.complete({})
        number, camera = int(row["video_id"]), self.files[0].camera
        if camera is None:
            return ["the camera was not attached, because no picture of the video can be decoded"]
        if row["camera_id"] is not None and int(row["camera_id"]) == known_camera(camera):
            return []

        def replace() -> str:
            video.Video.update1({"video_id": number, "camera_id": camera_id_of(camera)})
            return delete_keypoints(number)

        return ["the camera was attached" + in_transaction(replace)]

    def _new_sensors(self, row: Mapping[str, Any]) -> list[str]:
        number = int(row["video_id"])
        done = attach(number, self.sensors, self.log)
        # Without a log the camera counted as static; with one it is handheld.
        if done and self.sensors.has_log and row["camera_motion"] == "static" and self.visit.camera_motion is None:
            video.Video.update1({"video_id": number, "camera_motion": "handheld"})
            done.append("the camera counts as handheld now")
        return done

    def complete(self, chosen: Mapping[str, str]) -> None:
        if self.visit.camera_file:
            (file,) = self.files
            self.files = (dataclasses.replace(file, camera=_camera(self.visit.camera_file, file.path)),)

    def insert(self, numbers: Sequence[int]) -> list[str]:
        sensors = self.sensors.packed()  # a sheet removed the copies when it had read them
        try:
            return ["; ".join(attach(numbers[0], sensors, self.log))]
        finally:
            if sensors is not self.sensors:
                sensors.remove_copies()


def _camera(camera_file: str | Path, path: Path) -> dict[str, Any] | None:
    """Row of the calibration in a file, for the size of this video's first picture; None when no picture can be
    decoded: the tables will report why, and there is nothing to calibrate."""
    from pbl_pipeline.video import calibrated_camera, read_first

    try:
        first = read_first(path)
    except PblError:
        return None
    return camera_row(calibrated_camera(camera_file, first), (first.width_px, first.height_px))


def ingest(
    paths: Sequence[str | Path], visit: VisitRecord, methods: Methods | None = None, files: Sequence[Sensors] = ()
) -> list[Registered]:
    """Register videos of one visit: `register` for a list of paths. At most one picture of each is decoded.

    Files that are not videos are also accepted: their error then appears in the table of the stage that reads them,
    with a code and a next step. Missing and empty files are refused immediately; the other files are still registered.

    Raises `PblError` USAGE for the number of a person with several videos, or sensor files of some of them; what
    `register` raises. Errors of single files are in the result.

    `files`: sensor files of each path, in their order; empty for none at all.
    """
    if files and len(files) != len(paths):
        raise usage(
            f"sensor files for {len(files)} of {len(paths)} videos",
            "none, or those of each video in the same order",
            next_step=f"name a file for each video, '{NONE}' where there is none",
        )
    check_person(visit.person, len(paths))
    sensors = files or [Sensors()] * len(paths)
    return register([OneCamera(Path(p), visit, s) for p, s in zip(paths, sensors, strict=True)], methods)


def check_person(person: int | None, n: int) -> None:
    """Raise `PblError` USAGE for the number of a person in several videos: people are numbered anew in each."""
    if person is not None and n > 1:
        raise usage(
            f"person {person} for {n} videos",
            "a person's number with one video: people are numbered anew in each",
            next_step="ingest them without --person, then `pbl choose VIDEO_ID PERSON` where needed",
        )
