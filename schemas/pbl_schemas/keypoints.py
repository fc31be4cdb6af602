"""Keypoints of the measured person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.names import shortened
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import definition, from_row, to_row
from pbl_pipeline.results.people import KeypointFigures
from pbl_pipeline.results.video_facts import Intrinsics
from pbl_pipeline.temporary import new_folder

from . import tracking, video
from .datajoint_setup import dj
from .method_rows import method_row, method_table
from .origin import Origin, computes, origin_columns
from .record_parts import part_of
from .rows import one
from .stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline import keypoints as lib
    from pbl_pipeline.qc import Check
    from pbl_pipeline.video import Camera

schema = dj.Schema()


KeypointMethod = schema(method_table("KeypointMethod", "keypoints", "keypoint", "keypoint detection"))


@schema
class KeypointSelection(dj.Manual):
    definition = """
    # which tracked videos get keypoints by which method
    -> tracking.TrackingSelection
    -> KeypointMethod
    """


@schema
class Keypoints(dj.Computed):
    definition = f"""
    # keypoints of the measured person in all frames
    -> tracking.SubjectChoice
    -> KeypointSelection
    ---
    keypoints_person_id   : int16              # number of the measured person in the tracking
    {definition(KeypointFigures)}
    keypoints_camera_id=null : int32           # calibration that was used (lab.CameraCalibration), null where none was there
    phone_log=null        : varchar(1000)      # the phone's sensor log and how its clock was brought to the video's, null without
    keypoints_file        : <object@arrays>   # keypoints.npz: time_s (T) s, xy_px (T,J,2) px, xyz_cam_m (T,J,3) m, confidence (T,J) 0..1, box_px (T,4) px, camera; docs/files.md
    index (camera_kind)
    {origin_columns("keypoints")}
    """  # noqa: E501

    Check = part_of("Check", Quality, "keypoints", "quality checks of what was seen")

    @property
    def key_source(self) -> Any:
        """Only where a person is chosen: a video that waits for a choice has no row and no error."""
        return tracking.chosen().proj() * KeypointSelection.proj() - video.NotUsable

    def make_fetch(self, key: dict) -> tuple:
        probed, times = video.probed(key)
        person = int(one(tracking.chosen() & key, "chosen_person_id"))
        logs = (video.PhoneAttitude & key).to_dicts()
        log = (logs[0]["attitude_name"], file_ref(logs[0]["attitude_file"])) if logs else None
        seen = person, tracking.tracks_of(key), video.camera_of(probed), log
        return probed, times, *seen, method_row(KeypointMethod, key)

    @computes
    def make_compute(
        self,
        key: dict,
        probed: Mapping[str, Any],
        times: dict,
        person: int,
        tracks: tuple,
        camera: Mapping[str, Any] | None,
        log: tuple | None,
        method: Mapping[str, Any],
    ) -> tuple[lib.Keypoints, int, str, str | None, tuple[Check, ...], str | None, int | None]:
        from pbl_pipeline.keypoints import check_keypoints, detect_keypoints
        from pbl_pipeline.video import attitude_of, check_timing, find_camera, read_phone_log

        path, info = video.read_probed(probed, times, key)
        detector = methods.stored(**method)
        attitude = None
        if log is not None:
            attitude = attitude_of(read_stored(log[1], read_phone_log), Path(log[0]), info)
        everybody = tracking.load_tracking(*tracks)
        view = camera_of_row(camera) if camera else find_camera(info)
        found = detect_keypoints(path, everybody, person, view, params=detector)
        if attitude is not None:
            found = found.with_attitude(attitude)
        checks = (*check_timing(info), *check_keypoints(found))
        source = None if attitude is None else attitude.source
        camera_id = int(camera["camera_id"]) if camera else None
        model = getattr(detector.params, "model_sha256", None)
        return found, person, detector.hash, model, checks, source, camera_id

    def make_insert(
        self,
        key: dict,
        found: lib.Keypoints,
        person: int,
        sha: str,
        model: str | None,
        checks: Sequence[Check],
        log: str | None,
        camera_id: int | None,
        origin: Origin,
    ) -> None:
        with new_folder() as folder:
            found.save(folder / "keypoints.npz")
            self.insert1(
                {
                    **key,
                    "keypoints_person_id": person,
                    **to_row(found.figures),
                    "keypoints_camera_id": camera_id,
                    "phone_log": None if log is None else shortened(log, 1000),
                    "keypoints_file": folder / "keypoints.npz",
                    **origin.row("keypoints", method_hash=sha, model_sha256=model),
                }
            )
        self.Check.insert_records(key, checks)


def camera_of_row(row: Mapping[str, Any]) -> Camera:
    """The library's `Camera` from a row of CameraCalibration with `turn_deg` (`video.camera_of`)."""
    from pbl_pipeline.video import Camera, turned_camera

    found = from_row(Intrinsics, row)
    return turned_camera(Camera.of(found), (found.width_px, found.height_px), row["turn_deg"])
