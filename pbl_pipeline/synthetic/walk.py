"""A plain walk: textbook curves over the gait cycle, without anything that varies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import joint_of, load_body

from .curves import MIDDLE_CURVES_DEG, SIDE_CURVES_DEG, swing

#: Stride time of healthy adults (Perry and Burnfield 2010: 1.06 to 1.12 s).
STRIDE_S = 1.10
#: Way of the pelvis (m) within a stride: up and down, side to side.
BOB_M, SWAY_M = 0.020, 0.022
#: Height of the pelvis above the floor (m).
PELVIS_HEIGHT_M = 0.95
#: The pelvis' own angles among `MIDDLE_CURVES_DEG`.
_PELVIS = ("tilt", "list", "rotation")
#: Turns the body's frame (x forward, y up, z right) into the world's (z up).
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def plain_walk(
    time_s: Float[np.ndarray, " T"],
    *,
    stride_s: float = STRIDE_S,
    speed_m_per_s: float = 1.2,
    heading_rad: float = np.pi / 2,
    start_m: tuple[float, float] = (6.0, -1.8),
    camera_height_m: float = 1.2,
) -> Float[np.ndarray, "T 40"]:
    """Return joint values (T, 40) of a walk straight ahead along mean curves, each stride like the others.

    The right foot comes down at whole multiples of `stride_s`, the left one half a stride later; the pelvis is above
    `start_m` at time 0.
    """
    time_s = np.asarray(time_s, np.float64)
    phase = 2 * np.pi * time_s / stride_s
    angles = {a: c[0] + swing(c, phase) for a, c in MIDDLE_CURVES_DEG.items()}
    for side, shift in (("r", 0.0), ("l", np.pi)):
        angles |= {f"{a}_{side}": c[0] + swing(c, phase + shift) for a, c in SIDE_CURVES_DEG.items()}
    heading = np.full(len(time_s), float(heading_rad))
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    floor = np.asarray(start_m) + speed_m_per_s * time_s[:, None] * ahead
    height = PELVIS_HEIGHT_M - camera_height_m - BOB_M * np.cos(2 * phase - 0.6)
    return qpos_of(angles, floor, heading, SWAY_M * np.sin(phase - 0.3), height)


def qpos_of(
    angles_deg: Mapping[str, np.ndarray],
    floor_m: Float[np.ndarray, "T 2"],
    heading_rad: Float[np.ndarray, " T"],
    aside_m: Float[np.ndarray, " T"],
    height_m: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T 40"]:
    """Joint values from angles and the pelvis' way: `floor_m`, `aside_m` to its right, `height_m` in the world."""
    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    qpos = np.zeros((len(heading_rad), len(body.joint_names)))
    pelvis = [np.radians(angles_deg[name]) for name in _PELVIS]
    for angle, deg in angles_deg.items():
        if angle not in _PELVIS:
            joint, sign = joint_of(angle)
            qpos[:, column[joint]] = sign * np.radians(deg)
    for name, rad in zip(_PELVIS, pelvis_joints(np.column_stack(pelvis), heading_rad).T, strict=True):
        qpos[:, column[f"pelvis_{name}"]] = rad
    # Over the standing foot: to the right in the right side's stance; highest in the middle of each stance.
    floor = floor_m + aside_m[:, None] * np.column_stack([np.sin(heading_rad), -np.cos(heading_rad)])
    rest = body.mj_model.body("pelvis").pos
    qpos[:, column["pelvis_tx"]] = floor[:, 0] - rest[0]
    qpos[:, column["pelvis_tz"]] = -(floor[:, 1] - rest[1])
    qpos[:, column["pelvis_ty"]] = height_m - rest[2]
    return qpos


def pelvis_joints(angles_rad: Float[np.ndarray, "T 3"], heading_rad: Float[np.ndarray, " T"]) -> np.ndarray:
    """pelvis_tilt, pelvis_list and pelvis_rotation (T, 3) in rad of a pelvis that is turned against its heading.

    The model turns the pelvis about the world's axes (right, forward, up of a person who looks along x; tilt, list,
    rotation, each about the axes the ones before have turned). `angles_rad` are the same three about the axes of the
    walking direction, so that they are what gait people mean at any heading. The rotation is continuous in time.
    """
    turned = _UPRIGHT @ Rotation.from_euler("ZXY", angles_rad).as_matrix()
    world = Rotation.from_euler("Z", heading_rad[:, None]).as_matrix() @ turned
    joints = Rotation.from_matrix(_UPRIGHT.T @ world).as_euler("ZXY")
    rotation = np.unwrap(joints[:, 2])
    whole = np.round((np.median(heading_rad) - np.median(rotation)) / (2 * np.pi))
    return np.column_stack([joints[:, 0], joints[:, 1], rotation + 2 * np.pi * whole])
