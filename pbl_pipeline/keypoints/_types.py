"""Keypoints of one person in one trial: the data of `keypoints.npz`, validated at the door."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, load_npz
from pbl_pipeline.video import Attitude, Camera, check_attitude

from ._picture import Picture


@dataclasses.dataclass(frozen=True)
class Keypoints:
    """One trial. Missing values are NaN with confidence 0.

    Attributes
    ----------
    time_s : (T,) float64
        The container's time stamps.
    names : tuple of J str
    marker_set
        Name of a marker set of the body.
    xy_px : (T, J, 2)
        Pixels of the upright, still distorted image.
    xyz_cam_m : (T, J, 3)
        Camera frame (x right, y down, z forward), root-relative if `root_relative`.
    confidence : (T, J)
        0..1, as stated by the detector.
    confidence_curve
        Name of the curve (`confidence_curve`) that says what this is worth; empty where none is known.
    image_size_px : (width, height)
    box_px : (T, 4)
        x0, y0, x1, y1 of the person.
    phone_time_s, phone_quat_wxyz : (P,), (P, 4) or None
        Phone orientation, camera to world, at its own stamps: both or neither. Brought to unit length, without jumps
        of sign, when made (`check_attitude`); how much of the recording it covers is for the fit to judge.
    origin
        Which detector and model made them, under which licence and on what; empty where nobody said.
    sides_changed : (T, 3) bool or None
        Frames in which left and right of the legs, and of the rest of the body, are not as the detector said but were
        exchanged, and those in which its body has no width, so that the sides cannot be told; None: nobody looked.
    picture
        How light and sharp the picture of the person is, or None where no video was seen.

    Raises
    ------
    PblError
        FILE_FORMAT (shapes, confidence), CAMERA_INVALID, PHONE_LOG.
    """

    time_s: np.ndarray
    names: tuple[str, ...]
    marker_set: str
    xy_px: np.ndarray
    xyz_cam_m: np.ndarray
    root_relative: bool
    confidence: np.ndarray
    image_size_px: tuple[int, int]
    camera: Camera
    box_px: np.ndarray
    phone_time_s: np.ndarray | None = None
    phone_quat_wxyz: np.ndarray | None = None
    confidence_curve: str = ""
    picture: Picture | None = None
    origin: str = ""
    sides_changed: np.ndarray | None = None

    def __post_init__(self) -> None:
        n, j = len(self.time_s), len(self.names)
        shapes = {
            "time_s": (self.time_s, (n,)),
            "xy_px": (self.xy_px, (n, j, 2)),
            "xyz_cam_m": (self.xyz_cam_m, (n, j, 3)),
            "confidence": (self.confidence, (n, j)),
            "box_px": (self.box_px, (n, 4)),
            "camera_matrix": (self.camera.matrix, (3, 3)),
            "distortion": (self.camera.distortion, (5,)),
        }
        if self.sides_changed is not None:
            shapes["sides_changed"] = (self.sides_changed, (n, 3))
        for name, (array, shape) in shapes.items():
            if np.shape(array) != shape:
                raise _format_error(f"{name} has shape {np.shape(array)}", f"shape {shape} for {n} frames, {j} names")
        if np.any(~np.isfinite(self.confidence)) or np.any(self.confidence < 0) or np.any(self.confidence > 1):
            raise _format_error("confidence outside 0..1 or not finite", "0 for a missing point, at most 1")
        matrix = self.camera.matrix
        if not np.all(np.isfinite(matrix)) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[2, 2] != 1:
            raise PblError(
                "CAMERA_INVALID",
                found=f"camera matrix {np.asarray(matrix).tolist()}",
                expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with positive focal lengths",
                next_step="pass a camera file with --camera, or leave it out to use the stated guess",
            )
        if not np.all(np.isfinite(self.camera.distortion)):
            raise PblError(
                "CAMERA_INVALID",
                found=f"distortion {np.asarray(self.camera.distortion).tolist()}",
                expected="k1, k2, p1, p2, k3, finite; zeros for a lens without distortion",
                next_step="pass a camera file with --camera, or leave it out to use the stated guess",
            )
        self._check_phone()

    def _check_phone(self) -> None:
        if self.phone_time_s is None and self.phone_quat_wxyz is None:
            return
        if self.phone_time_s is None or self.phone_quat_wxyz is None:
            raise PblError(
                "PHONE_LOG",
                found=f"phone_time_s {_there(self.phone_time_s)}, phone_quat_wxyz {_there(self.phone_quat_wxyz)}",
                expected="both or neither",
                next_step="see docs/files.md, section keypoints.npz",
            )
        time_s, quat_wxyz = check_attitude(self.phone_time_s, self.phone_quat_wxyz)
        object.__setattr__(self, "phone_time_s", time_s)
        object.__setattr__(self, "phone_quat_wxyz", quat_wxyz)

    def with_attitude(self, attitude: Attitude) -> Keypoints:
        """The same keypoints with the phone's orientation."""
        return dataclasses.replace(self, phone_time_s=attitude.time_s, phone_quat_wxyz=attitude.quat_wxyz)

    def save(self, path: str | Path) -> None:
        """Write `keypoints.npz` (the fields of docs/files.md)."""
        optional: dict[str, Any] = {}
        if self.phone_time_s is not None and self.phone_quat_wxyz is not None:
            optional = {"phone_time_s": self.phone_time_s, "phone_quat_wxyz": self.phone_quat_wxyz}
        if np.isfinite(self.camera.focal_rel_sd):
            optional["focal_rel_sd"] = np.asarray(self.camera.focal_rel_sd, np.float64)
        if self.confidence_curve:
            optional["confidence_curve"] = np.asarray(self.confidence_curve)
        if self.origin:
            optional["origin"] = np.asarray(self.origin)
        if self.sides_changed is not None:
            optional["sides_changed"] = np.asarray(self.sides_changed, bool)
        if self.picture is not None:
            optional |= self.picture.arrays()
        np.savez(  # not packed, see `TrialFit.save`
            path,
            time_s=np.asarray(self.time_s, np.float64),
            names=np.asarray(self.names),
            marker_set=np.asarray(self.marker_set),
            xy_px=np.asarray(self.xy_px, np.float32),
            xyz_cam_m=np.asarray(self.xyz_cam_m, np.float32),
            root_relative=np.asarray(self.root_relative),
            confidence=np.asarray(self.confidence, np.float32),
            image_size_px=np.asarray(self.image_size_px, np.int64),
            camera_matrix=np.asarray(self.camera.matrix, np.float64),
            distortion=np.asarray(self.camera.distortion, np.float64),
            camera_source=np.asarray(self.camera.source),
            box_px=np.asarray(self.box_px, np.float32),
            **optional,
        )

    @classmethod
    def load(cls, path: str | Path) -> Keypoints:
        """Read `keypoints.npz`; never unpickles.

        Raises `PblError` FILE_MISSING, FILE_FORMAT, CAMERA_INVALID, PHONE_LOG.
        """
        data = load_npz(path)
        needed = [
            "time_s",
            "names",
            "marker_set",
            "xy_px",
            "xyz_cam_m",
            "root_relative",
            "confidence",
            "image_size_px",
            "camera_matrix",
            "distortion",
            "camera_source",
            "box_px",
        ]
        missing = [k for k in needed if k not in data]
        if missing:
            raise _format_error(f"{path} lacks {', '.join(missing)}", f"the fields {', '.join(needed)}")
        n, j = data["time_s"].size, data["names"].size
        arrays = {"time_s": (n,), "xy_px": (n, j, 2), "xyz_cam_m": (n, j, 3), "confidence": (n, j), "box_px": (n, 4)}
        arrays |= {"image_size_px": (2,), "camera_matrix": (3, 3), "distortion": (5,), "root_relative": ()}
        if "focal_rel_sd" in data:
            arrays["focal_rel_sd"] = ()
        if "sides_changed" in data:
            arrays["sides_changed"] = (n, 3)
        check_numbers(path, data, arrays)
        rel_sd = float(data.get("focal_rel_sd", np.nan))
        return cls(
            time_s=data["time_s"].astype(np.float64),
            names=tuple(str(n) for n in data["names"]),
            marker_set=str(data["marker_set"]),
            xy_px=data["xy_px"],
            xyz_cam_m=data["xyz_cam_m"],
            root_relative=bool(data["root_relative"]),
            confidence=data["confidence"],
            image_size_px=(int(data["image_size_px"][0]), int(data["image_size_px"][1])),
            camera=Camera(data["camera_matrix"], data["distortion"], str(data["camera_source"]), rel_sd),
            box_px=data["box_px"],
            phone_time_s=data.get("phone_time_s"),
            phone_quat_wxyz=data.get("phone_quat_wxyz"),
            confidence_curve=str(data.get("confidence_curve", "")),
            picture=Picture.from_arrays(path, data),
            origin=str(data.get("origin", "")),
            sides_changed=data["sides_changed"].astype(bool) if "sides_changed" in data else None,
        )


def _there(value: object) -> str:
    return "missing" if value is None else "there"


def _format_error(found: str, expected: str) -> PblError:
    return PblError("FILE_FORMAT", found=found, expected=expected, next_step="see docs/files.md, section keypoints.npz")
