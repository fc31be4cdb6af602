"""Angles from the rotations of bodies, the same way for every model, so that models can be compared."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Y_UP_TO_Z_UP


def body_rotation_angles(rotation: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """(T,) degrees of `JOINTS_CLIP` from body rotations whose axes are OpenSim's (forward, up, right).

    Hip: R_pelvis^-1 R_femur as body-fixed ZXY (flexion, adduction, rotation); knee: -(R_femur^-1 R_tibia) as ZXY [0];
    ankle: R_tibia^-1 R_talus as ZXY [0]. Left-side axes are mirrored. Every system goes through here, so that the axes
    that a model gives its ankle and knee count the same way.

    Parameters
    ----------
    rotation
        `pelvis`, `femur_r`, `femur_l`, `tibia_r`, ... `talus_l`, each T rotations, body to any one world.
    """
    out = {}
    for side, sign in (("r", 1.0), ("l", -1.0)):
        hip = _relative(rotation, "pelvis", f"femur_{side}")
        out[f"hip_flexion_{side}"] = hip[:, 0]
        out[f"hip_adduction_{side}"] = sign * hip[:, 1]
        out[f"hip_rotation_{side}"] = sign * hip[:, 2]
        out[f"knee_flexion_{side}"] = -_relative(rotation, f"femur_{side}", f"tibia_{side}")[:, 0]
        out[f"ankle_angle_{side}"] = _relative(rotation, f"tibia_{side}", f"talus_{side}")[:, 0]
    return out


def pelvis_rotations(tilt_deg: np.ndarray, list_deg: np.ndarray, rotation_deg: np.ndarray) -> np.ndarray:
    """(T, 3, 3) pelvis to a z-up world from the body's own pelvis angles (about z, x, y of a y-up ground, body-fixed).

    The columns are forward, up and right of the pelvis.
    """
    angles = np.radians(np.column_stack([tilt_deg, list_deg, rotation_deg]))
    return Y_UP_TO_Z_UP @ Rotation.from_euler("ZXY", angles).as_matrix()


def pelvis_angles_deg(R_world_pelvis: np.ndarray) -> np.ndarray:
    """(T, 3) tilt, list, rotation in degrees: the inverse of `pelvis_rotations`."""
    return Rotation.from_matrix(Y_UP_TO_Z_UP.T @ R_world_pelvis).as_euler("ZXY", degrees=True)


def _relative(rotation: Mapping[str, Rotation], parent: str, child: str) -> np.ndarray:
    return (rotation[parent].inv() * rotation[child]).as_euler("ZXY", degrees=True)
