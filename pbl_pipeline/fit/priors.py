"""Priors over joints and body size as arrays: independent ones of a paramset, and mixtures learned from people."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pbl_pipeline.errors import PblError

#: Priors that were learned from people (`research/poses.py`).
DATA = Path(__file__).parent / "data"


def pose_prior(
    joint_names: Sequence[str], pose_prior_deg: Sequence[tuple[str, float, float]], learned: str = ""
) -> tuple[Float[np.ndarray, "C Q"], Float[np.ndarray, "C Q Q"], Float[np.ndarray, " C"]]:
    """Middle (C, Q) in rad, whitening matrix (C, Q, Q) in 1/rad, with rows of 0 for joints without a prior, and
    logarithmic weight (C,) of each component.

    A name of `pose_prior_deg` means the joint of that name, or both sides of it (`hip_rotation` for `hip_rotation_r`
    and `_l`); the later entry wins. `learned`: a mixture of `data/`, whose normal distributions with their full
    covariance take the place of the independent ones of their joints.

    Raises `PblError` FIT_INPUT: an unknown joint or prior, or a standard deviation that is not positive.
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

    Raises `PblError` FIT_INPUT: an unknown prior.
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
