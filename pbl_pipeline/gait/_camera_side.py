"""On which side of a walking person the camera stands, and the leg that it sees behind the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .events import LEFT, RIGHT
from .ground import is_metric
from .motion import BodyPoses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

FRONT, BACK = "front", "back"
#: Fraction of the frames, or of the cycles, that must be seen from one side.
SHARE = 0.7


def camera_side(pelvis_m: np.ndarray, forward: np.ndarray, camera_m: np.ndarray) -> np.ndarray:
    """(T,) "front", "back", "left" or "right": the direction from the person to the camera, in the horizontal plane,
    within 45 deg of the heading, of its opposite, or to that side; empty where one of them is not known.

    `pelvis_m` and `forward` are (T, 3) in a z-up world, metres and any length; `camera_m` (3,) or (T, 3) in it.
    """
    sight = np.asarray(camera_m, float) - pelvis_m
    known = np.all(np.isfinite(sight), axis=1) & np.all(np.isfinite(forward), axis=1)
    ahead, to_camera = forward[known, :2], sight[known, :2]
    cross = ahead[:, 0] * to_camera[:, 1] - ahead[:, 1] * to_camera[:, 0]
    angle = np.degrees(np.arctan2(cross, np.sum(ahead * to_camera, axis=1)))  # positive: camera to the left
    out = np.full(len(sight), "", dtype="<U5")
    out[known] = np.select([np.abs(angle) <= 45, np.abs(angle) >= 135, angle > 0], [FRONT, BACK, LEFT], RIGHT)
    return out


def far_leg(fit: TrialFit, poses: BodyPoses) -> np.ndarray:
    """(T,) "left" or "right", the leg behind the other as one camera sees them; empty where neither is, in unknown
    frames, and for several cameras or a laboratory's markers."""
    pelvis = poses.index("pelvis")
    at = camera_side(poses.position_m[:, pelvis], poses.rotation[:, pelvis, :, 0], fit.camera_position_m)
    if is_metric(fit):
        return np.full(len(at), "", dtype=at.dtype)
    return np.select([at == LEFT, at == RIGHT], [RIGHT, LEFT], "")


def mostly(names: np.ndarray) -> str:
    """The name that `SHARE` of them are; empty where there is none."""
    found, counts = np.unique(names, return_counts=True)
    return str(found[np.argmax(counts)]) if len(found) and counts.max() >= SHARE * len(names) else ""
