"""Known joint values in the form of a fit, so that gait measures of the truth are computed as those of a fit are."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.body import SCALE_NAMES, load_body
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.video import Camera

#: Nothing of the truth comes through a lens.
_NO_CAMERA = Camera(np.eye(3), np.zeros(5), "none: known joint values")


def fit_of_qpos(name: str, time_s: np.ndarray, qpos: np.ndarray, scale: np.ndarray | None = None) -> TrialFit:
    """A fit of `qpos` (T, 40) in m and rad at `time_s` (T,) that is exact: without residuals, markers or spread.

    `scale` (8,): of the person, as `TrialFit.scale`; None for the body's own size.
    """
    body = load_body()
    n = len(time_s)
    none = np.full((n, 0), np.nan)
    return TrialFit(
        name=name,
        time_s=np.asarray(time_s, float),
        joint_names=body.joint_names,
        qpos=np.asarray(qpos, float),
        qpos_sd=np.zeros(np.shape(qpos)),
        marker_set="blazepose_33",
        marker_names=(),
        markers_world_m=np.full((n, 0, 3), np.nan),
        phone_quat_wxyz=np.tile([0.5, -0.5, 0.5, -0.5], (n, 1)),
        scale=np.ones(len(SCALE_NAMES)) if scale is None else np.asarray(scale, float),
        site_offset_m=np.zeros((0, 3)),
        residual_2d_px=none,
        residual_3d_m=none,
        camera=_NO_CAMERA,
        image_size_px=(1, 1),
        camera_motion="static",
        camera_position_m=np.zeros(3),
        orientation_source="known",
        phone_clock_offset_s=float("nan"),
        solver="truth",
        params_hash="",
        body_sha256=body.sha256,
        loss=0.0,
        seconds=0.0,
    )
