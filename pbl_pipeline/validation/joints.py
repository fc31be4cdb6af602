"""Which joints a measure speaks of, and what people call them."""

from __future__ import annotations

from collections.abc import Mapping

from pbl_pipeline.body import PELVIS_TURNS

_SIDES = ("r", "l")
_HIPS = tuple(f"hip_{n}_{s}" for n in ("flexion", "adduction", "rotation") for s in _SIDES)
_KNEES = tuple(f"knee_flexion_{s}" for s in _SIDES)
_ANKLES = tuple(f"ankle_angle_{s}" for s in _SIDES)
_LUMBAR = tuple(f"lumbar_{n}" for n in ("extension", "bending", "rotation"))

#: The joints of the paper's median absolute error (Supplementary Methods, Validation Metrics).
JOINTS_PAPER: tuple[str, ...] = (
    *_HIPS,
    *_KNEES,
    *_ANKLES,
    *_LUMBAR,
    *(f"neck_{n}" for n in ("extension", "bending", "rotation")),
    *(f"arm_{n}_{s}" for n in ("flex", "add") for s in _SIDES),
    *(f"elbow_flex_{s}" for s in _SIDES),
)
#: The joints of OpenCap's mean absolute error (Uhlrich et al. 2023, as the paper lists them).
JOINTS_OPENCAP: tuple[str, ...] = (
    *PELVIS_TURNS,
    *_HIPS,
    *_KNEES,
    *_ANKLES,
    *(f"subtalar_angle_{s}" for s in _SIDES),
    *_LUMBAR,
)
#: The angles that body rotations of any model give alike (convention "body_rotations").
JOINTS_CLIP: tuple[str, ...] = (*_HIPS, *_KNEES, *_ANKLES)

#: Row of the paper's tables -> the joint without its side.
ROWS_PAPER: Mapping[str, str] = {
    "Hip Flexion": "hip_flexion",
    "Hip Adduction": "hip_adduction",
    "Hip Rotation": "hip_rotation",
    "Knee Flexion": "knee_flexion",
    "Ankle Angle": "ankle_angle",
    "Lumbar Extension": "lumbar_extension",
    "Lumbar Bending": "lumbar_bending",
    "Lumbar Rotation": "lumbar_rotation",
    "Neck Extension": "neck_extension",
    "Neck Bending": "neck_bending",
    "Neck Rotation": "neck_rotation",
    "Arm Flex": "arm_flex",
    "Arm Add": "arm_add",
    "Elbow Flex": "elbow_flex",
}


def split_side(joint: str) -> tuple[str, str]:
    """`hip_flexion_r` -> (`hip_flexion`, `r`); a joint of the middle has the side ``""``."""
    if joint.endswith(("_r", "_l")):
        return joint[:-2], joint[-1]
    return joint, ""
