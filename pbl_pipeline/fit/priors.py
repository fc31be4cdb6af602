"""Priors over joints and shared parameters, and the numbers of a paramset as arrays."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pbl_pipeline.body import PELVIS_TURNS, Body
from pbl_pipeline.errors import PblError

from .params import CostParams, GaussNewtonParams, ImplicitAdamParams
from .problem import Problem

#: Priors that were learned from people (`research/poses.py`).
DATA = Path(__file__).parent / "data"
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

    Fields are named as in the paramset. `neutral`, `whitener`, `pose_log_weight`: the pose prior, of C components;
    `pelvis`: as in `posture`;
    `smooth`: per (rad per frame^2 at 30 Hz)^2, of slides per (m per frame^2)^2; `low`, `high`: joint limits;
    `scale_precision`, `floor_precision`: inverse variances of the scale parameters and of a floor's height and slopes.
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
    neutral: Float[Array, "C Q"]
    whitener: Float[Array, "C Q Q"]
    pose_log_weight: Float[Array, " C"]
    pelvis: Int[Array, " P"]
    weight_pelvis: Float[Array, ""]
    pelvis_sd: Float[Array, ""]
    weight_detector: Float[Array, ""]
    lean_sd: Float[Array, ""]
    depth_sd_m: Float[Array, ""]
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
        neutral, whitener, pose_log_weight = pose_prior(body.joint_names, c.pose_prior_deg, c.pose_prior)
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
            "whitener": whitener,
            "pose_log_weight": pose_log_weight,
            "weight_pelvis": own.weight_pelvis if own else 0.0,
            "pelvis_sd": np.deg2rad(own.pelvis_sd_deg) if own else 1.0,
            "weight_detector": own.weight_detector if own else 0.0,
            "lean_sd": np.deg2rad(own.lean_sd_deg) if own else 1.0,
            "depth_sd_m": own.depth_sd_m if own else 1.0,
            "smooth": np.where(body.is_slide, own.smooth_per_m2, own.smooth_per_rad2) if own else np.zeros(len(low)),
            "low": low,
            "high": high,
            "scale_precision": scale,
            # A floor's height is free, and held near 0 where nobody stands.
            "floor_precision": np.array([1e-6, slope, slope]),
        }
        values |= {f.name: getattr(c, f.name) for f in dataclasses.fields(CostParams) if f.name in _FIELDS}
        inclined = c.pose_prior or (own and own.weight_pelvis)
        names = [n for n in PELVIS_TURNS if n in body.joint_names] if inclined else []
        pelvis = jnp.asarray([body.joint_names.index(n) for n in names], jnp.int32)
        return cls(pelvis=pelvis, **{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})


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


def rises(pelvis: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """How far the pelvis' forward axis rises and its right axis falls, from its three turns (`PELVIS_TURNS`, rad): the
    sines of its tilt (backwards positive) and list against the vertical, whichever way it faces."""
    tilt, list_, rotation = (pelvis[..., i] for i in range(3))
    forward = jnp.sin(tilt) * jnp.cos(rotation) + jnp.cos(tilt) * jnp.sin(list_) * jnp.sin(rotation)
    right = jnp.sin(tilt) * jnp.sin(rotation) - jnp.cos(tilt) * jnp.sin(list_) * jnp.cos(rotation)
    return jnp.stack([forward, -right], axis=-1)


def inclination(pelvis: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Tilt and list (rad) of a pelvis against the vertical from its three turns."""
    # Just short of 1, where the derivative of the arc is infinite.
    return jnp.arcsin(0.999 * rises(pelvis))


def posture(qpos: Float[Array, "*n Q"], pelvis: Int[Array, " P"]) -> Float[Array, "*n Q"]:
    """Joint values with the tilt and list of the pelvis (`pelvis`: its tilt, list and rotation among the joints; none
    in a body without it) against the vertical."""
    if not pelvis.shape[0]:
        return qpos
    return qpos.at[..., pelvis[:2]].set(inclination(qpos[..., pelvis]))


def pose_z(
    pose: Float[Array, "*n Q"], neutral: Float[Array, "C Q"], whitener: Float[Array, "C Q Q"]
) -> Float[Array, "*n C Q"]:
    """Distance of a posture from the middle of each component in standard deviations: half its square is the negative
    logarithm of a normal distribution. The columns of `whitener` are 0 where a joint has no prior."""
    return jnp.einsum("...cq,cpq->...cp", pose[..., None, :] - neutral, whitener)


def pose_cost(z: Float[Array, "*n C Q"], log_weight: Float[Array, " C"]) -> Float[Array, "*n"]:
    """Negative logarithm of the mixture's density, without its constant: half the square of z where there is one
    component."""
    return -jax.nn.logsumexp(log_weight - 0.5 * jnp.sum(z**2, axis=-1), axis=-1)


def responsibilities(z: Float[Array, "*n C Q"], log_weight: Float[Array, " C"]) -> Float[Array, "*n C"]:
    """How much of the density at a pose is each component's; the gradient of `pose_cost` is the components' own,
    weighted so."""
    return jax.nn.softmax(log_weight - 0.5 * jnp.sum(z**2, axis=-1), axis=-1)


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
    joint_names: Sequence[str], pose_prior_deg: Sequence[tuple[str, float, float]], learned: str = ""
) -> tuple[Float[np.ndarray, "C Q"], Float[np.ndarray, "C Q Q"], Float[np.ndarray, " C"]]:
    """Middle (C, Q) in rad, whitening matrix (C, Q, Q) in 1/rad, rows of 0 where there is no prior, and logarithmic
    weight (C,) of each component.

    A name of `pose_prior_deg` means the joint of that name, or both sides of it (`hip_rotation` for `hip_rotation_r`
    and `_l`); the later entry wins. `learned`: a mixture of `data/`, whose normal distributions with their full
    covariance take the place of the independent ones of their joints.

    Raises
    ------
    PblError
        FIT_INPUT: no such joint or prior, or a standard deviation that is not positive.
    """
    neutral, precision = np.zeros(len(joint_names)), np.zeros((len(joint_names),) * 2)
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
        neutral[index], precision[index, index] = np.deg2rad(mean_deg), np.deg2rad(sd_deg) ** -2
    if not learned:
        return neutral[None], square_root(precision)[None], np.zeros(1)
    poses = learned_poses(learned)
    index = [list(joint_names).index(n) for n in poses["joints"]]
    middles, whiteners, log_weights = [], [], []
    for component in poses["components"]:
        own_neutral, own_precision = neutral.copy(), precision.copy()
        inverse = np.linalg.inv(np.array(component["covariance_deg2"]) * np.deg2rad(1.0) ** 2)
        own_neutral[index] = np.deg2rad(component["mean_deg"])
        own_precision[index] = 0.0
        own_precision[np.ix_(index, index)] = inverse
        middles.append(own_neutral)
        whiteners.append(square_root(own_precision))
        log_weights.append(np.log(component["weight"]) + 0.5 * np.linalg.slogdet(inverse)[1])
    return np.array(middles), np.array(whiteners), np.array(log_weights) - max(log_weights)


def square_root(precision: Float[np.ndarray, "Q Q"]) -> Float[np.ndarray, "Q Q"]:
    """The symmetric matrix W of a positive semidefinite one with W W = precision."""
    values, vectors = np.linalg.eigh(precision)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def learned_poses(name: str) -> dict[str, Any]:
    """A mixture that was learned from people: `joints`, and `components` with `weight`, `mean_deg` and
    `covariance_deg2` of these joints.

    Raises
    ------
    PblError
        FIT_INPUT: there is no such prior.
    """
    path = DATA / f"{name}.json"
    if not path.is_file():
        raise PblError(
            "FIT_INPUT",
            found=f"pose prior {name!r}",
            expected=", ".join(sorted(p.stem for p in DATA.glob("*.json"))),
            next_step="correct the paramset",
            key=name,
        )
    return json.loads(path.read_text(encoding="utf-8"))


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
