"""Keypoints of the measured person."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import lab, tracking, video
from ._base import (
    Origin,
    check_columns,
    check_row,
    computes,
    dj,
    file_ref,
    insert_methods,
    library,
    method_arguments,
    method_columns,
    method_key,
    new_folder,
    number,
    origin_columns,
    rebuild_params,
    resolve_method,
    stored_file,
)

schema = dj.Schema()


@schema
class KeypointMethod(dj.Lookup):
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
    median_confidence=null: float32            # (0..1) median over the points that were seen, null when none was
    camera_source         : varchar(255)       # where the intrinsics come from
    focal_length          : float32            # (px) mean of fx and fy
    keypoints_file        : <object@arrays>   # keypoints.npz: time_s (T) s, xy_px (T,J,2) px, xyz_cam_m (T,J,3) m, confidence (T,J) 0..1, box_px (T,4) px, camera; docs/files.md
    {origin_columns("keypoints")}
    """  # noqa: E501

    class Check(dj.Part):
        definition = f"""
        # quality checks of what was seen
        {check_columns("keypoints")}
        """

    @property
    def key_source(self) -> Any:
        """Only where somebody is chosen: a video that waits for a choice has no row and no error."""
        chosen = tracking.SubjectChoice & [{"choice_status": s} for s in tracking.CHOSEN]
        return (chosen.proj() * KeypointSelection.proj()) & video.VideoInfo

    def make_fetch(self, key: dict) -> tuple:
        file = (video.Video & key).fetch1("video_path", "video_sha256")
        size = (video.VideoInfo & key).fetch1("width", "height")
        person = (tracking.SubjectChoice & key).fetch1("chosen_person_id")
        tracks, detector, model = (tracking.Tracking & key).fetch1("tracks", "detector", "tracking_model_sha256")
        camera = (lab.CameraCalibration & (video.Video & key)).to_dicts()
        return (
            file,
            (int(size[0]), int(size[1])),
            int(person),
            (file_ref(tracks), detector, model),
            camera[0] if camera else None,
            method_arguments(KeypointMethod, "keypoint", "keypoints", key["keypoint_method"]),
        )

    @computes
    def make_compute(
        self,
        key: dict,
        file: tuple,
        size: tuple,
        person: int,
        tracks: tuple,
        camera: Mapping[str, Any] | None,
        method: Mapping[str, Any],
    ) -> tuple:
        path = video.registered_file(file[0], file[1], key)
        params = rebuild_params(library("keypoints").params_class(method["params"]), **method)
        with stored_file(self, tracks[0]) as stored:
            everybody = tracking.load_tracking(stored, size, *tracks[1:])
        view = camera_of_row(camera) if camera else library("video").guess_camera(size)
        found = library("keypoints").detect_keypoints(path, everybody, person, view, params=params)
        return found, person, method["sha"], model_sha256(params)

    def make_insert(self, key: dict, found: Any, person: int, sha: str, model: str | None, origin: Origin) -> None:
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
                    "camera_source": found.camera.source[:255],
                    "focal_length": float(found.camera.matrix[0, 0] + found.camera.matrix[1, 1]) / 2,
                    "keypoints_file": folder / "keypoints.npz",
                    **origin.row("keypoints", method_hash=sha, model_sha256=model),
                }
            )
        checks = library("keypoints").check_keypoints(found)
        self.Check.insert({**key, **check_row("keypoints", check)} for check in checks)


def method_of(name: str) -> str:
    """Key of the keypoint method of that name (`resolve_method`), or of the registered model of that name, which
    becomes a method when it is first asked for. Another graph or `model.json` under the same name is its next version.

    Raises `PblError` SOLVER_UNKNOWN, MODEL_INVALID, MARKER_SET_UNKNOWN.
    """
    if name in library("keypoints").PARAMSETS or not library("models").is_registered(name):
        return resolve_method(KeypointMethod, "keypoint", name)
    rows = (KeypointMethod & {"keypoint_method_name": name}).to_dicts(order_by="keypoint_method_version")
    versions = [row["keypoint_method_version"] for row in rows]
    found = library("keypoints").method_of_model(name)
    for version in versions:
        known = dataclasses.replace(found, version=version)
        if KeypointMethod & {"keypoint_method_sha": known.hash}:
            return method_key(known)
    new = dataclasses.replace(found, version=max(versions, default=0) + 1)
    insert_methods(KeypointMethod, "keypoint", {name: new})
    return method_key(new)


def camera_of_row(row: Mapping[str, Any]) -> Any:
    """The library's `Camera` from a row of CameraCalibration."""
    matrix = np.array(
        [[row["camera_fx"], 0.0, row["camera_cx"]], [0.0, row["camera_fy"], row["camera_cy"]], [0.0, 0.0, 1.0]]
    )
    distortion = np.asarray(row["camera_distortion"], np.float64)
    return library("video").Camera(matrix, distortion, f"{row['camera_origin']}: {row['camera_note']}")


def model_sha256(params: Any) -> str | None:
    """SHA-256 of the landmark model, as the parameters or the pinned asset state it."""
    return getattr(params, "model_sha256", None)
