"""A person who walks: joint values over time, as a function of a seed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import joint_of, load_body

from ._gait import MIDDLE_CURVES_DEG, OFFSET_SD_DEG, SIDE_CURVES_DEG, harmonics, wander, within
from ._path import choose_path, floor_path

#: How people differ: stride time and length of healthy adults (Perry and Burnfield 2010: 1.06 to 1.12 s, 1.3 to 1.5 m).
STRIDE_S = (1.10, 0.07)
STRIDE_M = (1.32, 0.09)
#: Standard deviation of a curve's range between people, and of one side against the other.
RANGE_SD, SIDES_SD = 0.08, 0.03
#: Within a walk: of a curve's range, of its mean (deg), of the phase (rad), all over seconds.
WALK_RANGE_SD, WALK_MEAN_SD_DEG, WALK_PHASE_SD = 0.04, 1.0, 0.06
_SLOW_HZ = (0.05, 0.7)
#: Way of the pelvis (m) within a stride: up and down, side to side, ahead and back of steady travel.
BOB_M, SWAY_M, SURGE_M = 0.020, 0.022, 0.012
#: Turns the body's frame (x forward, y up, z right) into the world's (z up).
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def walk_qpos(
    time_s: Float[np.ndarray, " T"],
    seed: int = 0,
    *,
    path: str | None = None,
    speed_m_per_s: float | None = None,
    stride_s: float | None = None,
    camera_height_m: float = 1.2,
    pelvis_height_m: float = 0.95,
) -> Float[np.ndarray, "T 40"]:
    """Joint values of a walk; the same seed is the same person and walk, at whatever times it is asked for.

    Stride time, speed, heading, path, and range and mean of every curve differ between seeds within the spread of
    healthy adults. Range, mean and phase also wander slowly within a walk, so no stride is like another. All curves
    have continuous derivatives.

    Parameters
    ----------
    time_s
        Increasing times (s); the path is chosen and placed by the first and the last.
    seed
        Of the person and the walk.
    path
        "straight" (along the line of sight, only as far as the person is well seen), "treadmill" (in place, any
        heading), "eight" (a figure of eight, any duration), all 4 to 6 m from the camera in the mean and inside an
        upright phone picture; None: chosen by the seed.
    speed_m_per_s, stride_s
        In place of the seed's own.
    camera_height_m, pelvis_height_m
        Above the floor. The world's origin is at the camera.

    Returns
    -------
    qpos : (T, 40)
        In the order of `Body.joint_names`, metres and radians; within the body's ranges.
    """
    time_s = np.asarray(time_s, np.float64)
    rng = np.random.default_rng([seed, 1])
    stride = within(rng, *STRIDE_S)
    length = within(rng, *STRIDE_M)
    stride = stride if stride_s is None else stride_s
    speed = length / stride if speed_m_per_s is None else speed_m_per_s
    phase = 2 * np.pi * (time_s / stride + rng.random()) + wander(rng, time_s, WALK_PHASE_SD, *_SLOW_HZ)

    chosen = choose_path(rng, speed * float(time_s[-1] - time_s[0]))
    floor, heading = floor_path(np.random.default_rng([seed, 2]), chosen if path is None else path, speed * time_s)
    surge = SURGE_M * np.sin(2 * phase + 0.4) + wander(rng, time_s, 0.03, *_SLOW_HZ)
    floor = floor + surge[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])

    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    qpos = np.zeros((len(time_s), len(body.joint_names)))
    for angle, curve in SIDE_CURVES_DEG.items():
        size, middle = within(rng, 1.0, RANGE_SD), within(rng, 0.0, OFFSET_SD_DEG[angle])
        for side, shift in (("r", 0.0), ("l", np.pi)):
            own_size, own_middle = within(rng, size, SIDES_SD), middle + within(rng, 0.0, 0.3 * OFFSET_SD_DEG[angle])
            deg = _curve(rng, time_s, phase + shift, curve, own_size, own_middle)
            joint, sign = joint_of(f"{angle}_{side}")
            qpos[:, column[joint]] = sign * np.radians(deg)
    pelvis = {}
    for joint, curve in MIDDLE_CURVES_DEG.items():
        size, middle = within(rng, 1.0, RANGE_SD), within(rng, 0.0, OFFSET_SD_DEG[joint])
        rad = np.radians(_curve(rng, time_s, phase, curve, size, middle))
        if joint in column:
            qpos[:, column[joint]] = rad
        else:
            pelvis[joint] = rad

    angles = np.column_stack([pelvis["tilt"], pelvis["list"], pelvis["rotation"]])
    for name, rad in zip(("tilt", "list", "rotation"), pelvis_joints(angles, heading).T, strict=True):
        qpos[:, column[f"pelvis_{name}"]] = rad
    # Over the standing foot: to the right in the right side's stance; highest in the middle of each stance.
    right = np.column_stack([np.sin(heading), -np.cos(heading)])
    floor = floor + (SWAY_M * np.sin(phase - 0.3) + wander(rng, time_s, 0.008, *_SLOW_HZ))[:, None] * right
    bob = -BOB_M * np.cos(2 * phase - 0.6) + wander(rng, time_s, 0.004, *_SLOW_HZ)
    height = pelvis_height_m - camera_height_m + bob
    rest = body.mj_model.body("pelvis").pos
    qpos[:, column["pelvis_tx"]] = floor[:, 0] - rest[0]
    qpos[:, column["pelvis_tz"]] = -(floor[:, 1] - rest[1])
    qpos[:, column["pelvis_ty"]] = height - rest[2]
    return qpos


def _curve(rng, time_s: np.ndarray, phase: np.ndarray, curve, size: float, middle: float) -> np.ndarray:
    mean, terms = curve
    swing = harmonics(phase, 0.0, terms) * size * (1 + wander(rng, time_s, WALK_RANGE_SD, *_SLOW_HZ))
    return mean + middle + swing + wander(rng, time_s, WALK_MEAN_SD_DEG, *_SLOW_HZ)


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
