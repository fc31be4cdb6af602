"""YOLOX as a person detector: a registered ONNX model of the kind `person_detector` (docs/models.md).

Source of the layout: Ge et al. 2021, "YOLOX: Exceeding YOLO Series in 2021", arXiv:2107.08430. One row for each cell of
three grids (strides 8, 16, 32): centre and logarithm of the size in units of the stride relative to the cell, the
confidence that there is an object, and that it is of each class; class 0 is a person. The picture is in the upper left
corner of the input, the rest is grey (114).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.models import OnnxModel, check_frozen, find, model_invalid

from .types import Detection

if TYPE_CHECKING:
    from .params import TrackingParams

STRIDES = (8, 16, 32)
GREY = 114
#: Of two boxes that overlap more (intersection over union), OpenCV's non-maximum suppression drops the less sure one.
_MIN_IOU = 0.5
#: Box, objectness, and at least the class of people.
_LEAST_COLUMNS = 6


def grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Cells (N, 2), x and y in units of their stride, and strides (N, 1) in px, in the order of the output's rows."""
    cells, strides = [], []
    for stride in STRIDES:
        y, x = np.mgrid[0 : height // stride, 0 : width // stride]
        cells.append(np.stack([x, y], axis=-1).reshape(-1, 2))
        strides.append(np.full((x.size, 1), stride))
    return np.concatenate(cells).astype(np.float64), np.concatenate(strides).astype(np.float64)


def decode(rows: np.ndarray, width: int, height: int, min_score: float) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (M, 4) x0 y0 x1 y1 in input pixels and scores (M,) of people from output rows (N, 5 + classes).

    score = objectness * class of people; only those whose most likely class is a person, and with `min_score` or more.
    """
    score = rows[:, 4].astype(np.float64) * rows[:, 5]
    keep = (score >= min_score) & (rows[:, 5] >= rows[:, 5:].max(axis=1))
    cells, strides = grid(width, height)
    centre = (rows[keep, 0:2] + cells[keep]) * strides[keep]
    half = np.exp(np.clip(rows[keep, 2:4].astype(np.float64), -10, 10)) * strides[keep] / 2
    return np.concatenate([centre - half, centre + half], axis=1), score[keep]


class YoloxDetector:
    """`PersonDetector` for one picture. Returns boxes without a region of interest: `roi_px` is NaN.

    Raises as `OnnxModel`; `PblError` MODEL_INVALID if the model is of another kind, or its output has another shape.
    """

    def __init__(self, model: OnnxModel, min_score: float = 0.3) -> None:
        self._model, self._min_score = model, min_score
        self.name, self.model_sha256 = model.spec.name, model.spec.sha256
        if model.spec.kind != "person_detector":
            raise self._invalid(f"a model of the kind {model.spec.kind}", "kind person_detector")
        self._size = (model.spec.input.width, model.spec.input.height)
        n = len(grid(*self._size)[0])
        black = np.zeros((1, self._size[1], self._size[0], 3), np.uint8)
        shape = model(black)["boxes"].shape
        if len(shape) != 3 or shape[1] != n or shape[2] < _LEAST_COLUMNS:
            raise self._invalid(f"an output of shape {shape}", f"(1, {n}, 5 + classes), one row for each grid cell")

    def detect(self, image: np.ndarray) -> list[Detection]:
        """Find people in `image` (H, W, 3) uint8 BGR, best first."""
        height, width = image.shape[:2]
        scale = min(self._size[0] / width, self._size[1] / height)
        w, h = max(round(width * scale), 1), max(round(height * scale), 1)
        canvas = np.full((1, self._size[1], self._size[0], 3), GREY, np.uint8)
        canvas[0, :h, :w] = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        boxes, scores = decode(self._model(canvas)["boxes"][0], *self._size, self._min_score)
        if not len(scores):
            return []
        # OpenCV wants corner and size.
        corners = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
        kept = cv2.dnn.NMSBoxes(corners.tolist(), scores.tolist(), self._min_score, _MIN_IOU)
        # Half a pixel less: the network counts from the picture's edge, pixel coordinates from the first centre.
        boxes = boxes * [width / w, height / h, width / w, height / h] - 0.5
        unknown = np.full(4, np.nan)
        return [
            Detection(boxes[i], float(scores[i]), unknown) for i in sorted(map(int, kept), key=lambda i: -scores[i])
        ]

    def _invalid(self, found: str, expected: str) -> PblError:
        return model_invalid(found, expected, key=self._model.folder)


def yolox(params: TrackingParams) -> YoloxDetector:
    """Return the detector of the method.

    Raises `PblError` MODEL_CHECKSUM if the registered model is not that of the parameters, and as `YoloxDetector`.
    """
    model = OnnxModel(find(params.model))
    check_frozen(model.spec, params.model_sha256, params.spec_sha256)
    return YoloxDetector(model, params.min_score)
