"""MediaPipe's single-shot detectors: a square input, boxes with keypoints relative to fixed anchors, suppression.

Person and face detectors differ only in the size of the input, the layers of anchors and the number of keypoints.
Layout: the graph configurations next to the models in the mediapipe 0.10.21 wheel; Bazarevsky et al. 2019, "BlazeFace",
arXiv:1907.05047, for the averaging suppression.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from .network import Network

#: Overlap (intersection over union) above which boxes of one network are of one object.
_MIN_IOU = 0.3


@dataclasses.dataclass(frozen=True)
class SsdLayout:
    """Shape of a detector."""

    input_size: int  # side of the input, px
    layers: tuple[tuple[int, int], ...]  # of anchors: stride in px of the input, anchors per cell
    n_keypoints: int  # of each box

    @functools.cached_property
    def anchor_centres(self) -> np.ndarray:
        """Centres (N, 2) of the anchors, x and y in 0..1 of the input picture. All anchors have size 1."""
        layers = []
        for stride, per_cell in self.layers:
            n = self.input_size // stride
            y, x = np.mgrid[0:n, 0:n]
            centres = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / n
            layers.append(np.repeat(centres, per_cell, axis=0))
        return np.concatenate(layers).astype(np.float64)

    @property
    def n_values(self) -> int:
        """Number of values of a box: centre and size, then x and y of each keypoint."""
        return 4 + 2 * self.n_keypoints

    def decode(self, raw_boxes: np.ndarray, raw_scores: np.ndarray, min_score: float) -> tuple[np.ndarray, np.ndarray]:
        """Decode boxes (M, `n_values`), 0 to 1 of the input (x0, y0, x1, y1, keypoints x y) and scores (M,), sorted.

        raw_boxes (N, `n_values`): centre, size and keypoints in input pixels relative to the anchor; raw_scores (N,)
        logits.
        """
        score = expit(raw_scores.astype(np.float64))
        keep = np.flatnonzero(score >= min_score)
        keep = keep[np.argsort(-score[keep], kind="stable")]
        raw = raw_boxes[keep].astype(np.float64) / self.input_size
        anchor = self.anchor_centres[keep]
        values = np.empty_like(raw)
        centre = raw[:, 0:2] + anchor
        values[:, 0:2] = centre - raw[:, 2:4] / 2
        values[:, 2:4] = centre + raw[:, 2:4] / 2
        values[:, 4:] = raw[:, 4:] + np.tile(anchor, self.n_keypoints)
        return values, score[keep].astype(np.float64)


class SsdModel:
    """A loaded detector of a layout. Raises the `PblError`s of `Network`."""

    def __init__(self, model_path: str | Path, sha256: str, layout: SsdLayout, min_score: float) -> None:
        # The bars of the letterbox are 0, the network's black (-1), not grey.
        self._model = Network(model_path, sha256, scale=2 / 255, offset=-1.0)
        self.sha256, self.side_by_side = self._model.sha256, self._model.side_by_side
        self._layout, self._min_score = layout, min_score

    def find(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find boxes: their corners and keypoints (M, 2 + K, 2) in pixels of `image` (H, W, 3) uint8 BGR, possibly
        beyond it, and scores (M,), best first."""
        size = self._layout.input_size
        height, width = image.shape[:2]
        scale = size / max(height, width)
        w, h = max(round(width * scale), 1), max(round(height * scale), 1)
        small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        left, top = (size - w) // 2, (size - h) // 2
        canvas = np.zeros((size, size, 3), np.uint8)
        canvas[top : top + h, left : left + w] = cv2.cvtColor(small, cv2.COLOR_BGR2RGB)
        output = self._model(canvas)
        n = len(self._layout.anchor_centres)
        raw_boxes = output[n * self._layout.n_values].reshape(n, -1)
        values, scores = self._layout.decode(raw_boxes, output[n].reshape(n), self._min_score)
        values, scores = suppress(values, scores, _MIN_IOU)
        points = values.reshape(-1, self._layout.n_values // 2, 2) * size
        # Half a pixel less: the network counts from the picture's edge, pixel coordinates from the first centre.
        return (points - [left, top]) * [width / w, height / h] - 0.5, scores


def suppress(values: np.ndarray, scores: np.ndarray, min_iou: float) -> tuple[np.ndarray, np.ndarray]:
    """Weighted non-maximum suppression: boxes that overlap the best one are averaged into it by their scores.

    `values` (N, >=4) starts with x0, y0, x1, y1 and is sorted by falling score. The group keeps its best score.
    """
    out_values, out_scores = [], []
    left = np.arange(len(scores))
    while len(left):
        iou = box_iou(values[left[0], :4], values[left, :4])
        group = iou > min_iou
        group[0] = True
        weight = scores[left[group]]
        out_values.append(weight @ values[left[group]] / weight.sum())
        out_scores.append(scores[left[0]])
        left = left[~group]
    return np.array(out_values).reshape(-1, values.shape[1]), np.array(out_scores)


def box_iou(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Intersection over union of one box (4,), or as many (N, 4), with boxes (N, 4), corners x0 y0 x1 y1; 0 for empty
    boxes."""
    size = np.minimum(box[..., 2:4], boxes[:, 2:4]) - np.maximum(box[..., 0:2], boxes[:, 0:2])
    intersection = np.prod(np.maximum(size, 0.0), axis=1)
    area = np.prod(np.maximum(box[..., 2:4] - box[..., 0:2], 0.0), axis=-1)
    areas = np.prod(np.maximum(boxes[:, 2:4] - boxes[:, 0:2], 0.0), axis=1)
    union = area + areas - intersection
    return np.where(union > 0, intersection / np.where(union > 0, union, 1.0), 0.0)
