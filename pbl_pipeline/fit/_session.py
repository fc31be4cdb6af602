"""`fit_session`: the one function that tables and commands call."""

from __future__ import annotations

import time
from collections.abc import Sequence

import jax
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.paramset import Paramset

from ._costs import distance_2d_px2, distance_3d_cm2
from ._params import DEFAULT, PARAMSETS, params_of
from ._problem import Session, make_session
from ._problem import check_trial as _check_trial
from ._quality import check_fit
from ._types import SessionFit, TrialFit
from .solvers import Solution, solve_implicit_adam

SOLVER = "implicit-adam"
#: Every solver there is.
SOLVERS = (SOLVER,)
#: `LEVEL_CAMERA_R_NC` as a quaternion (w, x, y, z).
LEVEL_CAMERA_QUAT_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])


def fit_session(
    trials: Sequence[Keypoints],
    names: Sequence[str],
    paramset: Paramset | None = None,
    camera_motion: str | Sequence[str] = "static",
) -> SessionFit:
    """Fit the body to all trials of one session; scale and marker offsets are shared.

    Parameters
    ----------
    trials, names
        Keypoints of each trial and a name for each.
    paramset
        One of `PARAMSETS` or one of the same form (default: `DEFAULT`).
    camera_motion
        "static" or "handheld", for all trials or each. Without phone orientation both are fitted with a level camera
        that does not turn: angles between segments do not depend on it, pelvis angles and positions in the world do,
        and a check says so.

    Raises
    ------
    PblError
        FIT_INPUT, MARKER_SET_UNKNOWN, FIT_DIVERGED.
    """
    begin = time.perf_counter()
    paramset = paramset or PARAMSETS[DEFAULT]
    params = params_of(paramset)
    motions = [camera_motion] * len(trials) if isinstance(camera_motion, str) else list(camera_motion)
    session = make_session(trials, names, params.view)
    solution = solve_implicit_adam(session, params)
    if not np.all(np.isfinite(solution.qpos)):
        raise PblError(
            "FIT_DIVERGED",
            found="joint angles that are not finite",
            expected="finite angles",
            next_step="check the keypoints and the camera matrix",
        )
    seconds = time.perf_counter() - begin
    fits = tuple(_trial_fit(session, i, solution, paramset, motions[i], seconds) for i in range(len(trials)))
    return SessionFit(
        trials=fits,
        scale=solution.scale,
        site_offset_m=solution.site_offset_m,
        loss_trace=solution.loss_trace,
        solver=SOLVER,
        params_hash=paramset.hash,
        seconds=seconds,
        compile_seconds=solution.compile_seconds,
        device=str(jax.devices()[0].device_kind),
        qc=check_fit(session, fits, solution.scale, solution.loss_trace),
    )


def check_trial(keypoints: Keypoints, name: str, paramset: Paramset | None = None) -> tuple[np.ndarray, float]:
    """Which frames (T,) bool of a trial the fit would use, and the share of frames with the whole person in view.

    Raises `PblError` FIT_INPUT or MARKER_SET_UNKNOWN where the trial cannot be fitted.
    """
    return _check_trial(keypoints, name, params_of(paramset or PARAMSETS[DEFAULT]).view)


def _trial_fit(
    session: Session, i: int, solution: Solution, paramset: Paramset, camera_motion: str, seconds: float
) -> TrialFit:
    keypoints, used, obs = session.trials[i], session.used[i], session.obs
    n = len(keypoints.time_s)
    qpos = solution.qpos[i]
    body, markers = session.model.body, session.model.markers
    x = session.model.positions(qpos, solution.scale, solution.site_offset_m)
    R_nc, matrix = obs.R_nc[i][None], obs.camera_matrix[i][None]
    weight_3d = np.asarray(markers.weight_3d, np.float32)
    residual_3d = 0.01 * np.sqrt(np.asarray(distance_3d_cm2(x, obs.x_cam[i], R_nc, obs.c[i], weight_3d)))[:n]
    residual_2d = np.sqrt(np.asarray(distance_2d_px2(x, obs.xy_px[i], R_nc, matrix)))[:n]
    seen = np.asarray(obs.c[i])[:n] > 0
    hide = ~used[:, None]
    return TrialFit(
        name=session.names[i],
        time_s=keypoints.time_s,
        joint_names=tuple(body.joint_names),
        qpos=np.where(hide, np.nan, qpos[:n]),
        qpos_sd=np.full((n, qpos.shape[1]), np.nan),
        marker_set=markers.name,
        marker_names=tuple(markers.names),
        markers_world_m=np.where(hide[..., None], np.nan, np.asarray(x)[:n]),
        phone_quat_wxyz=np.tile(LEVEL_CAMERA_QUAT_WXYZ, (n, 1)),
        scale=solution.scale,
        site_offset_m=solution.site_offset_m,
        residual_2d_px=np.where(seen, residual_2d, np.nan),
        residual_3d_m=np.where(seen, residual_3d, np.nan),
        camera=keypoints.camera,
        image_size_px=keypoints.image_size_px,
        camera_motion=camera_motion,
        solver=SOLVER,
        params_hash=paramset.hash,
        body_sha256=body.sha256,
        loss=float(solution.loss_trace[-1, 1]),
        seconds=seconds,
    )
