"""From where the camera saw the person: front, back, or which side."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses

FRONT, BACK, IPSILATERAL, CONTRALATERAL, MIXED = "front", "back", "ipsilateral", "contralateral", "mixed"
#: What a joint of the middle has where the camera stands on one side.
LATERAL = "lateral"
#: Fraction of the frames that one class must hold; below it the view is mixed.
SHARE = 0.7


def view_of_fit(fit: TrialFit, poses: BodyPoses) -> dict[str, str]:
    """View class for the joints of the "right" and "left" side: see `view_classes`.

    The camera stands at `camera_position_m`; of several cameras that is the first one.
    """
    pelvis = poses.index("pelvis")
    return view_classes(poses.position_m[:, pelvis], poses.rotation[:, pelvis, :, 0], fit.camera_position_m)


def view_classes(pelvis_m: np.ndarray, forward: np.ndarray, camera_m: np.ndarray) -> dict[str, str]:
    """View class per side from the heading of the pelvis against the line of sight, both in the horizontal plane.

    The direction from the person to the camera lies within 45 deg of the heading: "front"; within 45 deg of its
    opposite: "back"; else the camera is on one side: "ipsilateral" for the joints of that side and "contralateral" for
    the other's. Less than `SHARE` of the frames in one class (a turn, a walk past the camera), or no camera
    at all (a laboratory's markers): "mixed".

    Parameters
    ----------
    pelvis_m, forward
        (T, 3) in a z-up world, metres and any length; NaN where not known.
    camera_m
        (3,) or (T, 3) in the same world, metres.
    """
    sight = np.asarray(camera_m, float) - pelvis_m
    known = np.all(np.isfinite(sight), axis=1) & np.all(np.isfinite(forward), axis=1)
    if not known.any():
        return {"right": MIXED, "left": MIXED}
    ahead, to_camera = forward[known, :2], sight[known, :2]
    cross = ahead[:, 0] * to_camera[:, 1] - ahead[:, 1] * to_camera[:, 0]
    angle = np.degrees(np.arctan2(cross, np.sum(ahead * to_camera, axis=1)))  # positive: camera to the left
    quadrant = np.select([np.abs(angle) <= 45, np.abs(angle) >= 135, angle > 0], [FRONT, BACK, "left"], "right")
    names, counts = np.unique(quadrant, return_counts=True)
    most = str(names[np.argmax(counts)])
    if counts.max() < SHARE * len(quadrant):
        return {"right": MIXED, "left": MIXED}
    if most in (FRONT, BACK):
        return {"right": most, "left": most}
    return {side: IPSILATERAL if side == most else CONTRALATERAL for side in ("right", "left")}
