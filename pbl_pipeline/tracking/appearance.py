"""Appearance of a person: colours of the trunk and of the legs, to distinguish people who were out of sight or close.

An appearance is a histogram, not a network: it takes a tenth of a millisecond, needs no model and no licence, and is
compared within one video, in the same light. Other clothes are certain evidence, similar clothes weak evidence: so it
may forbid joining two tracks, but joins them only if no other person in the video is a candidate.
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
#: Column and row of its pixels, and 1: (3, 288).
_GRID = np.insert(np.indices(_PATCH_SIZE[::-1], float).reshape(2, -1)[::-1], 2, 1, axis=0)
#: Bins of lightness, and of each of the two colour axes (CIE Lab as 8 bit).
_LIGHT_BINS, _COLOUR_BINS = 6, 8
_SIZE = 2 * (_LIGHT_BINS + _COLOUR_BINS**2)
#: Range of the colour axes; few clothes are outside it.
_COLOUR_RANGE = (88.0, 168.0)


def appearance_of(scene: Scene, state: np.ndarray, turn_rad: float) -> np.ndarray:
    """Appearance (2 * (6 + 64),) of the body whose region of interest has the `state` centre x, centre y (px) and log
    side, turned by `turn_rad` clockwise.

    Two histograms for each patch, of lightness and of colour, each of sum 1. NaN if the body is outside the picture.
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
    """Return the detection with `appearance_of` its person in `scene`."""
    return dataclasses.replace(detection, appearance=appearance_of(scene, measure(detection), detection.roi_px[3]))


def _patch(scene: Scene, to_picture: np.ndarray) -> np.ndarray:
    """Pixels (1, N, 3) of a patch: of a `Frame` those in the picture, of an array all, repeated beyond its edge."""
    if not isinstance(scene, Frame):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(scene, to_picture, _PATCH_SIZE, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return patch.reshape(1, -1, 3)
    at = to_picture @ _GRID
    inside = ((at >= 0) & (at <= np.array(scene.size_px)[:, None] - 1)).all(axis=0)
    return scene.cut(to_picture, _PATCH_SIZE).reshape(1, -1, 3)[:, inside]


def appearance_similarity(a: np.ndarray, b: np.ndarray) -> float:
    """Similarity of two appearances: 1 the same, 0 nothing in common; NaN if one is not known.

    The least of the patches' Bhattacharyya coefficients (Bhattacharyya 1943): other trousers are enough for another
    person.
    """
    patches = np.sqrt(a * b).reshape(len(_PATCHES), -1)
    return float(min(p[:_LIGHT_BINS].sum() + p[_LIGHT_BINS:].sum() for p in patches)) / 2


def mean_appearance(appearances: Sequence[np.ndarray | None], least: int = 1) -> np.ndarray:
    """Mean of the known appearances; NaN if those are fewer than `least`."""
    known = [k for k in appearances if k is not None and np.isfinite(k).all()]
    return np.mean(known, axis=0) if len(known) >= max(least, 1) else np.full(_SIZE, np.nan)


def _light(values: np.ndarray) -> np.ndarray:
    """Soft histogram: each value is shared between the two nearest bins, so that a little more light changes little."""
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
