"""BlazePose's person detector in one picture.

Source of the layout: Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose tracking", and the graph
configuration next to the model in the mediapipe 0.10.21 wheel (modules/pose_detection). The detector finds a face and
upper body; two of its keypoints are used here: the middle of the hips and a point on the circle around the whole body,
above the hips along the body's axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.models import SsdLayout, SsdModel

from .params import MODEL_SHA256, TrackingParams
from .types import Detection

LAYOUT = SsdLayout(input_size=224, layers=((8, 2), (16, 2), (32, 6)), n_keypoints=4)
#: Half width of a standing body in units of the circle's radius; arms hang within it.
BODY_HALF_WIDTH = 0.4


def circle_roi(centre: np.ndarray, on_circle: np.ndarray) -> np.ndarray:
    """Region (4,) centre x, centre y, side, rotation (rad) of the region of interest; same unit as the points.

    The side is the circle's diameter; the rotation is clockwise in the picture and 0 for an upright body, whose
    `on_circle` lies straight above `centre`.
    """
    dx, dy = on_circle - centre
    return np.array([centre[0], centre[1], 2.0 * np.hypot(dx, dy), np.arctan2(dx, -dy)])


def body_box(roi: np.ndarray) -> np.ndarray:
    """Corner box (..., 4) around the body in the circle `roi` (..., 4).

    The body is taken as a rectangle as long as the circle's diameter and `BODY_HALF_WIDTH` radii wide to each side,
    along the rotation; the box is its upright hull. An estimate for overlap and drawing, not a segmentation.
    """
    x, y, side, rotation = np.moveaxis(np.asarray(roi, np.float64), -1, 0)
    sine, cosine = np.abs(np.sin(rotation)), np.abs(np.cos(rotation))
    half_x = side / 2 * (BODY_HALF_WIDTH * cosine + sine)
    half_y = side / 2 * (cosine + BODY_HALF_WIDTH * sine)
    return np.stack([x - half_x, y - half_y, x + half_x, y + half_y], axis=-1)


class BlazePoseDetector:
    """`PersonDetector` for one picture, without tiles: people must be at least about a fifth of the picture high.

    `box_px` of the detections is `body_box` of the region of interest, not the network's box of face and torso.
    """

    name = "blazepose"

    def __init__(self, model_path: str | Path, min_score: float = 0.5) -> None:
        self._model = SsdModel(model_path, MODEL_SHA256, LAYOUT, min_score)
        self.model_sha256 = self._model.sha256
        self._threads = ThreadPoolExecutor(self._model.side_by_side, "people")

    def detect(self, image: np.ndarray) -> list[Detection]:
        """Find people in `image` (H, W, 3) uint8 BGR, best first. Boxes may reach beyond the picture."""
        # After the corners of the box: the middle of the hips and the point on the circle.
        found = [(circle_roi(p[2], p[3]), score) for p, score in zip(*self._model.find(image), strict=True)]
        return [Detection(body_box(roi), float(score), roi) for roi, score in found]

    def detect_all(self, images: Sequence[np.ndarray]) -> Iterator[list[Detection]]:
        """`detect` of each picture, on a GPU side by side: alone each would wait for its answer."""
        return (map if len(images) == 1 else self._threads.map)(self.detect, images)


class BlazePoseWindows(BlazePoseDetector):
    """`WindowDetector`: as `BlazePoseDetector`, of windows at the size of the network's input."""

    window_px = LAYOUT.input_size


def blazepose(params: TrackingParams) -> BlazePoseDetector:
    """The detector of the method. Raises the `PblError`s of `assets.fetch`."""
    kind = BlazePoseWindows if params.cut_windows else BlazePoseDetector
    return kind(assets.fetch("blazepose_detector"), params.min_score)
