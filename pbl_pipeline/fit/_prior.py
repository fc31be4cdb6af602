"""The pose prior of a paramset as arrays over the joints of the body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline.errors import PblError


def prior_of(
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
