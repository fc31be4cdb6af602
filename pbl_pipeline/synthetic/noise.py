"""Errors of a detector: noise correlated in time, gross outliers, points not found."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from pbl_pipeline.body import MarkerSet

#: Longer side (px) of the picture whose pixels `Noise.xy_px` and `Noise.outlier_px` count.
PICTURE_PX = 1920


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """Errors of the true points (T, J): `xyz_m` in the camera frame, `xy_px`; and outliers and missing points."""

    xyz_m: Float[np.ndarray, "T J 3"]
    xy_px: Float[np.ndarray, "T J 2"]
    outlier: Bool[np.ndarray, "T J"]
    dropped: Bool[np.ndarray, "T J"]
    confidence: Float[np.ndarray, "T J"]


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations per axis, in the camera frame. The defaults are those of our benchmark.

    across_m, along_m
        Per frame and marker, across the line of sight (each of two axes) and along it.
    correlation, correlation_step_s
        Of that noise at times `correlation_step_s` apart; at other frame rates its correlation time is the same.
    constant_m, constant_along_m
        One error per marker and trial that does not change, across and along the line of sight (None: as across).
    xy_px
        Of the pixels of a picture whose longer side has `PICTURE_PX` pixels, independent from frame to frame; scaled
        with the size of the picture, as is `outlier_px`: the error of a detector is a fraction of its region.
    xy_m, xy_correlation
        Of the pixels, as a length at the person's distance, and the correlation of that over 1/30 s.
    outlier_share, outlier_m, outlier_px
        Fraction of the points (marker and frame) that are far off, in 3D and in the picture at once: moved by a length
        between these bounds in any direction. Their confidence is not lower.
    drop_share
        Fraction of the points that are not found: NaN with confidence 0.
    confidence, confidence_sd
        Of the points found; kept within 0.5 and 0.99.
    """

    across_m: float = 0.008
    along_m: float = 0.025
    correlation: float = 0.9
    correlation_step_s: float = 1 / 30
    constant_m: float = 0.010
    constant_along_m: float | None = None
    xy_px: float = 3.0
    xy_m: float = 0.0
    xy_correlation: float = 0.9
    outlier_share: float = 0.02
    outlier_m: tuple[float, float] = (0.2, 0.6)
    outlier_px: tuple[float, float] = (30.0, 90.0)
    drop_share: float = 0.05
    confidence: float = 0.9
    confidence_sd: float = 0.04

    def disturb(
        self,
        rng: np.random.Generator,
        time_s: np.ndarray,
        x_cam: Float[np.ndarray, "T J 3"],
        markers: MarkerSet,
        focal_px: float,
        picture_px: float,
    ) -> Disturbance:
        """Draw the noise of the true points `x_cam` (m, in the camera frame, not relative to the root).

        `markers` names the points; `focal_px` turns lengths in the picture into pixels; `picture_px`: longer side of
        the picture.
        """
        made = self.independent(rng, time_s, x_cam, picture_px)
        return dataclasses.replace(made, xy_px=made.xy_px + self.correlated_px(rng, time_s, x_cam, focal_px))

    def independent(
        self,
        rng: np.random.Generator,
        time_s: np.ndarray,
        x_cam: Float[np.ndarray, "T J 3"],
        picture_px: float,
        factor: float | Float[np.ndarray, "T J"] = 1.0,
    ) -> Disturbance:
        """Draw all errors but `correlated_px`, independent between points. `factor`: of `across_m` and `along_m`."""
        shape = x_cam.shape[:2]
        ray = x_cam / np.linalg.norm(x_cam, axis=-1, keepdims=True)
        unit = correlated(rng, self.correlation, self.correlation_step_s, time_s, x_cam.shape)
        depth = np.sum(unit * ray, axis=-1, keepdims=True)
        # Equal noise on all axes, stretched along the ray.
        xyz = np.asarray(factor)[..., None] * (self.across_m * unit + (self.along_m - self.across_m) * depth * ray)
        constant = rng.standard_normal((1, *x_cam.shape[1:]))
        along_m = self.constant_m if self.constant_along_m is None else self.constant_along_m
        mean_ray = ray.mean(axis=0, keepdims=True)
        depth = np.sum(constant * mean_ray, axis=-1, keepdims=True)
        xyz = xyz + self.constant_m * constant + (along_m - self.constant_m) * depth * mean_ray
        picture = picture_px / PICTURE_PX
        xy = picture * self.xy_px * rng.standard_normal((*shape, 2))
        outlier = rng.random(shape) < self.outlier_share
        xyz += outlier[..., None] * _jump(rng, (*shape, 3), self.outlier_m)
        xy += picture * outlier[..., None] * _jump(rng, (*shape, 2), self.outlier_px)
        spread = self.confidence + self.confidence_sd * rng.standard_normal(shape)
        dropped = rng.random(shape) < self.drop_share
        return Disturbance(xyz, xy, outlier, dropped, np.clip(spread, 0.5, 0.99))

    def correlated_px(
        self,
        rng: np.random.Generator,
        time_s: np.ndarray,
        x_cam: Float[np.ndarray, "T J 3"],
        focal_px: float,
        factor: float | Float[np.ndarray, "T J"] = 1.0,
    ) -> Float[np.ndarray, "T J 2"]:
        """Draw the errors of `xy_m` in pixels. `factor`: of their size."""
        if not self.xy_m:
            return np.zeros((*x_cam.shape[:2], 2))
        unit = correlated(rng, self.xy_correlation, 1 / 30, time_s, (*x_cam.shape[:2], 2))
        return focal_px / x_cam[..., 2:] * self.xy_m * np.asarray(factor)[..., None] * unit


#: The benchmark's noise, but its errors in the picture are correlated in time.
CORRELATED_NOISE = Noise(xy_px=0.0, xy_m=0.009, xy_correlation=0.9)

#: The true points, all found.
NO_NOISE = Noise(
    across_m=0, along_m=0, constant_m=0, xy_px=0, outlier_share=0, drop_share=0, confidence=0.9, confidence_sd=0
)


def correlated(
    rng: np.random.Generator, correlation: float, step_s: float, time_s: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Draw unit normal noise of `shape` (T, ...) whose correlation falls to `correlation` within `step_s`."""
    fresh = rng.standard_normal(shape)
    out = fresh.copy()
    rho = correlation ** (np.diff(time_s) / step_s)
    for t, r in enumerate(rho, 1):
        out[t] = r * out[t - 1] + np.sqrt(1 - r**2) * fresh[t]
    return out


def _jump(rng: np.random.Generator, shape: tuple[int, ...], bounds: tuple[float, float]) -> np.ndarray:
    way = rng.standard_normal(shape)
    return way / np.linalg.norm(way, axis=-1, keepdims=True) * rng.uniform(*bounds, (*shape[:-1], 1))
