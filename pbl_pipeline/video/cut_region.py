"""Regions of pictures: some 256 x 256 pixels out of millions, turned and scaled."""

from __future__ import annotations

import math

import cv2
import numpy as np


def cut_image(image: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """`Frame.cut` of a picture (H, W, 3) uint8 that is converted already."""
    return cut_samples(image, matrix, size_px, 0.0)


def cut_samples(samples: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int], border: float) -> np.ndarray:
    """Bilinear, after averaging blocks of 2^n x 2^n samples where the region's pixels lie that far apart: a pixel that
    stands for fifty and shows one of them would flicker."""
    step = np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    block = 1 << max(0, math.floor(math.log2(max(step, 1.0))))
    if block > 1:
        samples, left, top = _needed(samples, matrix, size_px, block)
        if not samples.size:  # the region lies beyond the picture: any place there will do
            samples = np.full((block, block, *samples.shape[2:]), border, samples.dtype)
        down, right = (-n % block for n in samples.shape[:2])
        if down or right:  # the last block is not whole
            samples = cv2.copyMakeBorder(samples, 0, down, 0, right, cv2.BORDER_REPLICATE)
        size = samples.shape[1] // block, samples.shape[0] // block
        samples = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
        matrix = coarser(block, block) @ square(matrix - [[0, 0, left], [0, 0, top]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(samples, matrix, size_px, flags=flags, borderValue=(border,) * 4)


def _needed(
    samples: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int], block: int
) -> tuple[np.ndarray, int, int]:
    """The samples around the region, in whole blocks, and where they begin (x, y)."""
    width, height = size_px
    corners = matrix @ np.array([[0, width - 1, 0, width - 1], [0, 0, height - 1, height - 1], [1, 1, 1, 1]])
    starts = np.floor(corners.min(axis=1) / block - 1).astype(int) * block
    ends = np.ceil(corners.max(axis=1) / block + 2).astype(int) * block
    (left, top), (right, bottom) = np.maximum(starts, 0), np.maximum(ends, 0)
    return samples[top:bottom, left:right], int(left), int(top)


def coarser(x: int, y: int) -> np.ndarray:
    """(2, 3) matrix from pixel centres to the centres of blocks of x by y of them."""
    return np.array([[1 / x, 0.0, (1 / x - 1) / 2], [0.0, 1 / y, (1 / y - 1) / 2]])


def square(matrix: np.ndarray) -> np.ndarray:
    """A matrix (2, 3) as one (3, 3) that others can follow."""
    return np.vstack([matrix, [0.0, 0.0, 1.0]])
