"""Videos of one camera: what `pbl ingest` registers where nothing else is said."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from .. import fit, video
from ..jobs import forget_errors
from ..transactions import in_transaction
from .calibrations import camera_id_of, camera_row, known_camera
from .records import File, Methods, Recording, Registered, VisitRecord, usage
from .registration import register
from .sensors import NONE, Sensors, attach, delete_keypoints

if TYPE_CHECKING:
    from pbl_pipeline.video import PhoneLog


@dataclasses.dataclass
class OneCamera(Recording):
    """A video of one camera, with the files that its phone or the person's sensors recorded beside it."""

    path: Path
    visit: VisitRecord
    sensors: Sensors = dataclasses.field(default_factory=Sensors)
    log: PhoneLog | None = dataclasses.field(default=None, init=False)

    @property
    def paths(self) -> tuple[Path, ...]:
        return (Path(self.path).absolute(),)

    @property
    def motion(self) -> str:
        return self.visit.camera_motion or ("handheld" if self.sensors.has_log else "static")

    def read(self) -> None:
        self.files = (File.of(*self.paths),)  # no picture is decoded
        self.log = self.sensors.read()

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        number, path = int(rows[0]["video_id"]), self.files[0].path
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
        done = self._new_camera(row) if self.visit.camera_file else []
        if self.sensors:
            done += in_transaction(lambda: self._new_sensors(row))
        if done:
            forget_errors(int(row["video_id"]))  # what failed with the other camera or log may succeed with this one
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
        return ["; ".join(attach(numbers[0], self.sensors, self.log))]


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

    Files that are not videos are taken as well: their failure then stands in the table of the stage that meets it,
    with a code and a next step. Missing and empty files are refused at once; the other files are still registered.

    Raises `PblError` USAGE for the number of a person with several videos, or sensor files of some of them; what
    `register` raises. Errors of single files are in the result.

    Parameters
    ----------
    files
        Sensor files of each path, in their order; empty for none at all.
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
