"""Priors over joints and shared parameters, and the numbers of a paramset as arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body
from pbl_pipeline.errors import PblError

from ._params import CostParams, GaussNewtonParams, ImplicitAdamParams
from .problem import Problem

#: Below this angle (deg) the paper's Lphone, which is not smooth, counts as smooth: nothing in single precision.
PAPER_PHONE_DEG = 1e-4
#: Cost of a floor's slope one standard deviation from level: that of a marker 3 px off in one frame.
SLOPE_COST = 0.03
#: One camera without 3D points cannot tell a small person from a far one: half this times the squared overall scale
#: parameter, an adult's standard deviation of 0.05 counted as the other priors are.
PIXELS_WEIGHT_SIZE = 0.1 / 0.05**2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Weights:
    """The numbers of a paramset as arrays, so that another paramset runs the same compiled program.

    Fields are named as in the paramset. `neutral`, `inverse_sd`: the pose prior; `smooth`: per (rad per frame^2 at 30
    Hz)^2, of slides per (m per frame^2)^2; `low`, `high`: joint limits; `scale_precision`, `floor_precision`: inverse
    variances of the scale parameters and of a floor's height and slopes.
    """

    weight_3d: Float[Array, ""]
    weight_2d: Float[Array, ""]
    weight_phone: Float[Array, ""]
    weight_offset_per_m2: Float[Array, ""]
    depth_ratio: Float[Array, ""]
    huber_3d_cm: Float[Array, ""]
    huber_2d_px: Float[Array, ""]
    weight_pose: Float[Array, ""]
    huber_phone_deg: Float[Array, ""]
    weight_limit: Float[Array, ""]
    clock_sd_s: Float[Array, ""]
    weight_floor: Float[Array, ""]
    weight_slide: Float[Array, ""]
    huber_floor_cm: Float[Array, ""]
    huber_slide_cm: Float[Array, ""]
    neutral: Float[Array, " Q"]
    inverse_sd: Float[Array, " Q"]
    smooth: Float[Array, " Q"]
    low: Float[Array, " Q"]
    high: Float[Array, " Q"]
    scale_precision: Float[Array, "S S"]
    floor_precision: Float[Array, " 3"]

    @classmethod
    def of(cls, body: Body, params: GaussNewtonParams | ImplicitAdamParams, size_unseen: bool = False) -> Weights:
        """Those of a paramset. `size_unseen`: nothing seen tells the person's size, so a prior does.

        Raises
        ------
        PblError
            FIT_INPUT: the paramset has a prior of no joint.
        """
        c, own = params.cost, params if isinstance(params, GaussNewtonParams) else None
        neutral, inverse_sd = pose_prior(body.joint_names, c.pose_prior_deg)
        scale = c.weight_scale * scale_precision(body.scale_names, c.scale_sd, c.scale_sides_sd)
        scale[0, 0] += PIXELS_WEIGHT_SIZE * size_unseen
        low, high = np.asarray(body.joint_range_rad).T
        slope = SLOPE_COST / np.deg2rad(own.slope_sd_deg) ** 2 if own else 0.0
        values: dict[str, Any] = {
            "huber_phone_deg": own.huber_phone_deg if own else PAPER_PHONE_DEG,
            "weight_limit": own.weight_limit_per_deg2 if own else 0.0,
            "clock_sd_s": own.clock_sd_s if own else 1.0,
            "weight_floor": own.weight_floor if own else 0.0,
            "weight_slide": own.weight_slide if own else 0.0,
            "huber_floor_cm": own.huber_floor_cm if own else 1.0,
            "huber_slide_cm": own.huber_slide_cm if own else 1.0,
            "neutral": neutral,
            "inverse_sd": inverse_sd,
            "smooth": np.where(body.is_slide, own.smooth_per_m2, own.smooth_per_rad2) if own else np.zeros(len(low)),
            "low": low,
            "high": high,
            "scale_precision": scale,
            # A floor's height is free, and held near 0 where nobody stands.
            "floor_precision": np.array([1e-6, slope, slope]),
        }
        values |= {f.name: getattr(c, f.name) for f in dataclasses.fields(CostParams) if f.name in _FIELDS}
        return cls(**{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})


_FIELDS = {f.name for f in dataclasses.fields(Weights)}


def pixels_alone(problem: Problem) -> bool:
    """Whether one camera without 3D points is all there is."""
    none = lambda c: not np.any(np.asarray(c) > 0)  # noqa: E731
    return none(problem.c_3d) and none(problem.c_world) and problem.c_2d.shape[1] == 1


# --- residuals over joints


def beyond_limit_deg(
    qpos: Float[Array, "*n Q"], low: Float[Array, " Q"], high: Float[Array, " Q"]
) -> Float[Array, "*n Q"]:
    """How far a joint is beyond its limit (deg, negative below the lower one), 0 inside."""
    return jnp.rad2deg(jnp.maximum(qpos - high, 0.0) + jnp.minimum(qpos - low, 0.0))


def pose_z(
    qpos: Float[Array, "*n Q"], neutral: Float[Array, " Q"], inverse_sd: Float[Array, " Q"]
) -> Float[Array, "*n Q"]:
    """Distance from the neutral pose in standard deviations; half its square is the negative logarithm of independent
    normal distributions. `inverse_sd` is 0 where a joint has no prior."""
    return (qpos - neutral) * inverse_sd


def bent(qpos: Float[Array, "F Q"], bend: Float[Array, "F 3"]) -> Float[Array, "F Q"]:
    """Second difference of each joint over frames, with the weights `bend` of the frames before, at and after."""
    before, after = shift(qpos, 1), shift(qpos, -1)
    return bend[:, :1] * before + bend[:, 1:2] * qpos + bend[:, 2:] * after


def shift(a: Array, by: int) -> Array:
    """Row i is row i - `by` of a, zeros beyond the ends."""
    none = jnp.zeros_like(a[: abs(by)])
    return jnp.concatenate([none, a[:-by]]) if by > 0 else jnp.concatenate([a[-by:], none])


# --- the paramset's priors as arrays


def pose_prior(
    joint_names: Sequence[str], pose_prior_deg: Sequence[tuple[str, float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Neutral angle (Q,) in rad and 1 / standard deviation (Q,) in 1/rad of each joint, 0 where there is no prior.

    A name means the joint of that name, or both sides of it (`hip_rotation` for `hip_rotation_r` and `_l`); the later
    entry wins.

    Raises
    ------
    PblError
        FIT_INPUT: no such joint, or a standard deviation that is not positive.
    """
    neutral, inverse_sd = np.zeros(len(joint_names)), np.zeros(len(joint_names))
    for name, mean_deg, sd_deg in pose_prior_deg:
        index = [i for i, n in enumerate(joint_names) if n in (name, f"{name}_r", f"{name}_l")]
        if not index or not sd_deg > 0:
            raise PblError(
                "FIT_INPUT",
                found=f"pose prior of {name!r} with standard deviation {sd_deg}",
                expected="a joint of the body and a positive number of degrees",
                next_step="correct the paramset",
                key=name,
            )
        neutral[index], inverse_sd[index] = np.deg2rad(mean_deg), 1 / np.deg2rad(sd_deg)
    return neutral, inverse_sd


def scale_precision(scale_names: Sequence[str], sd: float, sd_sides: float) -> Float[np.ndarray, "S S"]:
    """Inverse covariance of the scale parameters: a segment's against the whole body's, and a left segment's against
    the right one's. The first, the size of the whole body, is free.
    """
    out = np.eye(len(scale_names)) / sd**2
    out[0, 0] = 0.0
    for i, name in enumerate(scale_names):
        if name.startswith("left_"):
            pair = np.zeros(len(scale_names))
            pair[i], pair[list(scale_names).index(name.replace("left_", "right_"))] = 1.0, -1.0
            out += np.outer(pair, pair) / sd_sides**2
    return out
