"""Result of every solver, and its residuals against the keypoints."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.results import DepthFit, SensorFit

from .keypoint_terms import in_camera, mean_weights, offset_m, residual_2d_px, residual_3d_cm
from .problem import Problem
from .solvers.result import Result
from .term import square


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """On the F frames of a problem and its J markers; residuals are NaN where nothing was seen.

    x_world_m; residual_2d_px (pixels of the file) and residual_3d_m: means over the views that saw the marker (3D of a
    camera: with the mean over the markers removed; in the world: as it is); body_axis_m: from between the heels to the
    head.
    """

    x_world_m: Float[Array, "F J 3"]
    residual_2d_px: Float[Array, "F J"]
    residual_3d_m: Float[Array, "F J"]
    body_axis_m: Float[Array, "F 3"]


@dataclasses.dataclass(frozen=True)
class Solution:
    """A fitted session: F frames (padding included), V views, J markers (without padding), N trials.

    qpos in m and rad; R_nc: camera to world; s: the paper's scale parameters; scale: their multipliers; clock_s: sensor
    time minus video time of each trial, 0 where not estimated; loss_trace: (step, loss) of K steps; qpos_sd: standard
    deviations, None if the solver computes none; pelvis_told: 1 in frames with the augmenter's tilt of the pelvis, None
    if the method does not use it; metre: metres of the solution in one of the fit; sensors: what was found of those
    worn, in each trial, and depths of its depths, empty without any; result: reason why the solver ended.
    """

    qpos: Float[np.ndarray, "F Q"]
    R_nc: Float[np.ndarray, "F V 3 3"]
    s: Float[np.ndarray, " S"]
    scale: Float[np.ndarray, " S"]
    site_offset_m: Float[np.ndarray, "J 3"]
    clock_s: Float[np.ndarray, " N"]
    loss_trace: Float[np.ndarray, "K 2"]
    compile_seconds: float
    seconds: float
    iterations: int
    result: Result
    outcome: Outcome
    qpos_sd: Float[np.ndarray, "F Q"] | None = None
    pelvis_told: Float[np.ndarray, " F"] | None = None
    metre: float = 1.0
    sensors: tuple[tuple[SensorFit, ...], ...] = ()
    depths: tuple[DepthFit | None, ...] = ()


def outcome(p: Problem, x: Float[Array, "F P 3"], R_nc: Float[Array, "F V 3 3"]) -> Outcome:
    """The outcome of fitted points and camera orientations."""
    markers, _, ends = p.split(x)
    px = m = jnp.full(markers.shape[:2], jnp.nan)
    if p.c_2d.shape[1] > 0:
        x_cam = in_camera(markers, R_nc, p.p_nc)
        r = residual_2d_px(x_cam, p.xy_px, p.camera_matrix) * p.pixel_px[..., None, None]
        px = _mean_seen(square(r), p.c_2d)
        centred = mean_weights(p.c_3d, p.weight_3d)
        r = residual_3d_cm(x_cam - offset_m(x_cam, p.x_cam, centred), p.x_cam)
        m = 0.01 * _mean_seen(square(r), p.c_3d)
    if p.c_world.shape[1]:
        m = jnp.where(p.c_world > 0, 0.01 * jnp.sqrt(square(residual_3d_cm(markers, p.x_world))), jnp.nan)
    axis = ends[:, 0] - 0.5 * (ends[:, 1] + ends[:, 2]) if ends.shape[1] else jnp.full((x.shape[0], 3), jnp.nan)
    return Outcome(markers, px, m, axis)


def _mean_seen(e2: Float[Array, "F V J"], c: Float[Array, "F V J"]) -> Float[Array, "F J"]:
    """Mean root over the views that saw a marker, NaN where none did."""
    seen = c > 0
    count = jnp.sum(seen, axis=1)
    mean = jnp.sum(jnp.where(seen, jnp.sqrt(e2), 0.0), axis=1) / jnp.maximum(count, 1)
    return jnp.where(count > 0, mean, jnp.nan)
