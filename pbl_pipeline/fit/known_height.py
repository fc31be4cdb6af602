"""Conversion of the metres of the fit to the person's: by depths, the measured height, or the detector's guess of size.

One camera sees no lengths: a person half as large at half the distance has the same pixels, and the size of the
detector's 3D points is a guess (those of `blazepose-heavy` were 6 % too small on six recordings,
`research.detector_errors`). A measured height determines it. The whole scene is enlarged about the camera, so that
pixels and joint angles do not change, and every length (strides, speed, the distance from the camera) follows.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.body import SLIDES, stature_m
from pbl_pipeline.keypoints import Keypoints

from .initial_pose import pelvis_rest
from .session import Session
from .solution import Solution


def in_metres(session: Session, solution: Solution, height_m: float | None) -> tuple[Solution, float | None]:
    """The solution in metres of a body of the person's height, or in the detector's if that is not known; and the ratio
    of that height to the fitted one (None: unknown).

    Lengths that several cameras, a depth camera or laboratory markers measured do not change.
    """
    depths = next(filter(None, solution.depths), None)
    factor = 1.0 / (session.metre if depths is None else depths.metre)
    taller = None if height_m is None else height_m / (factor * stature_m(session.body, solution.scale))
    guessed = depths is None and all(isinstance(t, Keypoints) for t in session.trials)
    if taller is not None and guessed:
        factor *= taller
    return solution if factor == 1.0 else _enlarged(session, solution, factor), taller


def _enlarged(session: Session, solution: Solution, factor: float) -> Solution:
    """The whole scene larger by a factor, about the camera."""
    qpos, camera = solution.qpos.copy(), session.problem.p_nc[:, 0]
    sd = None if solution.qpos_sd is None else solution.qpos_sd.copy()
    slides = [session.body.joint_names.index(name) for name in SLIDES]
    stands, rest = pelvis_rest(session.body)
    qpos[:, slides] += (factor - 1.0) * (qpos[:, slides] @ stands.T + rest - camera) @ stands
    if sd is not None:
        sd[:, slides] *= factor
    s = factor * solution.s
    s[0] += factor - 1.0  # a multiplier is 1 plus these
    outcome = solution.outcome
    shown: Any = factor * outcome.x_world_m - (factor - 1.0) * camera[:, None], factor * outcome.residual_3d_m
    return dataclasses.replace(
        solution,
        qpos=qpos,
        qpos_sd=sd,
        s=s,
        scale=factor * solution.scale,
        outcome=dataclasses.replace(outcome, x_world_m=shown[0], residual_3d_m=shown[1]),
        metre=factor,
    )
