"""Where the fit starts: pelvis position and heading of each trial, from its keypoints."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body

from ._problem import LEVEL_CAMERA_R_NC, Session

#: Bodies whose markers turn with the trunk; limbs would pull the heading towards where they swing.
_TRUNK = ("pelvis", "torso", "head", "humerus_r", "humerus_l")


def root_positions(x_cam: np.ndarray, xy_px: np.ndarray, c: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Camera-frame position (T, 3) in m of the origin of root-relative points, from their pixels.

    Weighted least squares on ``fx (x + tx) = (u - cx) (z + tz)`` and the like for v, linear in the unknown
    (tx, ty, tz). NaN in frames with fewer than four points seen.
    """
    out = np.full((len(x_cam), 3), np.nan)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    for t in range(len(x_cam)):
        seen = c[t] > 0
        if seen.sum() < 4:
            continue
        x, u, w = x_cam[t, seen], xy_px[t, seen], np.sqrt(c[t, seen])
        du, dv = (u[:, 0] - cx) / fx, (u[:, 1] - cy) / fy
        one, zero = np.ones(len(x)), np.zeros(len(x))
        a = np.concatenate([np.stack([one, zero, -du], 1), np.stack([zero, one, -dv], 1)])
        b = np.concatenate([du * x[:, 2] - x[:, 0], dv * x[:, 2] - x[:, 1]])
        ww = np.concatenate([w, w])
        out[t] = np.linalg.lstsq(a * ww[:, None], b * ww, rcond=None)[0]
    return out


def headings(session: Session, trial: int) -> np.ndarray:
    """Heading (T,) in rad about world z (0 = walking away from the camera), from the trunk's markers.

    The turn about the vertical that best aligns the markers of the standing body with the detected ones.
    """
    model = session.model
    trunk = np.array([b in _TRUNK for b in model.markers.body_names])
    # As many frames as the trial has, though one would do: the same compiled program serves the residuals later.
    standing = np.zeros((session.obs.time_s.shape[1], len(model.body.joint_names)))
    template = np.asarray(model.positions(standing, np.ones(8), np.zeros((len(trunk), 3))))[0, trunk]
    x_world = np.asarray(session.obs.x_cam[trial])[:, trunk] @ LEVEL_CAMERA_R_NC.T
    c = np.asarray(session.obs.c[trial])[:, trunk]
    out = np.full(len(x_world), np.nan)
    for t in range(len(x_world)):
        w = c[t]
        if (w > 0).sum() < 3:
            continue
        a = template - np.average(template, axis=0, weights=w)
        b = x_world[t] - np.average(x_world[t], axis=0, weights=w)
        cos = np.sum(w * (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
        sin = np.sum(w * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
        out[t] = np.arctan2(sin, cos)
    return out


def start_pose(body: Body, position_world_m: np.ndarray, heading_rad: float) -> np.ndarray:
    """qpos (40,) of the standing body with its pelvis at a world position, turned to a heading."""
    model = body.mj_model
    qpos = np.zeros(model.nq)
    i = {n: k for k, n in enumerate(body.joint_names)}
    pelvis = model.body("pelvis")
    rotation = Rotation.from_quat(pelvis.quat, scalar_first=True).as_matrix()
    tx, ty, tz = rotation.T @ (np.asarray(position_world_m) - pelvis.pos)
    qpos[i["pelvis_tx"]], qpos[i["pelvis_ty"]], qpos[i["pelvis_tz"]] = tx, ty, tz
    qpos[i["pelvis_rotation"]] = heading_rad
    return qpos


def keypoint_start(session: Session, trial: int) -> np.ndarray:
    """qpos (40,) from the medians over the trial of pelvis position and heading."""
    obs = session.obs
    used = np.asarray(obs.frame_weight[trial]) > 0
    root_cam = root_positions(
        np.asarray(obs.x_cam[trial], np.float64)[used],
        np.asarray(obs.xy_px[trial], np.float64)[used],
        np.asarray(obs.c[trial], np.float64)[used],
        np.asarray(obs.camera_matrix[trial], np.float64),
    )
    position = LEVEL_CAMERA_R_NC @ np.nanmedian(root_cam, axis=0)
    angle = headings(session, trial)[used]
    angle = angle[np.isfinite(angle)]
    mean = np.angle(np.mean(np.exp(1j * angle)))  # circular, so that +179 and -179 deg agree
    heading = mean + np.median(np.angle(np.exp(1j * (angle - mean))))
    return start_pose(session.model.body, position, float(heading))


def paper_start(session: Session, distance_m: float, middle: np.ndarray) -> np.ndarray:
    """qpos (40,) with every angle at the middle of its range and the pelvis straight ahead of the camera."""
    qpos = start_pose(session.model.body, np.array([distance_m, 0.0, 0.0]), 0.0)
    translation = [n in ("pelvis_tx", "pelvis_ty", "pelvis_tz") for n in session.model.body.joint_names]
    return np.where(translation, qpos, middle)
