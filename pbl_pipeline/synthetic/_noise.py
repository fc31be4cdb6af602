"""What a detector does to the true points: noise with a memory, gross outliers, points not found."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations per axis, in the camera frame. The defaults are those of the project's benchmark.

    across_m, along_m
        Per frame and marker, across the line of sight (each of two axes) and along it.
    correlation, correlation_step_s
        Of that noise at times `correlation_step_s` apart; at other frame rates the memory in seconds is the same.
    constant_m, constant_along_m
        One error per marker and trial that does not change, across and along the line of sight (None: as across).
    lean_deg
        Of a turn of all points of a trial about their middle, about each of the camera's two level axes and its line
        of sight: a detector that leans a person towards the camera does so all the time.
    xy_px
        Of the pixels, independent from frame to frame.
    outlier_share, outlier_m, outlier_px
        Fraction of the points (marker and frame) that are far off, in 3D and in the picture at once: moved by a length
        between these bounds in any direction. Their confidence does not tell.
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
    lean_deg: float = 0.0
    xy_px: float = 3.0
    outlier_share: float = 0.02
    outlier_m: tuple[float, float] = (0.2, 0.6)
    outlier_px: tuple[float, float] = (30.0, 90.0)
    drop_share: float = 0.05
    confidence: float = 0.9
    confidence_sd: float = 0.04


#: What BlazePose does. Of its 3D points against four calibrated cameras together (three of the four views of the
#: Pose2Sim balancing trial, a person 3.3 m away; in the fourth it loses the person): they lean by 4 to 9 deg, which
#: moves by 1.4 to 6 deg within the trial; without that they are off by a constant 29 mm across and 70 to 98 mm along
#: the line of sight, and vary by 27 to 37 mm and 42 to 54 mm, 0.94 correlated over 1/60 s.
BLAZEPOSE_NOISE = Noise(
    across_m=0.030,
    along_m=0.046,
    correlation=0.94,
    correlation_step_s=1 / 60,
    constant_m=0.030,
    constant_along_m=0.083,
    lean_deg=5.0,
    xy_px=3.0,
)

#: The true points, all found.
NO_NOISE = Noise(
    across_m=0, along_m=0, constant_m=0, xy_px=0, outlier_share=0, drop_share=0, confidence=0.9, confidence_sd=0
)


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """What is added to the true points (T, J): `xyz_m` in the camera frame, `xy_px`; and which are wrong or missing."""

    xyz_m: Float[np.ndarray, "T J 3"]
    xy_px: Float[np.ndarray, "T J 2"]
    outlier: Bool[np.ndarray, "T J"]
    dropped: Bool[np.ndarray, "T J"]
    confidence: Float[np.ndarray, "T J"]


def disturb(rng: np.random.Generator, noise: Noise, time_s: np.ndarray, x_cam: np.ndarray) -> Disturbance:
    """Draw the noise for true points `x_cam` (T, J, 3) in metres in the camera frame (not relative to the root)."""
    shape = x_cam.shape[:2]
    ray = x_cam / np.linalg.norm(x_cam, axis=-1, keepdims=True)
    unit = remembering(rng, noise.correlation, noise.correlation_step_s, time_s, x_cam.shape)
    depth = np.sum(unit * ray, axis=-1, keepdims=True)
    # Equal noise on all axes, stretched along the ray.
    xyz = noise.across_m * unit + (noise.along_m - noise.across_m) * depth * ray
    constant = rng.standard_normal((1, *x_cam.shape[1:]))
    along_m = noise.constant_m if noise.constant_along_m is None else noise.constant_along_m
    mean_ray = ray.mean(axis=0, keepdims=True)
    depth = np.sum(constant * mean_ray, axis=-1, keepdims=True)
    xyz = xyz + noise.constant_m * constant + (along_m - noise.constant_m) * depth * mean_ray
    xy = noise.xy_px * rng.standard_normal((*shape, 2))
    outlier = rng.random(shape) < noise.outlier_share
    xyz += outlier[..., None] * _jump(rng, (*shape, 3), noise.outlier_m)
    xy += outlier[..., None] * _jump(rng, (*shape, 2), noise.outlier_px)
    spread = noise.confidence + noise.confidence_sd * rng.standard_normal(shape)
    dropped = rng.random(shape) < noise.drop_share
    if noise.lean_deg:
        off = x_cam - x_cam.mean(axis=1, keepdims=True)
        xyz += (
            Rotation.from_rotvec(rng.normal(0, noise.lean_deg, 3), degrees=True)
            .apply(off.reshape(-1, 3))
            .reshape(off.shape)
            - off
        )
    return Disturbance(xyz, xy, outlier, dropped, np.clip(spread, 0.5, 0.99))


def remembering(
    rng: np.random.Generator, correlation: float, step_s: float, time_s: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Unit normal noise of `shape` (T, ...) whose correlation falls to `correlation` within `step_s`, exponentially."""
    fresh = rng.standard_normal(shape)
    out = fresh.copy()
    rho = correlation ** (np.diff(time_s) / step_s)
    for t, r in enumerate(rho, 1):
        out[t] = r * out[t - 1] + np.sqrt(1 - r**2) * fresh[t]
    return out


def _jump(rng: np.random.Generator, shape: tuple[int, ...], bounds: tuple[float, float]) -> np.ndarray:
    way = rng.standard_normal(shape)
    return way / np.linalg.norm(way, axis=-1, keepdims=True) * rng.uniform(*bounds, (*shape[:-1], 1))
