"""From where the camera saw the person, as a class of each side's joints: front, back, or which side."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses, camera_side, mostly

FRONT, BACK, IPSILATERAL, CONTRALATERAL, MIXED = "front", "back", "ipsilateral", "contralateral", "mixed"
#: View of a joint of the middle if the camera stands on one side.
LATERAL = "lateral"


def view_of_fit(fit: TrialFit, poses: BodyPoses) -> dict[str, str]:
    """View class for the joints of the "right" and "left" side: see `view_classes`.

    The camera stands at `camera_position_m`; of several cameras that is the first one.
    """
    pelvis = poses.index("pelvis")
    return view_classes(poses.position_m[:, pelvis], poses.rotation[:, pelvis, :, 0], fit.camera_position_m)


def view_classes(pelvis_m: np.ndarray, forward: np.ndarray, camera_m: np.ndarray) -> dict[str, str]:
    """View class per side from where the camera stands in most frames (`gait.camera_side`, with its arguments): "front"
    or "back"; else "ipsilateral" for the joints of the side on which it is and "contralateral" for the other's. Where
    no class holds 70 % of the known frames (a turn, a walk past the camera), or without a camera: "mixed".
    """
    sides = camera_side(pelvis_m, forward, camera_m)
    most = mostly(sides[sides != ""])
    if most in (FRONT, BACK, ""):
        return dict.fromkeys(("right", "left"), most or MIXED)
    return {side: IPSILATERAL if side == most else CONTRALATERAL for side in ("right", "left")}
