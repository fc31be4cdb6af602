"""Faces in a picture: MediaPipe's two detectors, BlazeFace of short and of full range.

Layouts: modules/face_detection of the mediapipe 0.10.21 wheel. Both give a square box from the brows to the chin and
six points, eyes first. Their faces look into the camera; a head from behind only its body shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.models import SsdLayout, SsdModel, box_iou, suppress

FULL_RANGE = SsdLayout(input_size=192, layers=((4, 1),), n_keypoints=6)
SHORT_RANGE = SsdLayout(input_size=128, layers=((8, 2), (16, 6)), n_keypoints=6)
#: Boxes of two windows that overlap more are of one face.
SAME_IOU = 0.2


class FaceDetector:
    """Both networks. Faces from about a tenth of a window's side up. Not to be shared by threads.

    Raises the `PblError`s of `assets.fetch`.
    """

    def __init__(self, min_score: float = 0.5) -> None:
        self._full = _load("face_detector", FULL_RANGE, min_score)
        self._short = _load("face_detector_near", SHORT_RANGE, min_score)
        self.models = {"face_detector": self._full.sha256, "face_detector_near": self._short.sha256}

    def detect(self, image: np.ndarray, windows: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (N, 4) x0, y0, x1, y1 in px and scores (N,), best first, of the faces in the `windows` (x0, y0, x1, y1)
        of `image` (H, W, 3) uint8 BGR. The short range's network looks at the whole picture only."""
        height, width = image.shape[:2]
        boxes, scores = [np.zeros((0, 4))], [np.zeros(0)]
        looks = [(self._full, w) for w in windows] + [(self._short, (0, 0, width, height))]
        for model, (x0, y0, x1, y1) in looks:
            points, score = model.find(image[y0:y1, x0:x1])
            boxes.append(points[:, :2].reshape(-1, 4) + np.array([x0, y0, x0, y0]))
            scores.append(score)
        every, score = np.concatenate(boxes), np.concatenate(scores)
        order = np.argsort(-score, kind="stable")
        return suppress(every[order], score[order], SAME_IOU)


def same_face(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(N,) overlap of a box (4,) with boxes (N, 4), 0 where they are not of one face."""
    overlap = box_iou(box, boxes)
    return np.where(overlap > SAME_IOU, overlap, 0.0)


def _load(name: str, layout: SsdLayout, min_score: float) -> SsdModel:
    return SsdModel(assets.fetch(name), assets.ASSETS[name].sha256, layout, min_score)
