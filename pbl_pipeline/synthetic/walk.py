"""A person who walks: joint values over time, as a function of a seed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, joint_of, load_body

from .curves import MIDDLE_CURVES_DEG, OFFSET_SD_DEG, SIDE_CURVES_DEG, swing, wander, within
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
#: The pelvis' own angles among `MIDDLE_CURVES_DEG`.
_PELVIS = ("tilt", "list", "rotation")
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

    angles = {}
    for angle, curve in SIDE_CURVES_DEG.items():
        size, middle = within(rng, 1.0, RANGE_SD), within(rng, 0.0, OFFSET_SD_DEG[angle])
        for side, shift in (("r", 0.0), ("l", np.pi)):
            own_size, own_middle = within(rng, size, SIDES_SD), middle + within(rng, 0.0, 0.3 * OFFSET_SD_DEG[angle])
            angles[f"{angle}_{side}"] = _curve(rng, time_s, phase + shift, curve, own_size, own_middle)
    for angle, curve in MIDDLE_CURVES_DEG.items():
        size, middle = within(rng, 1.0, RANGE_SD), within(rng, 0.0, OFFSET_SD_DEG[angle])
        angles[angle] = _curve(rng, time_s, phase, curve, size, middle)
    aside = SWAY_M * np.sin(phase - 0.3) + wander(rng, time_s, 0.008, *_SLOW_HZ)
    bob = -BOB_M * np.cos(2 * phase - 0.6) + wander(rng, time_s, 0.004, *_SLOW_HZ)
    return _qpos(angles, floor, heading, aside, pelvis_height_m - camera_height_m + bob)


def plain_walk(
    time_s: Float[np.ndarray, " T"],
    *,
    stride_s: float = STRIDE_S[0],
    speed_m_per_s: float = 1.2,
    heading_rad: float = np.pi / 2,
    start_m: tuple[float, float] = (6.0, -1.8),
    camera_height_m: float = 1.2,
    pelvis_height_m: float = 0.95,
) -> Float[np.ndarray, "T 40"]:
    """Joint values (T, 40) of the mean of all walkers of `walk_qpos`, who goes straight ahead and varies in nothing.

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
    height = pelvis_height_m - camera_height_m - BOB_M * np.cos(2 * phase - 0.6)
    return _qpos(angles, floor, heading, SWAY_M * np.sin(phase - 0.3), height)


def _qpos(
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


def _curve(rng, time_s: np.ndarray, phase: np.ndarray, curve, size: float, middle: float) -> np.ndarray:
    moving = swing(curve, phase) * size * (1 + wander(rng, time_s, WALK_RANGE_SD, *_SLOW_HZ))
    return curve[0] + middle + moving + wander(rng, time_s, WALK_MEAN_SD_DEG, *_SLOW_HZ)


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


def facing(qpos: Float[np.ndarray, "T 40"]) -> Float[np.ndarray, " 3"]:
    """Mean direction of the pelvis' forward axis in the model's ground (x ahead, y up, z right)."""
    names = load_body().joint_names
    turns = qpos[:, [names.index(n) for n in PELVIS_TURNS]]
    return Rotation.from_euler("ZXY", turns).apply([1.0, 0.0, 0.0]).mean(axis=0)


def turned(qpos: Float[np.ndarray, "T 40"], by_rad: float) -> Float[np.ndarray, "T 40"]:
    """The same motion, turned about the world's vertical axis (counter-clockwise seen from above)."""
    body = load_body()
    column = [body.joint_names.index(n) for n in PELVIS_TURNS]
    x, z = body.joint_names.index("pelvis_tx"), body.joint_names.index("pelvis_tz")
    out = np.array(qpos, float)
    # In the model's ground y is up: x ahead, z right. A turn about y has the same sign as one about the world's z.
    joints = Rotation.from_rotvec([0.0, by_rad, 0.0]) * Rotation.from_euler("ZXY", out[:, column])
    angles = joints.as_euler("ZXY")
    angles[:, 2] = np.unwrap(angles[:, 2])
    out[:, column] = angles
    c, s = np.cos(by_rad), np.sin(by_rad)
    out[:, x], out[:, z] = c * qpos[:, x] + s * qpos[:, z], -s * qpos[:, x] + c * qpos[:, z]
    return out
