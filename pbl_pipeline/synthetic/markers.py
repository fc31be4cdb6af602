"""A person's size and where the markers sit on that person; the body's markers by C MuJoCo."""

from __future__ import annotations

import copy

# MuJoCo is a compiled module without type stubs.
import mujoco  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SCALE_NAMES, MarkerSet, load_body, marker_set

from .curves import within

SCALE_SD, SITE_SD_M = 0.05, 0.006


def person(
    seed: int = 0, markers: str | MarkerSet = "bml_movi_87"
) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "J 3"]]:
    """Scale (8,) and marker offsets (J, 3) in m of a person.

    The eight parameters `s` of the body's size are normal with standard deviation 5 % (cut off at two of them), and
    `scale = 1 + s_overall (+ s_group)` as in `pbl_pipeline.fit`. Each offset is normal with 6 mm per axis, in the frame
    of the marker's body.
    """
    rng = np.random.default_rng([seed, 3])
    s = np.array([within(rng, 0.0, SCALE_SD) for _ in SCALE_NAMES])
    scale = 1 + s[0] + np.concatenate([[0.0], s[1:]])
    return scale, rng.normal(0, SITE_SD_M, (len(_set(markers)), 3))


def true_markers(
    qpos: Float[np.ndarray, "T 40"],
    markers: str | MarkerSet,
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
) -> Float[np.ndarray, "T J 3"]:
    """Markers in the world (m), in double precision by C MuJoCo: not the kinematics that the fit uses."""
    body, markers = load_body(), _set(markers)
    scale = np.ones(len(SCALE_NAMES)) if scale is None else np.asarray(scale, np.float64)
    offset = 0.0 if site_offset_m is None else np.asarray(site_offset_m, np.float64)
    model = copy.copy(body.mj_model)
    parent = body.parent_index
    model.body_pos[1:] *= np.where(parent >= 0, scale[body.scale_index[parent]], 1.0)[:, None]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    xpos, xmat = np.empty((len(qpos), len(body.body_names), 3)), np.empty((len(qpos), len(body.body_names), 9))
    for t, q in enumerate(np.asarray(qpos, np.float64)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        xpos[t], xmat[t] = data.xpos[1:], data.xmat[1:]
    at = markers.body_index
    local = scale[body.scale_index[at]][:, None] * (markers.position_m + offset)
    return xpos[:, at] + np.einsum("tjab,jb->tja", xmat.reshape(*xmat.shape[:2], 3, 3)[:, at], local)


def _set(markers: str | MarkerSet) -> MarkerSet:
    return marker_set(markers) if isinstance(markers, str) else markers
