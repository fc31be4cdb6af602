"""The unscaled body as it stands at joint values of 0, its bodies and markers in some poses, by C MuJoCo."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools

import mujoco
import numpy as np
from jaxtyping import Bool

from pbl_pipeline.body import Body, MarkerSet

#: Bodies whose markers turn with the trunk; limbs would pull the heading towards where they swing.
TRUNK = ("pelvis", "torso", "head", "humerus_r", "humerus_l")


def trunk_of(markers: MarkerSet) -> Bool[np.ndarray, " J"]:
    """Markers of the trunk; all of a set that has fewer than three there."""
    trunk = np.array([b in TRUNK for b in markers.body_names])
    return trunk if trunk.sum() >= 3 else np.ones_like(trunk)


def standing_markers(body: Body, markers: MarkerSet) -> np.ndarray:
    """(J, 3) of the unscaled standing body with its pelvis at the origin and unturned."""
    return marker_places(*_standing(body), markers)[0]


@functools.cache
def _standing(body: Body) -> tuple[np.ndarray, np.ndarray]:
    return bodies_at(body, np.zeros((1, len(body.joint_names))))


def bodies_at(body: Body, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, B, 3) from the pelvis and rotations (K, B, 3, 3) of the unscaled body in K poses, by C MuJoCo."""
    data, x, R = mujoco.MjData(body.mj_model), [], []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(body.mj_model, data)
        x.append(data.xpos[1:] - data.xpos[1])
        R.append(data.xmat[1:].reshape(-1, 3, 3).copy())
    return np.array(x), np.array(R)


def marker_places(x: np.ndarray, R: np.ndarray, markers: MarkerSet, at: np.ndarray | slice = slice(None)) -> np.ndarray:
    """(K, m, 3) of the markers `at` on bodies that lie at x and are turned by R."""
    on = markers.body_index[at]
    return x[:, on] + np.einsum("kmij,mj->kmi", R[:, on], markers.position_m[at])
