"""The numbers of a paramset as arrays, so that another paramset runs the same compiled program."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from pbl_pipeline.body import PELVIS_TURNS, Body

from .params import GaussNewtonParams, ImplicitAdamParams
from .priors import pose_prior, scale_precision

#: Below this angle (deg) the paper's Lphone, which is not smooth, counts as smooth: nothing in single precision.
PAPER_PHONE_DEG = 1e-4
#: One camera without 3D points cannot tell a small person from a far one: half this times the squared overall scale
#: parameter, an adult's standard deviation of 0.05 counted as the other priors are.
PIXELS_WEIGHT_SIZE = 0.1 / 0.05**2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Weights:
    """Every number of a paramset by its name, as in ``weights["weight_3d"]``, and the priors of the body's joints."""

    numbers: dict[str, Float[Array, ""]]
    #: The pose prior: middle, whitening matrix and logarithmic weight of each of C components.
    neutral: Float[Array, "C Q"]
    whitener: Float[Array, "C Q Q"]
    pose_log_weight: Float[Array, " C"]
    #: Tilt, list and rotation of the pelvis among the joints if a term needs its inclination, else none.
    pelvis: Int[Array, " P"]
    #: Of smoothness, of each joint.
    smooth: Float[Array, " Q"]
    #: Joint limits (rad).
    low: Float[Array, " Q"]
    high: Float[Array, " Q"]
    #: Inverse covariance of the scale parameters, and inverse variance of the first if it is not observed.
    scale_precision: Float[Array, "S S"]
    size_precision: Float[Array, ""]

    def __getitem__(self, name: str) -> Float[Array, ""]:
        return self.numbers[name]

    @classmethod
    @functools.lru_cache(16)
    def of(cls, body: Body, params: GaussNewtonParams | ImplicitAdamParams, size_unseen: bool = False) -> Weights:
        """Return those of a paramset. `size_unseen`: the person's size is not observed and needs a prior.

        Raises `PblError` FIT_INPUT: the paramset has a prior of an unknown joint.
        """
        cost = params.cost
        # The paper's solver evaluates the paper's terms and priors alone, which need no other number of these.
        own = params if isinstance(params, GaussNewtonParams) else GaussNewtonParams(huber_phone_deg=PAPER_PHONE_DEG)
        numbers = {
            f.name: v for p in (own, cost) for f in dataclasses.fields(p) if isinstance(v := getattr(p, f.name), float)
        }
        neutral, whitener, pose_log_weight = pose_prior(body.joint_names, cost.pose_prior_deg, cost.pose_prior)
        low, high = np.asarray(body.joint_range_rad).T
        inclined = cost.pose_prior or own.weight_pelvis
        pelvis = [body.joint_names.index(n) for n in PELVIS_TURNS if n in body.joint_names] if inclined else []
        smooth = np.where(body.is_slide, own.smooth_per_m2, own.smooth_per_rad2)
        if own.smooth_up_per_m2:
            smooth[[n == "pelvis_ty" for n in body.joint_names]] = own.smooth_up_per_m2
        values: dict[str, Any] = {
            "numbers": numbers,
            "neutral": neutral,
            "whitener": whitener,
            "pose_log_weight": pose_log_weight,
            "smooth": smooth,
            "low": low,
            "high": high,
            "scale_precision": scale_precision(body.scale_names, cost.scale_sd, cost.scale_sides_sd),
            "size_precision": PIXELS_WEIGHT_SIZE * size_unseen,
        }
        arrays = jax.tree.map(lambda v: np.asarray(v, np.float32), values)
        return cls(**jax.device_put(arrays | {"pelvis": np.asarray(pelvis, np.int32)}))
