"""Detections, tracks and the choice of the subject."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.video import Frame


@dataclasses.dataclass(frozen=True)
class Detection:
    """One person in one frame. `box_px` is x0, y0, x1, y1 in pixels of the upright frame; score in 0..1.

    `roi_px` is what the keypoint crop needs where the detector knows it: centre x, centre y, side length in
    pixels and rotation in radians (clockwise in the picture, 0 = upright); NaN where it does not. `appearance` is
    `appearance_of` of the clothes, None where nobody asked.
    """

    box_px: np.ndarray
    score: float
    roi_px: np.ndarray
    appearance: np.ndarray | None = None


#: A frame as tracking looks at it: regions of its planes, or the whole picture (H, W, 3) uint8 BGR.
Scene = Frame | np.ndarray


class PersonDetector(Protocol):
    """Finds people in one upright BGR frame. Implementations hold a loaded model and are not shared by threads."""

    name: str
    model_sha256: str

    def detect(self, image: np.ndarray) -> list[Detection]: ...


@runtime_checkable
class WindowDetector(PersonDetector, Protocol):
    """A `PersonDetector` that is shown each window of the frame as a square of `window_px` pixels a side, cut from the
    decoder's planes; others are shown the window's own pixels of the converted picture."""

    window_px: int


@dataclasses.dataclass(frozen=True)
class PersonTrack:
    """One person over the video. Rows of frames without the person are NaN (score 0).

    box_px (T, 4) x0 y0 x1 y1; roi_px (T, 4) centre x, centre y, side, rotation (rad); score (T,);
    observed (T,) bool: True where a detector saw the person in that very frame, False where the box is carried over
    a short gap.
    """

    person_id: int
    box_px: np.ndarray
    roi_px: np.ndarray
    score: np.ndarray
    observed: np.ndarray


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Everybody in the video: `time_s` (T,), persons numbered from 1 in order of appearance."""

    time_s: np.ndarray
    image_size_px: tuple[int, int]
    persons: tuple[PersonTrack, ...]
    detector: str
    model_sha256: str


@dataclasses.dataclass(frozen=True)
class SubjectChoice:
    """Who is measured. status: "CHOSEN" (automatic), "MANUAL", "NEEDS_CHOICE" or "NO_PERSON".

    `person_id` is None unless CHOSEN or MANUAL; `scores` maps person_id to the score in 0..1; `reason` is a sentence
    a clinician can read.
    """

    status: str
    person_id: int | None
    score: float
    runner_up_id: int | None
    runner_up_score: float
    scores: dict[int, float]
    reason: str
