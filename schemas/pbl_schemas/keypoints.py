"""Keypoints of the measured person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods
from pbl_pipeline.names import shortened
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import from_row, number
from pbl_pipeline.results.video_facts import Intrinsics
from pbl_pipeline.temporary import new_folder

from . import tracking, video
from .datajoint_setup import dj
from .method_rows import method_columns, method_row
from .origin import Origin, computes, origin_columns
from .record_parts import part_of
from .rows import one
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import keypoints as lib
    from pbl_pipeline.qc import Check
    from pbl_pipeline.video import Camera

schema = dj.Schema()


@schema
class KeypointMethod(dj.Lookup):
    stage = "keypoints"
    definition = f"""
    # frozen parameters of keypoint detection
    {method_columns("keypoint")}
    """


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
    marker_set            : varchar(32)        # names and places of the points
    n_points              : int16              # points of the marker set
    root_relative         : bool               # whether 3D points are relative to the root of the body
    n_seen                : int32              # frames with at least one point
    median_confidence=null: float64            # (0..1) median over the points that were seen, null when none was
    camera_kind           : enum('file', 'measured', 'metadata', 'preset', 'guess', 'other')  # where the intrinsics come from
    camera_source         : varchar(1000)      # the same in words
    focal_length          : float64            # (px) mean of fx and fy
    focal_rel_sd=null     : float64            # (1) standard deviation of the focal length as a share of it, null when unknown
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
        probed = one(video.Video * video.VideoInfo & key)
        times = file_ref(probed.pop("frame_time"))
        person = one(tracking.chosen() & key, "chosen_person_id")
        tracks, detector, model = one(tracking.Tracking & key, "tracks", "detector", "tracking_model_sha256")
        camera = video.camera_of(probed)
        log = (video.PhoneAttitude & key).to_dicts()
        return (
            probed,
            times,
            int(person),
            (file_ref(tracks), detector, model),
            camera,
            (log[0]["attitude_name"], file_ref(log[0]["attitude_file"])) if log else None,
            method_row(KeypointMethod, key),
        )

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

        path = video.registered_file(probed["video_path"], probed["video_sha256"], key)
        detector = methods.stored(**method)
        with stored_file(times) as stored:
            info = video.info_of_row(probed, np.load(stored, allow_pickle=False))
        attitude = None
        if log is not None:
            with stored_file(log[1]) as stored:
                attitude = attitude_of(read_phone_log(stored), Path(log[0]), info)
        with stored_file(tracks[0]) as stored:
            everybody = tracking.load_tracking(stored, (info.width_px, info.height_px), *tracks[1:])
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
        seen = found.confidence > 0
        with new_folder() as folder:
            found.save(folder / "keypoints.npz")
            self.insert1(
                {
                    **key,
                    "keypoints_person_id": person,
                    "marker_set": found.marker_set,
                    "n_points": len(found.names),
                    "root_relative": found.root_relative,
                    "n_seen": int(seen.any(axis=1).sum()),
                    "median_confidence": number(np.median(found.confidence[seen])) if seen.any() else None,
                    "camera_kind": found.camera.kind,
                    "camera_source": shortened(found.camera.source, 1000),
                    "focal_length": found.camera.focal_px,
                    "focal_rel_sd": number(found.camera.focal_rel_sd),
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

    c = from_row(Intrinsics, row)
    matrix = np.array([[c.fx_px, 0.0, c.cx_px], [0.0, c.fy_px, c.cy_px], [0.0, 0.0, 1.0]])
    rel_sd = np.nan if c.focal_sd_px is None else 2 * c.focal_sd_px / (c.fx_px + c.fy_px)
    camera = Camera(matrix, np.asarray(c.distortion, float), f"{c.origin}: {c.note}", rel_sd)
    return turned_camera(camera, (c.width_px, c.height_px), row["turn_deg"])
