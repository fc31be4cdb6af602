"""The body's markers in the world, by C MuJoCo."""

from __future__ import annotations

# MuJoCo is a compiled module without type stubs.
import mujoco  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SCALE_NAMES, MarkerSet, load_body, marker_set

from .physique import scaled_model


def true_markers(
    qpos: Float[np.ndarray, "T 40"],
    markers: str | MarkerSet,
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
) -> Float[np.ndarray, "T J 3"]:
    """Markers in the world (m), in double precision by C MuJoCo: not the kinematics that the fit uses."""
    body, markers = load_body(), as_marker_set(markers)
    scale = np.ones(len(SCALE_NAMES)) if scale is None else np.asarray(scale, np.float64)
    offset = 0.0 if site_offset_m is None else np.asarray(site_offset_m, np.float64)
    model = scaled_model(scale)
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    xpos, xmat = np.empty((len(qpos), len(body.body_names), 3)), np.empty((len(qpos), len(body.body_names), 9))
    for t, q in enumerate(np.asarray(qpos, np.float64)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        xpos[t], xmat[t] = data.xpos[1:], data.xmat[1:]
    at = markers.body_index
    local = scale[body.scale_index[at]][:, None] * (markers.position_m + offset)
    return xpos[:, at] + np.einsum("tjab,jb->tja", xmat.reshape(*xmat.shape[:2], 3, 3)[:, at], local)


def as_marker_set(markers: str | MarkerSet) -> MarkerSet:
    """Return the marker set of a name, or the one that is given."""
    return marker_set(markers) if isinstance(markers, str) else markers
