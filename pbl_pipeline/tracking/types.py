"""Detections, tracks and the choice of the subject."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.results.people import PersonTrack
from pbl_pipeline.video import Frame


@dataclasses.dataclass(frozen=True)
class Detection:
    """One person in one frame."""

    box_px: np.ndarray  # (4,) x0, y0, x1, y1 in pixels of the upright frame
    score: float  # 0 to 1
    # (4,) region of interest for keypoints: centre x, centre y and side in px, and rotation in rad (clockwise in the
    # picture, 0 for upright); NaN if the detector does not return it.
    roi_px: np.ndarray
    appearance: np.ndarray | None = None  # `appearance_of`, None if not computed


#: A frame in tracking: regions of its planes, or the whole picture (H, W, 3) uint8 BGR.
Scene = Frame | np.ndarray


class PersonDetector(Protocol):
    """Finds people in one upright BGR frame. Implementations hold a loaded model and are not shared by threads."""

    name: str
    model_sha256: str

    def detect(self, image: np.ndarray) -> list[Detection]: ...


@runtime_checkable
class WindowDetector(PersonDetector, Protocol):
    """A `PersonDetector` whose windows are squares of `window_px` pixels a side, cut from the decoder's planes; those
    of others are parts of the converted picture."""

    window_px: int


@dataclasses.dataclass(frozen=True)
class Tracking:
    """All people in the video: `time_s` (T,), persons numbered from 1 in order of appearance."""

    time_s: np.ndarray
    image_size_px: tuple[int, int]
    persons: tuple[PersonTrack, ...]
    detector: str
    model_sha256: str
