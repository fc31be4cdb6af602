"""How a person looks: colours of the trunk and of the legs, to tell people apart who were out of sight or close.

An appearance is a histogram, not a network: it costs a tenth of a millisecond, needs no model and no licence, and is
compared within one video, in the same light. It says "other clothes" surely and "the same clothes" weakly; so it may
forbid to join two tracks, and may join them only where nobody else in the video could be meant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from pbl_pipeline.video import Frame

from .associate import measure
from .tiling import size_of
from .types import Detection, Scene

#: Patches along the body axis in radii of the region of interest, from the middle of the hips: (from, to, half width),
#: up positive.
_PATCHES = ((0.06, 0.46, 0.14), (-0.62, -0.10, 0.16))
_PATCH_SIZE = (12, 24)
#: Bins of lightness, and of each of the two colour axes (CIE Lab as 8 bit).
_LIGHT_BINS, _COLOUR_BINS = 6, 8
_SIZE = 2 * (_LIGHT_BINS + _COLOUR_BINS**2)
#: Range of the colour axes: clothes hardly leave it.
_COLOUR_RANGE = (88.0, 168.0)


def appearance_of(scene: Scene, state: np.ndarray, turn_rad: float) -> np.ndarray:
    """Look (2 * (6 + 64),) of the body whose circle has centre x, centre y (px) and log side `state`, turned by
    `turn_rad` clockwise.

    Two histograms a patch, of lightness and of colour, each of sum 1. NaN where the body lies outside the picture.
    """
    x, y, radius = float(state[0]), float(state[1]), 0.5 * float(np.exp(state[2]))
    width, height = size_of(scene)
    if not (0 <= x < width and 0 <= y < height):
        return np.full(_SIZE, np.nan)
    turn = turn_rad if np.isfinite(turn_rad) else 0.0
    down, right = np.array([-np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    parts = []
    for low, high, half in _PATCHES:
        columns, rows = _PATCH_SIZE
        top = np.array([x, y]) - down * high * radius - right * half * radius
        step_x, step_y = right * 2 * half * radius / columns, down * (high - low) * radius / rows
        to_picture = np.column_stack([step_x, step_y, top + (step_x + step_y) / 2])
        lab = cv2.cvtColor(_patch(scene, to_picture), cv2.COLOR_BGR2Lab).reshape(-1, 3).astype(np.float64)
        if not len(lab):
            return np.full(_SIZE, np.nan)
        parts += [_light(lab[:, 0]), _colour(lab[:, 1:])]
    return np.concatenate(parts)


def with_appearance(detection: Detection, scene: Scene) -> Detection:
    """The detection with `appearance_of` the person whom it found in `scene`."""
    return dataclasses.replace(detection, appearance=appearance_of(scene, measure(detection), detection.roi_px[3]))


def _patch(scene: Scene, to_picture: np.ndarray) -> np.ndarray:
    """Pixels (1, N, 3) of a patch: those in the picture, or all, those beyond it as at its edge."""
    if not isinstance(scene, Frame):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        all_of_it = cv2.warpAffine(scene, to_picture, _PATCH_SIZE, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return all_of_it.reshape(1, -1, 3)
    row, column = np.indices(_PATCH_SIZE[::-1]).reshape(2, -1)
    at = to_picture @ np.stack([column, row, np.ones(len(row))])
    inside = ((at >= 0) & (at <= np.array(scene.size_px)[:, None] - 1)).all(axis=0)
    return scene.cut(to_picture, _PATCH_SIZE).reshape(1, -1, 3)[:, inside]


def appearance_similarity(a: np.ndarray, b: np.ndarray) -> float:
    """How alike two appearances are: 1 the same, 0 nothing in common; NaN where one is not known.

    The least of the patches' Bhattacharyya coefficients (Bhattacharyya 1943): another pair of trousers is enough to be
    somebody else.
    """
    size = len(a) // 2
    shared = np.sqrt(a * b)
    return float(min((shared[:_LIGHT_BINS].sum() + shared[_LIGHT_BINS:size].sum()) / 2, _second(shared, size)))


def mean_appearance(appearances: Sequence[np.ndarray | None], least: int = 1) -> np.ndarray:
    """The mean of the appearances that are known; NaN where those are fewer than `least`."""
    known = [k for k in appearances if k is not None and np.isfinite(k).all()]
    return np.mean(known, axis=0) if len(known) >= max(least, 1) else np.full(_SIZE, np.nan)


def _second(shared: np.ndarray, size: int) -> float:
    return float(shared[size : size + _LIGHT_BINS].sum() + shared[size + _LIGHT_BINS :].sum()) / 2


def _light(values: np.ndarray) -> np.ndarray:
    """Soft histogram: each value is shared between the two nearest bins, so that a little more light moves little."""
    place = np.clip(values / 255.0 * (_LIGHT_BINS - 1), 0, _LIGHT_BINS - 1)
    low = np.minimum(place.astype(int), _LIGHT_BINS - 2)
    part = place - low
    out = np.bincount(low, 1 - part, _LIGHT_BINS) + np.bincount(low + 1, part, _LIGHT_BINS)
    return out / len(values)


def _colour(values: np.ndarray) -> np.ndarray:
    first, last = _COLOUR_RANGE
    place = np.clip((values - first) / (last - first) * (_COLOUR_BINS - 1), 0, _COLOUR_BINS - 1)
    low = np.minimum(place.astype(int), _COLOUR_BINS - 2)
    part = place - low
    out = np.zeros(_COLOUR_BINS**2)
    for di in (0, 1):
        for dj in (0, 1):
            weight = (part[:, 0] if di else 1 - part[:, 0]) * (part[:, 1] if dj else 1 - part[:, 1])
            out += np.bincount((low[:, 0] + di) * _COLOUR_BINS + low[:, 1] + dj, weight, _COLOUR_BINS**2)
    return out / len(values)
