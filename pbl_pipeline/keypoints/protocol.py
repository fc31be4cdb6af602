"""Interfaces of keypoint detectors; tables and commands use nothing else of a detector."""

from __future__ import annotations

import enum
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.video import Camera

from .mirrored_inference import MirroredInference
from .types import PersonKeypoints


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
