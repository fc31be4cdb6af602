"""Interfaces and parameters of keypoint detectors; tables and commands use only these."""

from __future__ import annotations

import dataclasses
import enum
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.paramset import later
from pbl_pipeline.video import Camera

from .flips import FlipParams
from .mirrored_inference import MirroredInference
from .types import PersonKeypoints

#: BlazePose's lighter network, and the marker set of its points.
MODEL_SHA256 = assets.ASSETS["blazepose_landmarks"].sha256
MARKER_SET, ROOT_RELATIVE = "blazepose_33", True


@dataclasses.dataclass(frozen=True)
class KeypointParams:
    """Parameters of `detect_keypoints`."""

    detector: str = "blazepose"
    model_sha256: str = MODEL_SHA256
    passes: int = 2  # 1: crops along the track only; 2: also where the first pass found the body
    first_look_s: float = 0.1  # interval of the frames of the first pass, 0: every frame
    smooth_s: float = 0.1  # standard deviation of the Gaussian that smooths the crops over time
    min_presence: float = 0.5  # below it a frame has no person, and its keypoints are missing
    # The region of the first pass is used if its distance from the track's is within this fraction of the side, and its
    # size differs by at most this factor.
    max_drift: float = 0.3
    max_growth: float = 1.5
    agree_mm: float = 100.0  # these two: agreement of the picture and its mirror image, see `MirroredInference`
    agree_width_mm: float = 20.0
    sides: FlipParams | None = dataclasses.field(default_factory=FlipParams)  # see `exchange_sides`; None: no exchange
    min_time_s: float = 1.0  # a person in view for less cannot be measured
    box_margin: float = 0.1  # added to the keypoints' box on each side, as a fraction of its size
    confidence_curve: str = "blazepose-v1"  # name of the `ConfidenceCurve` of this detector, "" if there is none
    # Frames no farther apart than this share the inferences of picture and mirror image: every second frame is mirrored
    # (`MirroredInference.shared`); 0: each frame has both.
    share_looks_s: float = later(0.0)
    lighter_first: bool = later(False)  # the first pass, which only places the crop, uses BlazePose's lighter network
    # Centre and side of a crop are multiples of this, its rotation one of `ROTATION_STEP_RAD`; 0: exact. The points of
    # a network move by a pixel if a crop moves by a ten-thousandth of one, so without it the rounding of another device
    # in an earlier stage would show.
    crop_step_px: float = later(0.0)
    # Standard deviation, in cells, of the window in which a point is refined by its heat map (`heat_maps.refined`); 0:
    # the points as regressed.
    window_cells: float = later(0.0)
    # Interval of the frames that are used, by their time stamps: keypoints and fit have no others; 0: all are used.
    interval_s: float = later(0.0)

    def points(self) -> tuple[str, bool]:
        """Marker set of the keypoints, and whether their 3D is relative to the root of the body."""
        return MARKER_SET, ROOT_RELATIVE


class Inspection(enum.Enum):
    """How a detector inspects a frame: in full; quickly; the picture alone; its mirror image alone."""

    FULL = "full"
    QUICK = "quick"
    PLAIN = "plain"
    MIRRORED = "mirrored"


class KeypointDetector(Protocol):
    """Finds the keypoints of the person in a region of one upright BGR frame. Not to be shared by threads."""

    name: str
    model_sha256: str
    names: tuple[str, ...]
    marker_set: str
    root_relative: bool

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False) -> PersonKeypoints:
        """Detect in `roi_px` (4,), the region of interest as in `tracking.Detection`; the detector adds its margin.

        `quick`: only the better crop is wanted (`roi_px` and `presence`), so the points may be less accurate.
        """
        ...


@runtime_checkable
class CropDetector(Protocol):
    """A `KeypointDetector` that needs one region only, so that the rest of the picture is not converted.

    `detect(image, roi, camera)` is `detect_crop(cut_image(image, *crop_of(roi)), roi, camera)`.
    """

    def crop_of(self, roi_px: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
        """Return the matrix and the size of `video.Frame.cut` for the region of interest `roi_px` (4,)."""
        ...

    def detect_crop(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False
    ) -> PersonKeypoints:
        """As `KeypointDetector.detect`, from the region (height, width, 3) uint8 BGR."""
        ...


@runtime_checkable
class MirrorDetector(CropDetector, Protocol):
    """A `CropDetector` that inspects a region and its mirror image."""

    mirrored_inference: MirroredInference

    def detect_once(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, mirrored: bool = False
    ) -> PersonKeypoints:
        """Detect in one of the two, in coordinates of the picture."""
        ...
