"""Depth recordings of a synthetic person: the body's capsules before a floor and a wall, with noise and holes.

A person's capsules are thicker or thinner than the body's, each segment by its own share: the fit takes the body's own
shapes for where the surface is, so the same ones here would hide that it errs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from pbl_pipeline.body import Capsules, capsules, load_body, ray_lengths
from pbl_pipeline.depth import Depth
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import Truth

#: Longer side (px) of the pictures, as a phone's.
LONG_PX = 256
#: Standard deviations (as a share) of all radii of a person, and of those of a segment.
ALL_SD, EACH_SD = 0.08, 0.12
#: Standard deviation (m) of a pixel's noise at 3 m, which grows with the square of the distance, and of a smooth one
#: that keeps for a time (s); share of the picture in holes; distance (m) of the wall behind the farthest place.
WHITE_M, SMOOTH_M, SMOOTH_S, HOLES, BEHIND_M = 0.006, 0.01, 0.3, 0.04, 0.8


def depth_recording(truth: Truth, keypoints: Keypoints, seed: int) -> Depth:
    """The depth recording of a trial, drawn when it is read, frame after frame."""
    width, height = keypoints.image_size_px
    shrink = LONG_PX / max(width, height)
    shape = round(height * shrink), round(width * shrink)
    matrix = np.array(keypoints.camera.matrix)
    rng = np.random.default_rng([seed, 55])
    person = _person(truth, rng)
    forward = truth.R_nc[0, :, 2] * [1, 1, 0]
    forward /= np.linalg.norm(forward)
    wall = float((truth.pelvis_m @ forward).max()) + BEHIND_M
    pictures = list(_pictures(truth, person, matrix, shrink, shape, forward, wall, rng))

    def read(frames: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        return ((pictures[i], None) for i in frames)

    return Depth(Path("synthetic"), truth.time_s - truth.time_s[0], (width, height), matrix, None, read)


def _person(truth: Truth, rng: np.random.Generator) -> Capsules:
    found = capsules(load_body(), truth.qpos, truth.scale)
    segments = [n.removesuffix("_r").removesuffix("_l") for n in found.body_names]
    own = {n: 1 + rng.normal(0, EACH_SD) for n in sorted(set(segments))}
    share = (1 + rng.normal(0, ALL_SD)) * np.array([own[n] for n in segments])
    return dataclasses.replace(found, radius_m=found.radius_m * np.clip(share, 0.6, 1.5))


def _pictures(
    truth: Truth,
    person: Capsules,
    matrix: np.ndarray,
    shrink: float,
    shape: tuple[int, int],
    forward: np.ndarray,
    wall: float,
    rng: np.random.Generator,
) -> Iterator[np.ndarray]:
    rows, columns = np.indices(shape)
    x, y = ((a + 0.5) / shrink - 0.5 for a in (columns, rows))
    rays = np.stack([(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones(shape)], axis=-1)
    smooth, keep = _smooth(rng, shape), np.exp(-np.median(np.diff(truth.time_s)) / SMOOTH_S)
    for t in range(len(truth.time_s)):
        # The third number of a ray is 1 along the camera's axis, so its length is the depth.
        ray = rays @ truth.R_nc[t].T
        with np.errstate(divide="ignore", invalid="ignore"):
            floor, back = truth.floor_height_m[t] / ray[..., 2], wall / (ray @ forward)
        depth = np.fmin(np.where(floor > 0, floor, np.inf), np.where(back > 0, back, np.inf))
        ends = np.concatenate([person.start[t], person.end[t]]) @ truth.R_nc[t]
        px = (ends[:, :2] / ends[:, 2:] * np.diag(matrix)[:2] + matrix[:2, 2]) * shrink
        edge = person.radius_m.max() / ends[:, 2].min() * matrix[0, 0] * shrink
        low, high = np.floor(px.min(axis=0) - edge).astype(int), np.ceil(px.max(axis=0) + edge).astype(int)
        box = tuple(slice(max(a, 0), max(b, 0)) for a, b in zip(low[::-1], high[::-1], strict=True))
        one = dataclasses.replace(person, start=person.start[t][None], end=person.end[t][None])
        seen = ray_lengths(one, np.zeros((1, 3)), ray[box].reshape(1, -1, 3))[0].min(axis=-1)
        depth[box] = np.fmin(depth[box], seen.reshape(depth[box].shape))
        # A pixel at an edge sees both sides.
        mixed = cv2.blur(depth, (3, 3))
        depth = np.where(rng.random(shape) < 0.3, mixed, depth)
        smooth = keep * smooth + np.sqrt(1 - keep**2) * _smooth(rng, shape)
        depth += (depth / 3) ** 2 * (WHITE_M * rng.normal(size=shape) + SMOOTH_M * smooth)
        depth[gaussian_filter(rng.normal(size=shape), 1.5) * 1.5 * 2 * np.sqrt(np.pi) > _HOLE] = 0.0
        yield depth.astype(np.float32)


#: Standard normal value that the share `HOLES` exceeds.
_HOLE = 1.75


def _smooth(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    noise = gaussian_filter(rng.normal(size=shape), 4.0)
    return noise / noise.std()
