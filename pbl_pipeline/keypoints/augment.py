"""Test-time augmentations: the crop shown several times, a little other each time, and what is made of the answers.

Figures of scale, rotation and gamma as MeTRAbs uses them (Sarandi et al. 2023, WACV, and its published PyTorch code),
so that the spread of its answers is the one for which the paper states its confidence.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import expit

#: Rotations up to this to either side (deg); scales and exponents of gamma from and to.
_ROTATION_DEG = 25.0
_SCALES = (0.8, 1.0, 1.1)
_GAMMAS = (0.6, 1.0)


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """`scale` of what is seen, `roll_rad` clockwise, left and right exchanged, exponent `gamma` of values in 0..1."""

    scale: float = 1.0
    roll_rad: float = 0.0
    mirrored: bool = False
    gamma: float = 1.0


def augmentations(n: int) -> tuple[Augmentation, ...]:
    """The `n` augmentations, always the same ones; `n` = 1 is the crop as it is, 2 it and its mirror image.

    From 3 on: rotations evenly from -25 to 25 deg, scales from 0.8 to 1.1, gamma from 0.6 to 1, every other mirrored.
    """
    if n < 1:
        raise ValueError(f"{n} augmentations")
    if n <= 2:
        return (Augmentation(), Augmentation(mirrored=True))[:n]
    half = n // 2
    low, middle, high = _SCALES
    scale = np.concatenate([np.linspace(low, middle, half, endpoint=False), np.linspace(middle, high, n - half)])
    roll = np.radians(np.linspace(-_ROTATION_DEG, _ROTATION_DEG, n))
    gamma = np.linspace(*_GAMMAS, n)
    mirrored = (np.arange(n) - half) % 2 != 0
    values = zip(scale, roll, mirrored, gamma, strict=True)
    return tuple(Augmentation(float(s), float(r), bool(m), float(g)) for s, r, m, g in values)


def sd_confidence(sigma_mm: np.ndarray, half_mm: float = 30.0, width_mm: float = 10.0) -> np.ndarray:
    """c = 1 / (1 + exp((sigma - half) / width)): 0.5 at 30 mm (the paper, section Keypoint Detection).

    `sigma_mm` is the standard deviation of a 3D point over the augmentations (`spread_mm`).
    """
    return expit((half_mm - np.asarray(sigma_mm, np.float64)) / width_mm)


def aligned(xyz: np.ndarray) -> np.ndarray:
    """Answers (..., A, J, 3), each moved by the shift that brings it onto the others; axes stay as they are.

    The network gives a shape, not a place. First the means of all points coincide, then the median deviation from the
    mean answer goes from each axis, so that a few points that differ do not move the others.
    """
    centred = xyz - xyz.mean(axis=-2, keepdims=True)
    off = centred - centred.mean(axis=-3, keepdims=True)
    return centred - np.median(off, axis=-2, keepdims=True)


def spread_mm(xyz_m: np.ndarray) -> np.ndarray:
    """(..., J) standard deviation in mm of aligned answers (..., A, J, 3) in m: the root mean square distance from
    their mean over the A answers. One answer has none: 0."""
    off = xyz_m - xyz_m.mean(axis=-3, keepdims=True)
    return 1000.0 * np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=-2))
