"""Depths of the surface at the keypoints of a video."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.sampling import interval_of

from .recording import FARTHEST_M, Depth, Pictures

#: Depths that differ by up to this (m) are of one surface; pixels that show one; confidence that counts; largest time
#: (intervals) to the nearest picture.
_SPREAD_M, _LEAST, _CONFIDENT, _NEAR = 0.05, 5, 1, 0.75


@dataclasses.dataclass(frozen=True)
class PointDepths:
    """Depths at the keypoints of a trial, with the name, the SHA-256 and the turn (deg) of their recording."""

    m: Float[np.ndarray, "T J 2"]  # of `at_points`
    name: str = ""
    sha256: str = ""
    turn_deg: int = 0


def at_points(depth: Depth, keypoints: Keypoints) -> PointDepths:
    """Depths along the camera's axis at each keypoint: the median of 3 x 3 pixels if most of them show one surface;
    and of the nearest surface in 5 x 5, since a point beside a thin limb shows the wall.

    NaN where none is known, of low confidence, farther than `FARTHEST_M`, and where no picture is near in time. Raises
    `PblError` DEPTH_FILE for a picture that cannot be read.
    """
    time = np.asarray(keypoints.time_s, float)
    time = time - time[0]
    after = np.clip(np.searchsorted(depth.time_s, time), 1, max(len(depth.time_s) - 1, 1))
    nearest = after - (time - depth.time_s[after - 1] < depth.time_s[after] - time)
    near = np.abs(depth.time_s[nearest] - time) <= _NEAR * interval_of(time)
    known = (np.asarray(keypoints.confidence) > 0) & np.isfinite(keypoints.xy_px).all(axis=-1)
    frames = np.flatnonzero(near & known.any(axis=1))
    out = np.full((*known.shape, 2), np.nan)
    for t, pictures in zip(frames, depth.read(nearest[frames].tolist()), strict=True):
        at = depth.place(np.asarray(keypoints.xy_px[t, known[t]], float), pictures[0].shape)
        around = _around(pictures, at, 1)
        middle = _middle(around)
        alike = np.sum(np.abs(around - middle[:, None]) <= _SPREAD_M / 2, axis=1) >= _LEAST
        out[t, known[t]] = np.stack([np.where(alike, middle, np.nan), _foremost(_around(pictures, at, 2))], axis=-1)
    return PointDepths(out, depth.path.name, depth.sha256, depth.turn_deg)


def _around(pictures: Pictures, at: np.ndarray, reach: int) -> np.ndarray:
    """Depths (P, (2 reach + 1)^2) around places (P, 2), in their order; infinite where none is known."""
    depth, confidence = pictures
    inside = np.all((at >= reach) & (at < np.array(depth.shape) - reach), axis=1)[:, None]
    steps = np.arange(-reach, reach + 1)
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rows, columns = np.moveaxis(np.where(inside, at, reach)[:, None] + square, -1, 0)
    values = np.array(depth[rows, columns], float)
    known = np.isfinite(values) & (values > 0) & (values <= FARTHEST_M) & inside
    if confidence is not None:
        known &= confidence[rows, columns] >= _CONFIDENT
    return np.sort(np.where(known, values, np.inf), axis=1)


def _middle(values: np.ndarray) -> np.ndarray:
    """Median of the finite values of ordered rows, NaN without any."""
    n = np.isfinite(values).sum(axis=1)
    each = np.arange(len(values))
    out = 0.5 * (values[each, np.maximum(n - 1, 0) // 2] + values[each, n // 2])
    return np.where(n > 0, out, np.nan)


def _foremost(values: np.ndarray) -> np.ndarray:
    """The nearest surface of ordered depths, NaN where there is none."""
    with np.errstate(invalid="ignore"):
        flat = values[:, _LEAST - 1 :] - values[:, : -_LEAST + 1] <= _SPREAD_M
    first = values[np.arange(len(values)), flat.argmax(axis=1)]
    on_it = (values >= first[:, None]) & (values <= first[:, None] + _SPREAD_M)
    return np.where(flat.any(axis=1), _middle(np.sort(np.where(on_it, values, np.inf), axis=1)), np.nan)
