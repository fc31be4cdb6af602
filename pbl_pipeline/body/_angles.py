"""The joint values of the body as the angles that people read: degrees, the knee positive in flexion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pbl_pipeline.body.model import SLIDES

#: OpenSim's knee is negative in flexion: joint -> angle of the other sign. It is turned here and nowhere else.
_TURNED = {"knee_angle": "knee_flexion"}


def angle_of(joint: str) -> tuple[str, float]:
    """Name of a joint's angle and its sign against the joint's value: ("knee_flexion_r", -1.0) of "knee_angle_r".

    The side may be left out. Joints whose angle has the joint's own sign keep their name.
    """
    return _other_name(joint, _TURNED)


def joint_of(angle: str) -> tuple[str, float]:
    """The joint of an angle and its sign, as `angle_of`: ("knee_angle_r", -1.0) of "knee_flexion_r"."""
    return _other_name(angle, {angle: joint for joint, angle in _TURNED.items()})


def joint_angles(joint_names: Sequence[str], qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Angles (T,) in degrees of the joints that turn, by `angle_of` their names, from `qpos` (T, N) in radians."""
    out = {}
    for joint, values in zip(joint_names, np.asarray(qpos, float).T, strict=True):
        if joint not in SLIDES:
            name, sign = angle_of(joint)
            out[name] = sign * np.degrees(values)
    return out


def joint_angles_sd(joint_names: Sequence[str], qpos_sd: np.ndarray) -> dict[str, np.ndarray]:
    """Standard deviations (T,) in degrees of `joint_angles`, from those of qpos (T, N) in radians."""
    return {name: np.abs(sd) for name, sd in joint_angles(joint_names, qpos_sd).items()}


def _other_name(name: str, names: dict[str, str]) -> tuple[str, float]:
    for one, other in names.items():
        if name == one or name.startswith(f"{one}_"):
            return other + name.removeprefix(one), -1.0
    return name, 1.0
