"""Videos of one camera: what `pbl ingest` registers where nothing else is said."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from .. import fit, keypoints, video
from ..jobs import forget_errors
from ..rows import delete_below
from ..transactions import in_transaction
from .calibrations import camera_id_of, camera_row, known_camera
from .records import File, Methods, Read, Recording, Registered, Visit, check_video, usage
from .registration import register
from .sensors import NONE, Sensors, attach

if TYPE_CHECKING:
    from pbl_pipeline.video import PhoneLog


@dataclasses.dataclass(frozen=True)
class OneCamera(Recording):
    """A video of one camera, with the files that its phone or the person's sensors recorded beside it.

    `file`: where its bytes are known, as in an archive; the video is not opened then.
    """

    path: Path
    visit: Visit
    sensors: Sensors = dataclasses.field(default_factory=Sensors)
    file: File | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The video."""
        return (Path(self.path).absolute(),)

    def read(self) -> ReadVideo:
        """Read the video's bytes and its sensor files; no picture is decoded.

        Raises
        ------
        PblError
            VIDEO_MISSING, VIDEO_EMPTY, USAGE (a path that no row can hold), FILE_MISSING, PHONE_LOG.
        """
        (path,) = self.paths
        if self.file is None:
            check_video(path)
        motion = self.visit.camera_motion or ("handheld" if self.sensors.has_log else "static")
        log = self.sensors.read()
        file = self.file or File.of(path)
        return ReadVideo(self.visit, (file,), motion, (None,), self.sensors, log)


@dataclasses.dataclass
class ReadVideo(Read):
    """A video of one camera that was read."""

    sensors: Sensors
    log: PhoneLog | None

    def complete(self, chosen: Mapping[str, str]) -> None:
        """Read the calibration for the size of the first picture. Raises `PblError` CAMERA_INVALID."""
        if self.visit.camera_file:
            self.cameras = (_camera(self.visit.camera_file, self.files[0].path),)

    def insert(self, numbers: Sequence[int]) -> list[str]:
        """Insert the files of its sensors."""
        return ["; ".join(attach(numbers[0], self.sensors, self.log))]

    def check_known(self, rows: Sequence[Mapping[str, Any] | None]) -> None:
        """Raise `PblError` USAGE where the bytes are laboratory markers, or a new calibration is for one of several
        cameras."""
        number, path = int(rows[0]["video_id"]) if rows[0] else 0, self.files[0].path
        if video.MarkerRecording & {"video_id": number}:
            raise usage(
                f"bytes that are registered as laboratory markers, video_id {number}",
                "a video",
                path,
                "name the file with --markers",
            )
        if self.visit.camera_file is not None and fit.trials_of([number]):
            raise usage(
                f"--camera for one of several cameras, video_id {number}",
                "the lens of its rig's calibration",
                path,
                "to use another calibration, delete the trial's rows of video.Video and register it with that",
            )

    def update(self, row: Mapping[str, Any]) -> list[str]:
        """Give a registered video the calibration and the sensor files; delete what was computed with others."""
        changes = self._new_camera(row) if self.visit.camera_file else []
        if not self.sensors:
            return changes
        done = in_transaction(lambda: self._new_sensors(row))
        if done:
            forget_errors(int(row["video_id"]))
        return changes + done

    def _new_camera(self, row: Mapping[str, Any]) -> list[str]:
        self.complete({})
        number, camera = int(row["video_id"]), self.cameras[0]
        if camera is None:
            return ["the camera was not attached, because no picture of the video can be decoded"]
        if row["camera_id"] is not None and int(row["camera_id"]) == known_camera(camera):
            return []

        def replace() -> dict[str, int]:
            video.Video.update1({"video_id": number, "camera_id": camera_id_of(camera)})
            return delete_below(keypoints.Keypoints, (keypoints.Keypoints & {"video_id": number}).keys())

        deleted = in_transaction(replace)
        forget_errors(number)  # what failed with the other camera may succeed with this one
        rows = ", ".join(f"{n} of {name}" for name, n in deleted.items())
        return ["the camera was attached" + (f", and what depends on it was deleted: {rows}" if rows else "")]

    def _new_sensors(self, row: Mapping[str, Any]) -> list[str]:
        number = int(row["video_id"])
        done = attach(number, self.sensors, self.log)
        # Without a log the camera counted as static; with one it is handheld.
        if done and self.sensors.has_log and row["camera_motion"] == "static" and self.visit.camera_motion is None:
            video.Video.update1({"video_id": number, "camera_motion": "handheld"})
            done.append("the camera counts as handheld now")
        return done


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
    paths: Sequence[str | Path], visit: Visit, methods: Methods | None = None, files: Sequence[Sensors] = ()
) -> list[Registered]:
    """Register videos of one visit: `register` for a list of paths. At most one picture of each is decoded.

    Files that are not videos are taken as well: their failure then stands in the table of the stage that meets it,
    with a code and a next step. Missing and empty files are refused at once; the other files are still registered.

    Parameters
    ----------
    files
        Sensor files of each path, in their order; empty for none at all.

    Raises
    ------
    PblError
        USAGE for the number of a person with several videos, or sensor files of some of them; what `register` raises.
        Errors of single files are in the result.
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
