"""BlazePose's person detector: anchors, decoding, suppression within one picture.

Source of the layout: Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose tracking", and the graph
configuration beside the model in the mediapipe 0.10.21 wheel (modules/pose_detection). The detector looks for a face
and upper body; what makes it useful here are two of its keypoints: the middle of the hips and a point on the
circle around the whole body, straight above the hips in the body's own direction.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import expit

from pbl_pipeline import assets
from pbl_pipeline.models import LiteModel

from ._types import Detection

if TYPE_CHECKING:
    from ._params import TrackingParams

MODEL_SHA256 = "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c"
INPUT_SIZE = 224
N_ANCHORS = 2254
#: (stride in px of the 224 px input, anchors per cell)
_LAYERS = ((8, 2), (16, 2), (32, 6))
#: Half width of a standing body in units of the circle's radius; arms hang within it.
BODY_HALF_WIDTH = 0.4


@functools.cache
def anchor_centres() -> np.ndarray:
    """Centres (2254, 2) of the anchors, x and y in 0..1 of the input picture. All anchors have size 1."""
    layers = []
    for stride, per_cell in _LAYERS:
        n = INPUT_SIZE // stride
        y, x = np.mgrid[0:n, 0:n]
        centres = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / n
        layers.append(np.repeat(centres, per_cell, axis=0))
    return np.concatenate(layers).astype(np.float64)


def decode(raw_boxes: np.ndarray, raw_scores: np.ndarray, min_score: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (N, 12) in 0..1 of the input (x0, y0, x1, y1, four keypoints x y) and scores (N,), best first.

    raw_boxes (2254, 12): centre, size and keypoints in input pixels relative to the anchor; raw_scores (2254,) logits.
    """
    score = expit(raw_scores.astype(np.float64))
    keep = np.flatnonzero(score >= min_score)
    keep = keep[np.argsort(-score[keep], kind="stable")]
    raw = raw_boxes[keep].astype(np.float64) / INPUT_SIZE
    anchor = anchor_centres()[keep]
    values = np.empty_like(raw)
    centre = raw[:, 0:2] + anchor
    values[:, 0:2] = centre - raw[:, 2:4] / 2
    values[:, 2:4] = centre + raw[:, 2:4] / 2
    values[:, 4:] = raw[:, 4:] + np.tile(anchor, 4)
    return values, score[keep].astype(np.float64)


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
    """Intersection over union of one box (4,), or as many (N, 4), with boxes (N, 4), corners x0 y0 x1 y1. Empty boxes
    give 0."""
    size = np.minimum(box[..., 2:4], boxes[:, 2:4]) - np.maximum(box[..., 0:2], boxes[:, 0:2])
    intersection = np.prod(np.maximum(size, 0.0), axis=1)
    area = np.prod(np.maximum(box[..., 2:4] - box[..., 0:2], 0.0), axis=-1)
    areas = np.prod(np.maximum(boxes[:, 2:4] - boxes[:, 0:2], 0.0), axis=1)
    union = area + areas - intersection
    return np.where(union > 0, intersection / np.where(union > 0, union, 1.0), 0.0)


def circle_roi(centre: np.ndarray, on_circle: np.ndarray) -> np.ndarray:
    """Region (4,) centre x, centre y, side, rotation (rad) of the region of interest; same unit as the points.

    The side is the circle's diameter; the rotation is clockwise in the picture and 0 for an upright body, whose
    `on_circle` lies straight above `centre`.
    """
    dx, dy = on_circle - centre
    return np.array([centre[0], centre[1], 2.0 * np.hypot(dx, dy), np.arctan2(dx, -dy)])


def body_box(roi: np.ndarray) -> np.ndarray:
    """Corner box (..., 4) around the body that stands in the circle `roi` (..., 4).

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

    def __init__(self, model_path: str | Path, min_score: float = 0.5, min_iou: float = 0.3) -> None:
        self._model = LiteModel(model_path, MODEL_SHA256)
        self.model_sha256 = self._model.sha256
        self._min_score, self._min_iou = min_score, min_iou

    def detect(self, image: np.ndarray) -> list[Detection]:
        """People in `image` (H, W, 3) uint8 BGR, best first. Boxes may reach beyond the picture."""
        height, width = image.shape[:2]
        scale = INPUT_SIZE / max(height, width)
        w, h = max(round(width * scale), 1), max(round(height * scale), 1)
        small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        left, top = (INPUT_SIZE - w) // 2, (INPUT_SIZE - h) // 2
        canvas = np.zeros((INPUT_SIZE, INPUT_SIZE, 3), np.float32)
        # -1 is black: the letterbox bars must be what the network knows as black, not grey.
        canvas -= 1.0
        canvas[top : top + h, left : left + w] = small[:, :, ::-1] * np.float32(2 / 255) - np.float32(1)
        output = self._model(canvas)
        raw_boxes = output[N_ANCHORS * 12].reshape(N_ANCHORS, 12)
        values, scores = decode(raw_boxes, output[N_ANCHORS].reshape(N_ANCHORS), self._min_score)
        values, scores = suppress(values, scores, self._min_iou)
        points = values.reshape(-1, 6, 2) * INPUT_SIZE
        # Half a pixel less: the network counts from the picture's edge, pixel coordinates from the first centre.
        points = (points - [left, top]) * [width / w, height / h] - 0.5
        detections = []
        for p, score in zip(points, scores, strict=True):
            roi = circle_roi(p[2], p[3])
            detections.append(Detection(box_px=body_box(roi), score=float(score), roi_px=roi))
        return detections


def blazepose(params: TrackingParams) -> BlazePoseDetector:
    """The detector of the method. Raises the `PblError`s of `assets.fetch`."""
    return BlazePoseDetector(assets.fetch("blazepose_detector"), params.min_score)
