"""Moments and powers of the legs' joints: those of the motion minus those of the ground reaction, from the ground up.

The moment of a joint value is the generalised force of OpenSim's inverse dynamics: internal (of muscles and ligaments),
in the direction in which the value grows, in Nm per kilogram; its power is moment times velocity (W/kg). The knee has
the sign of the house's angles (`body.angle_of`): positive flexes, so an extending moment is negative.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import Body, angle_of

from .dynamics import Dynamics, Motion
from .ground import GroundReaction

#: Joint values of a leg that have a moment.
JOINTS = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle")
#: Their angles, in the same order.
MOMENTS = tuple(angle_of(joint)[0] for joint in JOINTS)


def leg_moments(
    body: Body, d: Dynamics, ground: GroundReaction, motion: Motion
) -> tuple[Float[np.ndarray, "N 2 6"], Float[np.ndarray, "N 2 6"]]:
    """Return moments (Nm/kg) and powers (W/kg) of [left, right] and `MOMENTS`; NaN where contact is not known."""
    columns = np.array([[body.joint_names.index(f"{joint}_{side}") for joint in JOINTS] for side in "lr"])
    moment = np.stack(
        [generalised_without(d, c, ground.force_n[:, k], ground.centre_m[:, k]) for k, c in enumerate(columns)],
        axis=1,
    )
    sign = np.array([angle_of(joint)[1] for joint in JOINTS])
    return sign * moment, moment * motion.qvel[:, columns]


def generalised_without(
    d: Dynamics, joints: np.ndarray, force: np.ndarray, centre: np.ndarray, free: np.ndarray | None = None
) -> np.ndarray:
    """Return the generalised forces (N, J) of `joints` of a leg on whose foot `force` (N, 3) acts at `centre` (N, 3),
    with the moment `free` (N,) about the vertical; a foot in the air has no centre (NaN) and no force."""
    lever = np.where(np.isfinite(centre), centre, 0.0)[:, None] - d.anchor_m[:, joints]
    moment = np.cross(lever, force[:, None])
    if free is not None:
        moment[..., 2] += free[:, None]
    return d.generalised[:, joints] - np.sum(d.axis[:, joints] * moment, axis=-1)


def knee_adduction(body: Body, d: Dynamics, ground: GroundReaction) -> Float[np.ndarray, "N 2"]:
    """Return the moment (Nm/kg) of the ground reaction about each knee in the frontal plane of the shank, positive
    where it bends the shank inwards (external adduction). The inertia of shank and foot, small in stance, is left
    out."""
    moments = []
    for k, (side, sign) in enumerate((("l", -1.0), ("r", 1.0))):
        tibia = body.body_names.index(f"tibia_{side}")
        lever = np.nan_to_num(ground.centre_m[:, k]) - d.xpos[:, tibia]
        forward = d.xmat[:, tibia, :, 0]
        moments.append(sign * np.sum(np.cross(lever, ground.force_n[:, k]) * forward, axis=1))
    return np.stack(moments, axis=1)
