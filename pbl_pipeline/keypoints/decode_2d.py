"""From the outputs of 2D keypoint models to places in the crop and scores."""

from __future__ import annotations

import numpy as np

_FLAT = 1e-12


def from_simcc(x: np.ndarray, y: np.ndarray, split: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, J, 2) in px of the crop and scores (N, J) from SimCC's two profiles (N, J, width * split) and
    (N, J, height * split): the place of the largest value on each axis, between the bins by the parabola through it
    and its neighbours. The score is the smaller of the two values, in 0..1 (Li et al. 2022, "SimCC", ECCV)."""
    at_x, top_x = _peak(x)
    at_y, top_y = _peak(y)
    return np.stack([at_x, at_y], axis=-1) / split, np.clip(np.minimum(top_x, top_y), 0.0, 1.0)


def from_heatmap(heatmap: np.ndarray, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, J, 2) in px of the crop of `size_px` (width, height) and scores (N, J) from heat maps (N, J, h, w):
    the place of the largest value, between the cells by the parabola along each axis; its value in 0..1 is the score.

    Cell i is at i * width / w: cells and pixels count from the centre of the first, or both from its edge less half a
    cell (`edge_shift`)."""
    n, j, h, w = heatmap.shape
    best = heatmap.reshape(n, j, -1).argmax(axis=2)
    row, column = best // w, best % w
    a, b = np.ogrid[:n, :j]
    at_x, top = _peak(heatmap[a, b, row])
    at_y, _ = _peak(heatmap[a, b, :, column])
    points = np.stack([at_x * size_px[0] / w, at_y * size_px[1] / h], axis=-1)
    return points, np.clip(top, 0.0, 1.0)


def edge_shift(shape: tuple[int, ...], size_px: tuple[int, int]) -> np.ndarray:
    """Half a cell (2,) of a heat map of `shape` (..., h, w) in px: what its centre is from its edge."""
    return np.array([size_px[0] / shape[-1], size_px[1] / shape[-2]]) / 2


def _peak(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place (N, J), between the bins, and value (N, J) of the largest of (N, J, K)."""
    index = profile.argmax(axis=2)
    inner = np.clip(index, 1, profile.shape[2] - 2)
    a, b = np.ogrid[: profile.shape[0], : profile.shape[1]]
    left, middle, right = (profile[a, b, inner + k].astype(np.float64) for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    step = np.where(bend < -_FLAT, 0.5 * (left - right) / np.where(bend < -_FLAT, bend, 1.0), 0.0)
    between = (inner == index) & (np.abs(step) <= 0.5)
    return index + np.where(between, step, 0.0), profile.max(axis=2).astype(np.float64)
