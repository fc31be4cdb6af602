"""Uncertainty of the pelvis' position and orientation from the error of a phone's orientation.

It turns the whole recording about the camera, which no residual shows, so the solver's curvature does not contain it.
"""

from __future__ import annotations

import numpy as np

from pbl_pipeline.body import SLIDES

from .initial_pose import pelvis_path, pelvis_rest
from .session import MEASURED, Session

#: Standard deviation (deg) of a phone's slow error about the vertical, which nothing corrects, and about the level
#: axes, which gravity corrects. Those of the synthetic phone (`synthetic.PhoneSensor`); magnets and cars increase it.
HEADING_SD_DEG, LEVEL_SD_DEG = 0.5, 0.1


def phone_variance(session: Session, qpos: np.ndarray) -> np.ndarray:
    """Variances (F, 40) to add to those of qpos (F, 40), in rad^2 and m^2; 0 in trials without a phone's log."""
    out = np.zeros_like(qpos)
    column = {n: k for k, n in enumerate(session.body.joint_names)}
    sd = np.deg2rad([LEVEL_SD_DEG, LEVEL_SD_DEG, HEADING_SD_DEG])
    stands, _ = pelvis_rest(session.body)
    for i, (source, arrays) in enumerate(zip(session.orientation, session.arrays, strict=True)):
        if source != MEASURED:
            continue
        at = session.frames(i)
        away = pelvis_path(session.body, qpos[at])[0] - arrays.p_nc[:, 0]
        # A small turn by d about the camera moves a point by d x away; `stands` has the slides' axes.
        moved = np.stack([np.cross(axis, away) @ stands for axis in np.eye(3)], axis=-1)
        for name, variance in zip(SLIDES, np.sum((moved * sd) ** 2, axis=-1).T, strict=True):
            out[at, column[name]] = variance
        out[at, column["pelvis_tilt"]] = out[at, column["pelvis_list"]] = sd[0] ** 2
        out[at, column["pelvis_rotation"]] = sd[2] ** 2
    return out
