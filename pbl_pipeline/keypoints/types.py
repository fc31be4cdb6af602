"""Keypoints of one person in one trial: the data of `keypoints.npz`, validated."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.bounded import MAX_SECONDS, span_s
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, load_npz, picture_size, text_of, texts_of
from pbl_pipeline.results.people import KeypointFigures
from pbl_pipeline.video import VIDEO_CLOCK, Attitude, Camera, PhoneLog, check_attitude, check_lens

from .picture import Picture

_NEEDED = (
    *("time_s", "names", "marker_set", "xy_px", "xyz_cam_m", "root_relative", "confidence", "image_size_px"),
    "camera_matrix",
)
#: Fields that files of other programs may lack.
_ASSUMED = ("distortion", "camera_source", "box_px")
_OPTIONAL = (
    *("focal_rel_sd", "sides_changed", "phone_time_s", "phone_quat_wxyz", "phone_clock_sd_s"),
    *("confidence_curve", "origin", "picture_time_s", "picture_luma", "picture_detail", "crop_px", "frame"),
)
_NO_SOURCE = "not stated in the keypoints file"
_FORMAT = "see docs/files.md, section keypoints.npz"
_format_error = functools.partial(PblError, "FILE_FORMAT", next_step=_FORMAT)


@dataclasses.dataclass(frozen=True)
class PersonKeypoints:
    """One person in one frame."""

    xy_px: np.ndarray  # (J, 2) in the upright, distorted picture
    xyz_cam_m: np.ndarray  # (J, 3) camera frame (x right, y down, z forward)
    confidence: np.ndarray  # (J,) 0 to 1
    presence: float  # confidence that the crop shows a person at all, 0 to 1
    # (4,) centre x, centre y, side, rotation of the region by these keypoints, which is better than the one they were
    # found in; NaN if not known.
    roi_px: np.ndarray
    crop_px: float = float("nan")  # longer side of the crop, in pixels of the picture; NaN if not stated


@dataclasses.dataclass(frozen=True)
class Keypoints:
    """One trial. Missing values are NaN with confidence 0.

    Raises `PblError` FILE_FORMAT (shapes, confidence), CAMERA_INVALID, PHONE_LOG.
    """

    time_s: np.ndarray  # (T,) the container's time stamps
    names: tuple[str, ...]
    marker_set: str  # name of a marker set of the body
    xy_px: np.ndarray  # (T, J, 2) pixels of the upright, still distorted image
    xyz_cam_m: np.ndarray  # (T, J, 3) camera frame (x right, y down, z forward), root-relative if `root_relative`
    root_relative: bool
    confidence: np.ndarray  # (T, J) 0..1, as stated by the detector
    image_size_px: tuple[int, int]  # (width, height)
    camera: Camera
    box_px: np.ndarray  # (T, 4) x0, y0, x1, y1 of the person
    #: (P,), (P, 4) phone orientation, camera to world, at its own stamps; both or neither is None. Validated, of unit
    #: length and without jumps of sign (`check_attitude`); the fit judges whether it covers the recording.
    phone_time_s: np.ndarray | None = None
    phone_quat_wxyz: np.ndarray | None = None
    phone_clock_sd_s: float = math.nan  # as in `Attitude`
    confidence_curve: str = ""  # name of the `ConfidenceCurve` of this confidence, "" if there is none
    picture: Picture | None = None  # light and sharpness of the picture of the person, None without a video
    origin: str = ""  # detector, model, licence and device; "" if not stated
    #: (T, 3) bool: frames in which left and right of the legs, and of the rest of the body, were exchanged, and those
    #: in which the detected body has no width, so that the sides cannot be distinguished; None: not checked.
    sides_changed: np.ndarray | None = None
    #: (T,) longer side of the crop, in pixels of the picture, NaN where nothing was seen; None if not stated.
    crop_px: np.ndarray | None = None
    frame: np.ndarray | None = None  # (T,) number of each frame in the video, from 0; None: all of it in order
    assumed: tuple[str, ...] = ()  # fields that the file did not have, and that have a default (`load`)

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
        if self.crop_px is not None:
            shapes["crop_px"] = (self.crop_px, (n,))
        if self.frame is not None:
            shapes["frame"] = (self.frame, (n,))
        for name, (array, shape) in shapes.items():
            if np.shape(array) != shape:
                raise _format_error(f"{name} has shape {np.shape(array)}", f"shape {shape} for {n} frames, {j} names")
        if span_s(self.time_s) > MAX_SECONDS:
            raise _format_error(f"time stamps that span {span_s(self.time_s):.3g} s", f"at most {MAX_SECONDS:g} s")
        if np.any(~np.isfinite(self.confidence)) or np.any(self.confidence < 0) or np.any(self.confidence > 1):
            raise _format_error("confidence outside 0..1 or not finite", "0 for a missing point, at most 1")
        if self.crop_px is not None and np.any(np.asarray(self.crop_px) <= 0):
            raise _format_error("a crop of size 0 or below", "crop_px above 0, or NaN where it is not stated")
        if self.frame is not None and not np.all(np.diff(self.frame, prepend=-1) > 0):
            raise _format_error("frame numbers that do not increase from 0 on", "the number of each frame in the video")
        check_lens(self.camera.matrix, self.camera.distortion, self.image_size_px)
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
        if self.phone_clock_sd_s < 1e-4:
            raise _format_error(f"phone_clock_sd_s {self.phone_clock_sd_s:g}", "at least 1e-4 s, or none")
        time_s, quat_wxyz = check_attitude(self.phone_time_s, self.phone_quat_wxyz)
        object.__setattr__(self, "phone_time_s", time_s)
        object.__setattr__(self, "phone_quat_wxyz", quat_wxyz)

    @property
    def figures(self) -> KeypointFigures:
        """The keypoints in figures."""
        seen, camera = self.confidence > 0, self.camera
        median = float(np.median(self.confidence[seen])) if seen.any() else math.nan
        points = (self.marker_set, len(self.names), self.root_relative, int(seen.any(axis=1).sum()), median)
        return KeypointFigures(*points, camera.kind, camera.source, camera.focal_px, camera.focal_rel_sd)

    def with_attitude(self, attitude: Attitude) -> Keypoints:
        """Return the same keypoints with the phone's orientation."""
        return dataclasses.replace(
            self,
            phone_time_s=attitude.time_s,
            phone_quat_wxyz=attitude.quat_wxyz,
            phone_clock_sd_s=attitude.clock_sd_s,
        )

    def save(self, path: str | Path) -> None:
        """Write `keypoints.npz` (the fields of docs/files.md)."""
        optional: dict[str, Any] = {
            "phone_time_s": self.phone_time_s,
            "phone_quat_wxyz": self.phone_quat_wxyz,
            "phone_clock_sd_s": self.phone_clock_sd_s if np.isfinite(self.phone_clock_sd_s) else None,
            "focal_rel_sd": self.camera.focal_rel_sd if np.isfinite(self.camera.focal_rel_sd) else None,
            "confidence_curve": self.confidence_curve or None,
            "origin": self.origin or None,
            "sides_changed": None if self.sides_changed is None else np.asarray(self.sides_changed, bool),
            "crop_px": None if self.crop_px is None else np.asarray(self.crop_px, np.float32),
            "frame": self.frame,
            **(self.picture.arrays() if self.picture is not None else {}),
        }
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
            **{name: value for name, value in optional.items() if value is not None},
        )

    @classmethod
    def load(cls, path: str | Path) -> Keypoints:
        """Read `keypoints.npz`; never unpickles.

        Files of other programs may lack the fields of `_ASSUMED`, whose defaults are no distortion, a camera of unknown
        source, and the box around the points that were seen; `assumed` names them.

        Raises `PblError` FILE_MISSING, FILE_FORMAT, CAMERA_INVALID, PHONE_LOG.
        """
        data = load_npz(path, (*_ASSUMED, *_OPTIONAL), needed=_NEEDED, next_step=_FORMAT)
        assumed = tuple(k for k in _ASSUMED if k not in data)
        n, j = data["time_s"].size, data["names"].size
        arrays = {"time_s": (n,), "xy_px": (n, j, 2), "xyz_cam_m": (n, j, 3), "confidence": (n, j)}
        arrays |= {"image_size_px": (2,), "camera_matrix": (3, 3), "root_relative": ()}
        optional = {"distortion": (5,), "box_px": (n, 4), "focal_rel_sd": (), "phone_clock_sd_s": ()}
        optional |= {"sides_changed": (n, 3), "crop_px": (n,), "frame": (n,)}
        check_numbers(path, data, arrays | {k: shape for k, shape in optional.items() if k in data})
        rel_sd = float(data.get("focal_rel_sd", np.nan))
        distortion, source = data.get("distortion", np.zeros(5)), _NO_SOURCE
        if "camera_source" in data:
            source = text_of(path, data, "camera_source")
        box_px = data["box_px"] if "box_px" in data else box_of_points(data["xy_px"], data["confidence"])
        return cls(
            time_s=data["time_s"].astype(np.float64),
            names=texts_of(path, data, "names"),
            marker_set=text_of(path, data, "marker_set"),
            xy_px=data["xy_px"],
            xyz_cam_m=data["xyz_cam_m"],
            root_relative=bool(data["root_relative"]),
            confidence=data["confidence"],
            image_size_px=picture_size(path, data["image_size_px"]),
            camera=Camera(data["camera_matrix"], distortion, source, rel_sd),
            box_px=box_px,
            assumed=assumed,
            phone_time_s=data.get("phone_time_s"),
            phone_quat_wxyz=data.get("phone_quat_wxyz"),
            phone_clock_sd_s=float(data.get("phone_clock_sd_s", np.nan)),
            confidence_curve=text_of(path, data, "confidence_curve") if "confidence_curve" in data else "",
            picture=Picture.from_arrays(path, data),
            origin=text_of(path, data, "origin") if "origin" in data else "",
            sides_changed=data["sides_changed"].astype(bool) if "sides_changed" in data else None,
            crop_px=data.get("crop_px"),
            frame=data.get("frame"),
        )


def box_of_points(xy_px: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """(T, 4) x0, y0, x1, y1 around the points seen in each frame, NaN without any."""
    seen = (confidence > 0)[..., None] & np.isfinite(xy_px)
    low, high = (np.where(seen, xy_px, fill).astype(float) for fill in (np.inf, -np.inf))
    box = np.concatenate([low.min(axis=1, initial=np.inf), high.max(axis=1, initial=-np.inf)], axis=1)
    return np.where(np.isfinite(box).all(axis=1, keepdims=True), box, np.nan)


def _there(value: object) -> str:
    return "missing" if value is None else "there"


def log_shift_s(log: PhoneLog, keypoints: Keypoints | None, path: str) -> float:
    """Return the shift from the log's times to the video's (s): known if the keypoints hold the log, which was brought
    to the video's clock when they were made, or if the log uses that clock.

    Raises `PblError` PHONE_LOG.
    """
    stamps = None if keypoints is None else keypoints.phone_time_s
    if stamps is not None and len(stamps) == len(log.time_s):
        shift = stamps - log.time_s
        if np.ptp(shift) < 1e-3:
            return float(np.median(shift))
    if log.clock == VIDEO_CLOCK and stamps is None:
        return 0.0
    raise PblError(
        "PHONE_LOG",
        found="a log whose clock against the video's is not known",
        expected="the log that the keypoints were made with (--attitude of `pbl detect`), or one on the video's clock",
        next_step="pass that log, or leave --attitude out",
        key=path,
    )
