"""What a detector does to the true points: noise with a memory, gross outliers, points not found.

Two kinds of model use the same fields: the benchmark's (`Noise()`), whose pixels err anew in each frame, and detectors
as they were measured on recordings with a truth (`DETECTORS`), whose pixels err with a memory and by constants.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

#: Longer side (px) of the picture whose pixels `Noise.xy_px` and `Noise.outlier_px` count.
PICTURE_PX = 1920


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
        of sight: a detector that leans a person towards the camera does so all the time. One number, or one for each of
        the camera's axes right, down, ahead.
    wander_deg, wander_correlation
        Of a further turn about these three axes that changes within the trial, and its correlation over 1/30 s.
    size_mean, size_sd
        Factor of the 3D points' distances from their middle, one for each trial.
    xy_px
        Of the pixels of a picture whose longer side has `PICTURE_PX` pixels, independent from frame to frame; in a
        larger picture as much larger, as is `outlier_px`: a detector errs by a fraction of what it looks at.
    xy_m, xy_correlation
        Of the pixels, as a length at the person's distance (a detector's pixels err with the size of the person), and
        the correlation of that over 1/30 s.
    xy_constant_m
        One such error per marker and trial that does not change.
    xy_file_px
        Of the pixels of the file, whatever its size, with the same correlation: a small person is seen in few pixels.
    far_more, far_still
        Of the leg that is away from the camera, in a view from the side: its errors of `across_m`, `along_m` and `xy_m`
        are larger by the fraction `far_more`, and its points lose the fraction `far_still` of their movement against
        the body. Less in oblique views, nothing from the front.
    exchanged_per_s, exchanged_s
        How often, and for how long, all points of the left and the right leg are exchanged.
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
    lean_deg: float | tuple[float, float, float] = 0.0
    wander_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wander_correlation: float = 0.98
    size_mean: float = 1.0
    size_sd: float = 0.0
    xy_px: float = 3.0
    xy_m: float = 0.0
    xy_correlation: float = 0.9
    xy_constant_m: float = 0.0
    xy_file_px: float = 0.0
    far_more: float = 0.0
    far_still: float = 0.0
    exchanged_per_s: float = 0.0
    exchanged_s: float = 0.2
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

#: BlazePose's two networks in the picture and in 3D, against the marker mocap of two phone clips (walk, standing up)
#: and against four calibrated cameras (balancing): six recordings, `python -m research.detector_errors`. What mocap and
#: detector call a joint is part of the constants. `xy_file_px`: of the same recordings in small pictures (`python -m
#: research.benchmarks.picture_size unit`). `far_more` is how much more the points away from the camera err;
#: `far_still` is of one clip from the side, the demo, where the far knee peaks at 61 deg with the heavy network, at 44
#: with the full one, and the near one at 80 and 75. Exchanged legs are corrected before the fit; none was left in these
#: recordings.
BLAZEPOSE_HEAVY_MEASURED = Noise(
    across_m=0.024,
    along_m=0.050,
    correlation=0.85,
    constant_m=0.028,
    constant_along_m=0.065,
    lean_deg=(5.4, 3.7, 2.1),
    wander_deg=(4.0, 4.7, 1.7),
    size_mean=0.94,
    size_sd=0.03,
    xy_px=0.0,
    xy_m=0.023,
    xy_correlation=0.73,
    xy_constant_m=0.017,
    xy_file_px=0.5,
    far_more=0.34,
    far_still=0.2,
    outlier_share=0.001,
    drop_share=0.0,
)
BLAZEPOSE_MEASURED = Noise(
    across_m=0.026,
    along_m=0.052,
    correlation=0.84,
    constant_m=0.025,
    constant_along_m=0.066,
    lean_deg=(2.8, 2.5, 1.3),
    wander_deg=(4.5, 5.4, 1.9),
    size_mean=0.95,
    size_sd=0.025,
    xy_px=0.0,
    xy_m=0.027,
    xy_correlation=0.74,
    xy_constant_m=0.019,
    xy_file_px=0.5,
    far_more=0.36,
    far_still=0.35,
    outlier_share=0.003,
    drop_share=0.0,
)
#: 87 points as the benchmark has them, but with pixels that err with a memory. Not measured on MeTRAbs, whose weights
#: cannot be had here: sizes are the benchmark's.
METRABS_MEMORY = Noise(xy_px=0.0, xy_m=0.009, xy_correlation=0.9)


@dataclasses.dataclass(frozen=True)
class DetectorModel:
    """Points of a detector, whether their distance is lost (`Keypoints.root_relative`), and how they err."""

    marker_set: str
    root_relative: bool
    noise: Noise


#: The error models that a corpus is seen with, by keypoint method.
DETECTORS: dict[str, DetectorModel] = {
    "blazepose-heavy": DetectorModel("blazepose_33", True, BLAZEPOSE_HEAVY_MEASURED),
    "blazepose-33": DetectorModel("blazepose_33", True, BLAZEPOSE_MEASURED),
    "metrabs-87": DetectorModel("bml_movi_87", False, METRABS_MEMORY),
}

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


def disturb(
    rng: np.random.Generator,
    noise: Noise,
    time_s: np.ndarray,
    x_cam: np.ndarray,
    sides: np.ndarray | None = None,
    focal_px: float = 0.0,
    picture_px: float = PICTURE_PX,
) -> Disturbance:
    """Draw the noise for true points `x_cam` (T, J, 3) in metres in the camera frame (not relative to the root).

    `sides` (J,): 1 for points of the right leg, -1 of the left one, 0 for all others; `focal_px` turns lengths in the
    picture into pixels; `picture_px`: longer side of the picture. What the benchmark's noise has is drawn first,
    so that further fields change nothing of it.
    """
    shape = x_cam.shape[:2]
    ray = x_cam / np.linalg.norm(x_cam, axis=-1, keepdims=True)
    unit = remembering(rng, noise.correlation, noise.correlation_step_s, time_s, x_cam.shape)
    sides = np.zeros(shape[1]) if sides is None else sides
    far = far_side(time_s, x_cam, sides) if noise.far_more or noise.far_still else np.zeros(shape)
    more = 1 + noise.far_more * far[..., None]
    depth = np.sum(unit * ray, axis=-1, keepdims=True)
    # Equal noise on all axes, stretched along the ray.
    xyz = more * (noise.across_m * unit + (noise.along_m - noise.across_m) * depth * ray)
    constant = rng.standard_normal((1, *x_cam.shape[1:]))
    along_m = noise.constant_m if noise.constant_along_m is None else noise.constant_along_m
    mean_ray = ray.mean(axis=0, keepdims=True)
    depth = np.sum(constant * mean_ray, axis=-1, keepdims=True)
    xyz = xyz + noise.constant_m * constant + (along_m - noise.constant_m) * depth * mean_ray
    picture = picture_px / PICTURE_PX
    xy = picture * noise.xy_px * rng.standard_normal((*shape, 2))
    outlier = rng.random(shape) < noise.outlier_share
    xyz += outlier[..., None] * _jump(rng, (*shape, 3), noise.outlier_m)
    xy += picture * outlier[..., None] * _jump(rng, (*shape, 2), noise.outlier_px)
    spread = noise.confidence + noise.confidence_sd * rng.standard_normal(shape)
    dropped = rng.random(shape) < noise.drop_share
    off = x_cam - x_cam.mean(axis=1, keepdims=True)
    turn = np.zeros((len(time_s), 3))
    if np.any(noise.lean_deg):
        turn = turn + rng.normal(0, noise.lean_deg, 3)
    if np.any(noise.wander_deg):
        turn = turn + noise.wander_deg * remembering(rng, noise.wander_correlation, 1 / 30, time_s, (len(time_s), 3))
    size = noise.size_mean + (noise.size_sd * rng.standard_normal() if noise.size_sd else 0.0)
    px_per_m = focal_px / x_cam[..., 2:]
    if noise.far_still:
        # Against the body's middle, and about what the point does over a stride.
        step = float(np.median(np.diff(time_s)))
        lost = noise.far_still * far[..., None] * (off - gaussian_filter1d(off, _STRIDE_S / step, axis=0))
        off_seen, xy = off - lost, xy - px_per_m * lost[..., :2]
    else:
        off_seen = off
    turned = Rotation.from_rotvec(np.repeat(turn, shape[1], axis=0), degrees=True).apply(off_seen.reshape(-1, 3))
    xyz += size * turned.reshape(off.shape) - off
    if noise.xy_m:
        slow = remembering(rng, noise.xy_correlation, 1 / 30, time_s, (*shape, 2))
        xy = xy + px_per_m * noise.xy_m * more * slow
    if noise.xy_constant_m:
        xy = xy + px_per_m * noise.xy_constant_m * rng.standard_normal((1, shape[1], 2))
    if noise.xy_file_px:
        xy = xy + noise.xy_file_px * remembering(rng, noise.xy_correlation, 1 / 30, time_s, (*shape, 2))
    return Disturbance(xyz, xy, outlier, dropped, np.clip(spread, 0.5, 0.99))


#: Time (s) over which the place of a point against the body is a stride's, not a step's; distance of the hips (m).
_STRIDE_S, _HIPS_M = 0.6, 0.17


def far_side(time_s: np.ndarray, x_cam: np.ndarray, sides: np.ndarray) -> Float[np.ndarray, "T J"]:
    """0 to 1: how much a point belongs to the leg that the other one hides, from the legs' mean distances (T, J)."""
    if not np.any(sides > 0) or not np.any(sides < 0):
        return np.zeros(x_cam.shape[:2])
    apart = x_cam[:, sides > 0, 2].mean(axis=1) - x_cam[:, sides < 0, 2].mean(axis=1)
    step = float(np.median(np.diff(time_s)))
    sideways = np.clip(gaussian_filter1d(apart, _STRIDE_S / step, mode="nearest") / _HIPS_M, -1, 1)
    return np.clip(sideways[:, None] * sides, 0, 1)


def exchanged(rng: np.random.Generator, noise: Noise, time_s: np.ndarray) -> Bool[np.ndarray, " T"]:
    """Frames in which the legs are exchanged: stretches of `exchanged_s` that begin at random."""
    out = np.zeros(len(time_s), bool)
    for start in rng.uniform(time_s[0], time_s[-1], rng.poisson(noise.exchanged_per_s * (time_s[-1] - time_s[0]))):
        out |= (time_s >= start) & (time_s < start + noise.exchanged_s)
    return out


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
