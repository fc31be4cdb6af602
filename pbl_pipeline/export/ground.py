"""Where the floor is: heights of OpenSim's formats and C3D count from it."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage

from pbl_pipeline.fit.problem import SOLES
from pbl_pipeline.gait.ground import is_metric

from .trial import ExportTrial

#: Where a floor was found, the lowest sole stays this close (m) to it in `_OF_FRAMES` of the frames.
FLOOR_WITHIN_M = 0.03
_OF_FRAMES = 0.8
#: The floor is followed over about two strides (s).
_WINDOW_S = 2.0
#: It rises by at most this part of the path, and some error (m): more is a stair or a ramp, no error of the vertical.
_STEEPEST, _ERROR_M = 0.1, 0.05
#: The slide of the pelvis along the vertical.
_VERTICAL = "pelvis_ty"


def floor_under_person_m(trial: ExportTrial) -> np.ndarray | None:
    """Return (T,) heights (m) of the floor under the person in the fit's world, NaN without a pose; None: none found.

    One foot at least is on the floor in every frame of a walk, so that the lowest point of both soles follows it: the
    floor is its running median. A level floor may rise or sink in the world of one camera: a vertical that is off by
    1 deg makes 10 cm over 6 m, and the distance from the camera has errors. None was found where the lowest point does
    not stay within `FLOOR_WITHIN_M` (a jump, a poor fit) and where the floor is too steep (stairs).
    """
    poses, known = trial.poses, trial.known
    soles = []
    for name, place in SOLES:
        at, local = poses.index(name), poses.scale_of(name, trial.fit.scale) * np.asarray(place)
        soles.append(poses.position_m[known, at] + poses.rotation[known, at] @ local)
    lowest = np.stack(soles)[..., 2].min(axis=0)
    times = np.asarray(trial.fit.time_s, float)[known]
    size = 1 + 2 * round(0.5 * _WINDOW_S / np.median(np.diff(times))) if len(times) > 1 else 1
    followed = ndimage.uniform_filter1d(ndimage.median_filter(lowest, size, mode="nearest"), size, mode="nearest")
    pelvis = poses.position_m[known, poses.index("pelvis"), :2]
    path = float(np.linalg.norm(np.ptp(pelvis, axis=0)))
    close = np.mean(np.abs(lowest - followed) <= FLOOR_WITHIN_M) >= _OF_FRAMES
    if not close or np.ptp(followed) > _STEEPEST * path + _ERROR_M:
        return None
    floor = np.full(len(known), np.nan)
    floor[known] = followed
    return floor


def on_floor(trial: ExportTrial) -> tuple[ExportTrial, str]:
    """Return the trial with its heights counted from the floor under the person, and what 0 is, for headers.

    Angles stay: a frame is moved as a whole. Heights of a laboratory's or of calibrated cameras' world stay as they
    are, because force plates and other markers share it.
    """
    if is_metric(trial.fit):
        return trial, "height 0 is that of the laboratory's or the calibrated cameras' world"
    floor = floor_under_person_m(trial)
    if floor is None:
        return trial, "height 0 is that of the camera at the start: no floor was found"
    fit = trial.fit
    qpos, markers = np.array(fit.qpos, float), np.array(fit.markers_world_m, float)
    qpos[:, fit.joint_names.index(_VERTICAL)] -= floor
    markers[..., 2] -= floor[:, None]
    lowered = dataclasses.replace(fit, qpos=qpos, markers_world_m=markers)
    return dataclasses.replace(trial, fit=lowered), "height 0 is the floor under the person, from the lowest sole"


def taken_off(trial: ExportTrial, standing: ExportTrial) -> np.ndarray:
    """Return (T,) what `on_floor` took off the heights of the frames (m), NaN without a pose."""
    column = trial.fit.joint_names.index(_VERTICAL)
    return np.asarray(trial.fit.qpos, float)[:, column] - np.asarray(standing.fit.qpos, float)[:, column]
