"""What every keypoint detector offers; tables and commands know nothing more of one."""

from __future__ import annotations

import dataclasses
import enum
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.video import Camera

if TYPE_CHECKING:
    from ._mirror_looks import MirrorLooks


@dataclasses.dataclass(frozen=True)
class PersonKeypoints:
    """One person in one frame.

    xy_px (J, 2) in the upright, distorted picture; xyz_cam_m (J, 3) camera frame (x right, y down, z forward);
    confidence (J,) in 0..1; presence: how sure the detector is that the crop shows a person at all, 0..1;
    roi_px (4,) centre x, centre y, side, rotation of the region as these keypoints show it (NaN: not known),
    a better crop for the same frame than the one they were found in; crop_px: longer side of the crop that
    the network saw, in pixels of the picture (NaN: not stated).
    """

    xy_px: np.ndarray
    xyz_cam_m: np.ndarray
    confidence: np.ndarray
    presence: float
    roi_px: np.ndarray
    crop_px: float = float("nan")


class Look(enum.Enum):
    """How a detector looks at a frame: as well as it can; quickly; at the picture alone; at its mirror image alone."""

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

    mirror_looks: MirrorLooks

    def detect_once(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, mirrored: bool = False
    ) -> PersonKeypoints:
        """One of the two looks alone, in terms of the picture."""
        ...
