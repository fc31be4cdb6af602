"""Interfaces and parameters of keypoint detectors; tables and commands use nothing else of a detector."""

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

#: BlazePose's lighter network, and what its points are.
MODEL_SHA256 = assets.ASSETS["blazepose_landmarks"].sha256
MARKER_SET, ROOT_RELATIVE = "blazepose_33", True


@dataclasses.dataclass(frozen=True)
class KeypointParams:
    """Parameters of `detect_keypoints`.

    passes: 1 cuts along the track only, 2 cuts again where the first pass found the body.
    first_look_s: the first pass takes one frame in so many seconds, 0: every frame.
    smooth_s: standard deviation of the Gaussian that smooths the crops over time.
    min_presence: below it a frame has no person and its keypoints are missing.
    max_drift, max_growth: the first pass is believed where its region lies within this fraction of the side from the
    track's, and differs from it in size by at most this factor.
    agree_mm, agree_width_mm: how far the answers for the picture and its mirror image may lie apart, see
    `BlazePoseLandmarks`.
    share_looks_s: frames no further apart than this share the inferences of picture and mirror image: every second
    frame is mirrored (`MirroredInference.shared`); 0: each frame has both.
    lighter_first: the first pass, which only places the crop, takes BlazePose's lighter network.
    crop_step_px: centre and side of a crop are multiples of this, its rotation one of `ROTATION_STEP_RAD`; 0: exact.
    A network answers otherwise by a pixel where a crop moves by a ten-thousandth of one, so without it the rounding of
    another device in an earlier stage would show.
    sides: where left and right are exchanged back, see `exchange_sides`; None: nowhere.
    min_time_s: a person in view for less cannot be measured.
    box_margin: added to the keypoints' box on each side, as a fraction of its size.
    confidence_curve: what the confidence is worth (`confidence_curve`), for the detector that the curve is of; empty
    where none is known.
    """

    detector: str = "blazepose"
    model_sha256: str = MODEL_SHA256
    passes: int = 2
    first_look_s: float = 0.1
    smooth_s: float = 0.1
    min_presence: float = 0.5
    max_drift: float = 0.3
    max_growth: float = 1.5
    agree_mm: float = 100.0
    agree_width_mm: float = 20.0
    sides: FlipParams | None = dataclasses.field(default_factory=FlipParams)
    min_time_s: float = 1.0
    box_margin: float = 0.1
    confidence_curve: str = "blazepose-v1"
    share_looks_s: float = later(0.0)
    lighter_first: bool = later(False)
    crop_step_px: float = later(0.0)

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
        """`roi_px` (4,): the region of interest as in `tracking.Detection`; the detector adds the margin it needs.

        `quick`: only the better crop is wanted (`roi_px` and `presence`), so accuracy may be spared.
        """
        ...


@runtime_checkable
class CropDetector(Protocol):
    """A `KeypointDetector` that sees one region alone, so that the rest of the picture need not be converted.

    `detect(image, roi, camera)` is `detect_crop(cut_image(image, *crop_of(roi)), roi, camera)`.
    """

    def crop_of(self, roi_px: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
        """The matrix and the size of `video.Frame.cut` for the region of interest `roi_px` (4,)."""
        ...

    def detect_crop(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False
    ) -> PersonKeypoints:
        """As `KeypointDetector.detect`, from the region (height, width, 3) uint8 BGR."""
        ...


@runtime_checkable
class MirrorDetector(CropDetector, Protocol):
    """A `CropDetector` that looks at a region and at its mirror image."""

    mirrored_inference: MirroredInference

    def detect_once(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, mirrored: bool = False
    ) -> PersonKeypoints:
        """One of the two looks alone, in terms of the picture."""
        ...
