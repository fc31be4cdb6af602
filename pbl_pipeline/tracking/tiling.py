"""Detection on a whole frame plus overlapping tiles, merged, to find people who are small in the frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.models import box_iou
from pbl_pipeline.video import Frame

from .types import Detection, PersonDetector, Scene, WindowDetector

#: A box that ends within this fraction of the window's width from its edge is taken as cut by it.
CUT_SHARE = 0.02
#: `merge`: overlap (intersection over union) above which two detections agree, and fraction of the smaller box above
#: which two that do not agree are of one person.
_MIN_IOU, _MIN_COVER = 0.4, 0.6
#: x0, y0, x1, y1 in px; it may reach beyond the picture.
Window = tuple[int, int, int, int]


def tile_starts(length: int, tile: int, overlap: float) -> list[int]:
    """First pixels of tiles of `tile` pixels that cover `length`: evenly spread, overlapping by `overlap` or more."""
    if tile >= length:
        return [0]
    n = 1 + math.ceil((length - tile) / (tile * (1.0 - overlap)) - 1e-9)
    return [round(i * (length - tile) / (n - 1)) for i in range(n)]


def tiles(width: int, height: int, fraction: float, overlap: float) -> list[Window]:
    """Windows x0, y0, x1, y1: the whole frame first, then squares of `fraction` of the shorter side."""
    side = max(round(min(width, height) * fraction), 1)
    grid = [
        (x, y, min(x + side, width), min(y + side, height))
        for y in tile_starts(height, side, overlap)
        for x in tile_starts(width, side, overlap)
    ]
    whole = (0, 0, width, height)
    return [whole, *(t for t in grid if t != whole)]


def detect_in(
    detector: PersonDetector, scene: Scene, windows: Sequence[Window], passing: Sequence[Window] = ()
) -> list[Detection]:
    """Run the detector in each window and merge the detections, in pixels of the picture.

    `windows` are around people, who have the right size in them; `passing` windows are anywhere, are trusted half as
    much, and so only confirm detections in another window.
    """
    width, height = size_of(scene)
    found, parts = list[tuple[float, Detection]](), []
    for window, weight in [*((w, 1.0) for w in windows), *((w, 0.5 if windows else 1.0) for w in passing)]:
        x0, y0, x1, y1 = max(window[0], 0), max(window[1], 0), min(window[2], width), min(window[3], height)
        if x1 - x0 >= 16 and y1 - y0 >= 16:
            parts.append(((x0, y0, x1, y1), weight, *_shown(detector, scene, window, (x0, y0, x1, y1))))
    shown, together = [image for _, _, image, *_ in parts], getattr(detector, "detect_all", None)
    seen = together(shown) if together is not None else map(detector.detect, shown)
    for ((x0, y0, x1, y1), weight, _, scale, x, y), people in zip(parts, seen, strict=True):
        for d in people:
            box = d.box_px * scale + np.array([x, y, x, y])
            roi = d.roi_px * np.array([scale, scale, scale, 1.0]) + np.array([x, y, 0, 0])
            if not np.isfinite(roi).all() and _cut(box, (x0, y0, x1, y1), (width, height)):
                continue
            whole = _area(np.clip(box, 0, [width, height, width, height]))
            inside = _area(np.clip(box, [x0, y0, x0, y0], [x1, y1, x1, y1]))
            # A person cut by the window's edge is measured worse than in a neighbouring window that shows her whole.
            trust = weight * d.score * (inside / whole if whole > 0 else 0.0)
            found.append((trust, Detection(box_px=box, score=d.score, roi_px=roi)))
    return merge(found)


def size_of(scene: Scene) -> tuple[int, int]:
    """Width and height of the picture."""
    return scene.size_px if isinstance(scene, Frame) else (scene.shape[1], scene.shape[0])


def _shown(
    detector: PersonDetector, scene: Scene, window: Window, inside: Window
) -> tuple[np.ndarray, float, float, float]:
    """Return what a detector sees of a window, of which `inside` lies in the picture, with its scale and origin."""
    x, y, right, bottom = inside
    if isinstance(scene, Frame) and isinstance(detector, WindowDetector):
        n, side = detector.window_px, max(window[2] - window[0], window[3] - window[1])
        scale = side / n
        # Position of the first pixel's centre.
        left, top = ((window[i] + window[i + 2] - side + scale - 1) / 2 for i in (0, 1))
        return scene.cut(np.array([[scale, 0.0, left], [0.0, scale, top]]), (n, n)), scale, left, top
    return (scene.image if isinstance(scene, Frame) else scene)[y:bottom, x:right], 1.0, x, y


def merge(found: list[tuple[float, Detection]]) -> list[Detection]:
    """Merge pairs (trust, detection) into one detection per person: those that overlap the most trusted one.

    Overlap is that of the body boxes. Above `_MIN_IOU` two detections agree and are averaged by trust (those trusted
    less than half as much as the best only confirm). Otherwise, if more than `_MIN_COVER` of the smaller box is
    covered, they disagree about the size of one person (of a person who is too small in the window the network returns
    a circle of the wrong size), and the less trusted one is dropped.
    """
    left = sorted((f for f in found if f[0] > 0), key=lambda f: -f[0])
    people = []
    while left:
        best = left[0][0]
        box = left[0][1].box_px
        boxes = np.array([d.box_px for _, d in left])
        iou, cover = box_iou(box, boxes), _cover(box, boxes)
        used = [(t, d) for (t, d), o in zip(left, iou, strict=True) if o > _MIN_IOU and t >= 0.5 * best]
        left = [f for f, o, c in zip(left, iou, cover, strict=True) if o <= _MIN_IOU and c <= _MIN_COVER]
        weight = np.array([t for t, _ in used])
        weight /= weight.sum()
        roi = weight @ np.array([d.roi_px for _, d in used])
        # Angles average on the circle: a lying person may be seen at +179 and -179 degrees.
        turn = np.array([d.roi_px[3] for _, d in used])
        roi[3] = np.arctan2(weight @ np.sin(turn), weight @ np.cos(turn))
        mean_box = weight @ np.array([d.box_px for _, d in used])
        people.append(Detection(box_px=mean_box, score=max(d.score for _, d in used), roi_px=roi))
    return people


def _cut(box: np.ndarray, window: Window, size: tuple[int, int]) -> bool:
    """True if a box without a region of interest ends at an edge of its window inside the picture, so that the person
    extends beyond it. Regions of interest need no such rule: they reach beyond the window, and are trusted less."""
    near = CUT_SHARE * (window[2] - window[0])
    inner = np.array([window[0] > 0, window[1] > 0, window[2] < size[0], window[3] < size[1]])
    beyond = np.array([1, 1, -1, -1]) * (box - np.array(window)) < near
    return bool((inner & beyond).any())


def _cover(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Fraction of the smaller of two boxes that lies in the other, for one box (4,) against boxes (N, 4)."""
    size = np.minimum(box[2:4], boxes[:, 2:4]) - np.maximum(box[0:2], boxes[:, 0:2])
    intersection = np.prod(np.maximum(size, 0.0), axis=1)
    areas = np.prod(np.maximum(boxes[:, 2:4] - boxes[:, 0:2], 0.0), axis=1)
    smaller = np.minimum(_area(box), areas)
    return np.where(smaller > 0, intersection / np.where(smaller > 0, smaller, 1.0), 0.0)


def _area(box: np.ndarray) -> float:
    return float(max(box[2] - box[0], 0.0) * max(box[3] - box[1], 0.0))
