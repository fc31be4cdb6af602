"""People who differ and whose walks vary: joint values over time and a person's size, as functions of a seed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SCALE_NAMES, MarkerSet
from pbl_pipeline.synthetic.observe import as_marker_set
from pbl_pipeline.synthetic.physique import SITE_SD_M
from pbl_pipeline.synthetic.plan import (
    BOB_M,
    MIDDLE_CURVES_DEG,
    OFFSET_SD_DEG,
    SIDE_CURVES_DEG,
    SWAY_M,
    qpos_of,
    swing,
    wander,
    within,
)
from research.walker.path import choose_path, floor_path

#: How people differ: stride time and length of healthy adults (Perry and Burnfield 2010: 1.06 to 1.12 s, 1.3 to 1.5 m).
STRIDE_S = (1.10, 0.07)
STRIDE_M = (1.32, 0.09)
#: Ahead and back of steady travel within a stride (m).
SURGE_M = 0.012
#: Standard deviation of a curve's range between people, and of one side against the other.
RANGE_SD, SIDES_SD = 0.08, 0.03
#: Within a walk: of a curve's range, of its mean (deg), of the phase (rad), all over seconds.
WALK_RANGE_SD, WALK_MEAN_SD_DEG, WALK_PHASE_SD = 0.04, 1.0, 0.06
_SLOW_HZ = (0.05, 0.7)
#: Standard deviation of a person's size.
SCALE_SD = 0.05


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
        Instead of the seed's own.
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
    return qpos_of(angles, floor, heading, aside, pelvis_height_m - camera_height_m + bob)


def _curve(rng, time_s: np.ndarray, phase: np.ndarray, curve, size: float, middle: float) -> np.ndarray:
    moving = swing(curve, phase) * size * (1 + wander(rng, time_s, WALK_RANGE_SD, *_SLOW_HZ))
    return curve[0] + middle + moving + wander(rng, time_s, WALK_MEAN_SD_DEG, *_SLOW_HZ)


def person(
    seed: int = 0, markers: str | MarkerSet = "bml_movi_87"
) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "J 3"]]:
    """Scale (8,) and marker offsets (J, 3) in m of a person.

    The eight parameters `s` of the body's size are normal with standard deviation 5 % (cut off at two of them), and
    `scale = 1 + s_overall (+ s_group)` as in `pbl_pipeline.fit`. Each offset is normal with 6 mm per axis, in the frame
    of the marker's body.
    """
    rng = np.random.default_rng([seed, 3])
    s = np.array([within(rng, 0.0, SCALE_SD) for _ in SCALE_NAMES])
    scale = 1 + s[0] + np.concatenate([[0.0], s[1:]])
    return scale, rng.normal(0, SITE_SD_M, (len(as_marker_set(markers)), 3))
