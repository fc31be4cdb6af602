"""The unscaled body as it stands at joint values of 0, its bodies and markers in some poses, by C MuJoCo."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool

from pbl_pipeline.body import Body, MarkerSet, body_frames

#: Bodies whose markers turn with the trunk; limbs would pull the heading towards where they swing.
TRUNK = ("pelvis", "torso", "head", "humerus_r", "humerus_l")
#: Number of marker sets for which these are kept.
SETS = 8


@functools.lru_cache(SETS)
def trunk_of(markers: MarkerSet) -> Bool[np.ndarray, " J"]:
    """Markers of the trunk; all of a set that has fewer than three there."""
    trunk = np.array([b in TRUNK for b in markers.body_names])
    return trunk if trunk.sum() >= 3 else np.ones_like(trunk)


@functools.lru_cache(SETS)
def standing_markers(body: Body, markers: MarkerSet) -> np.ndarray:
    """(J, 3) of the unscaled standing body with its pelvis at the origin and unturned."""
    return marker_places(*_standing(body), markers)[0]


@functools.cache
def _standing(body: Body) -> tuple[np.ndarray, np.ndarray]:
    return bodies_at(body, np.zeros((1, len(body.joint_names))))


def bodies_at(body: Body, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, B, 3) from the pelvis and rotations (K, B, 3, 3) of the unscaled body in K poses."""
    at = body_frames(body, qpos, np.ones(len(body.scale_names)))
    return at.position_m - at.position_m[:, :1], at.rotation


def marker_places(x: np.ndarray, R: np.ndarray, markers: MarkerSet, at: np.ndarray | slice = slice(None)) -> np.ndarray:
    """(K, m, 3) of the markers `at` on bodies that lie at x and are turned by R."""
    on = markers.body_index[at]
    return x[:, on] + np.einsum("kmij,mj->kmi", R[:, on], markers.position_m[at])
