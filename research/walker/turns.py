"""Heading of a motion, and the same motion turned about the vertical."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, load_body


def facing(qpos: Float[np.ndarray, "T 40"]) -> Float[np.ndarray, " 3"]:
    """Mean direction of the pelvis' forward axis in the model's ground (x ahead, y up, z right)."""
    names = load_body().joint_names
    turns = qpos[:, [names.index(n) for n in PELVIS_TURNS]]
    return Rotation.from_euler("ZXY", turns).apply([1.0, 0.0, 0.0]).mean(axis=0)


def turned(qpos: Float[np.ndarray, "T 40"], by_rad: float | Float[np.ndarray, " T"]) -> Float[np.ndarray, "T 40"]:
    """The same motion, turned about the world's vertical axis (counter-clockwise seen from above), by one angle or by
    one of each frame."""
    body = load_body()
    column = [body.joint_names.index(n) for n in PELVIS_TURNS]
    x, z = body.joint_names.index("pelvis_tx"), body.joint_names.index("pelvis_tz")
    out = np.array(qpos, float)
    # In the model's ground y is up: x ahead, z right. A turn about y has the same sign as one about the world's z.
    joints = Rotation.from_rotvec(np.multiply.outer(by_rad, [0.0, 1.0, 0.0])) * Rotation.from_euler(
        "ZXY", out[:, column]
    )
    angles = joints.as_euler("ZXY")
    angles[:, 2] = np.unwrap(angles[:, 2])
    out[:, column] = angles
    c, s = np.cos(by_rad), np.sin(by_rad)
    out[:, x], out[:, z] = c * qpos[:, x] + s * qpos[:, z], -s * qpos[:, x] + c * qpos[:, z]
    return out
