"""Points of both legs from angles of pelvis and legs: plain forward kinematics of hinges, in leg lengths."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ._sequence import POINTS

#: Angles of a leg, each (T, 2) [left, right] in degrees: flexion, adduction, internal rotation, dorsiflexion positive.
LEG_ANGLES = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_flexion", "ankle_dorsiflexion")
#: Those of the pelvis, each (T,) in degrees: anterior tilt, right side up, right side ahead positive.
PELVIS_ANGLES = ("pelvis_tilt", "pelvis_obliquity", "pelvis_rotation")
#: Places of the points in leg lengths (hip to floor): forward, outwards, up, each in the frame of its segment, which
#: begins at the hip (thigh), the knee (shank) or the ankle (foot). Proportions of the project's body, standing.
HALF_WIDTH, THIGH, SHANK = 0.098, 0.450, 0.460
_FOOT = {"heel": (-0.055, 0.0, -0.065), "mtp": (0.135, 0.005, -0.065), "tip": (0.205, 0.005, -0.075)}


def leg_points(
    angles_deg: dict[str, np.ndarray], heading_rad: np.ndarray, proportions: Float[np.ndarray, "2 8"]
) -> Float[np.ndarray, "T 6 2 3"]:
    """Points of both legs in leg lengths with the middle of the hips at the origin; z up.

    `proportions` multiplies, for left and right: pelvis, thigh, shank, then the foot's ankle height, heel, sole, toes,
    foot width. 1 is the usual.
    """
    rad = {k: np.radians(v) for k, v in angles_deg.items()}
    n = len(heading_rad)
    pelvis = _about("z", heading_rad + rad["pelvis_rotation"])
    pelvis = pelvis @ _about("x", -rad["pelvis_obliquity"]) @ _about("y", rad["pelvis_tilt"])
    out = np.empty((n, len(POINTS), 2, 3))
    for s, outwards in enumerate((1.0, -1.0)):
        width, thigh, shank, height, back, sole, toes, broad = proportions[s]
        turn = pelvis @ _about("y", -rad["hip_flexion"][:, s])
        turn = turn @ _about("x", -outwards * rad["hip_adduction"][:, s])
        turn = turn @ _about("z", -outwards * rad["hip_rotation"][:, s])
        hip = pelvis[:, :, 1] * (outwards * HALF_WIDTH * width)
        knee = hip - turn[:, :, 2] * (THIGH * thigh)
        turn = turn @ _about("y", rad["knee_flexion"][:, s])
        ankle = knee - turn[:, :, 2] * (SHANK * shank)
        turn = turn @ _about("y", -rad["ankle_dorsiflexion"][:, s])
        out[:, 0, s], out[:, 1, s], out[:, 2, s] = hip, knee, ankle
        for i, (name, longer) in enumerate((("heel", back), ("mtp", sole), ("tip", toes)), 3):
            x, y, z = _FOOT[name]
            x = _FOOT["mtp"][0] * sole + (x - _FOOT["mtp"][0]) * longer if name == "tip" else x * longer
            out[:, i, s] = ankle + turn @ np.array([x, outwards * y * broad, z * height])
    return out


def _about(axis: str, angle: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) about an axis of x forward, y left, z up."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((len(angle), 3, 3))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    k = 3 - i - j
    out[:, k, k] = 1.0
    out[:, i, i], out[:, i, j], out[:, j, i], out[:, j, j] = c, -s, s, c
    return out
