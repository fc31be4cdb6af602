"""Where `implicit-adam` starts: one pose and one camera orientation per trial, the biases of its network."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import SLIDES, Body

from ._inputs import Session
from ._place import placed_poses


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


def paper_start(session: Session, trial: int, distance_m: float, middle: Float[np.ndarray, " 40"]) -> np.ndarray:
    """qpos (40,) with every angle at the middle of its range and the pelvis straight ahead of the trial's camera.

    Ahead of its median orientation where it turns. Trials of several cameras or of markers in the world, for which the
    paper has no start, take `keypoint_start`.
    """
    arrays = session.arrays[trial]
    if arrays.c_3d.shape[1] != 1:
        return keypoint_start(session, trial)
    ahead = Rotation.from_rotvec(camera_start(session, trial)).as_matrix()[:, 2]
    qpos = start_pose(session.body, arrays.p_nc[0, 0] + distance_m * ahead, 0.0)
    return np.where(_is_slide(session.body), qpos, middle)


def keypoint_start(session: Session, trial: int) -> np.ndarray:
    """qpos (40,) of the standing body at the medians over the trial of pelvis position and heading."""
    body, used = session.body, session.arrays[trial].used
    poses = placed_poses(session, trial)[used]
    angle = poses[:, body.joint_names.index("pelvis_rotation")]
    mean = np.angle(np.mean(np.exp(1j * angle)))  # circular, so that +179 and -179 deg agree
    heading = mean + np.median(np.angle(np.exp(1j * (angle - mean))))
    qpos = np.where(_is_slide(body), np.median(poses, axis=0), 0.0)
    qpos[body.joint_names.index("pelvis_rotation")] = np.angle(np.exp(1j * heading))
    return qpos


def camera_start(session: Session, trial: int) -> np.ndarray:
    """Rotation vector (3,) in rad of the median orientation R_nc of a trial's camera over the frames that count.

    The median of each component of the turns away from the mean orientation. Zero where there is no camera.
    """
    arrays = session.arrays[trial]
    if arrays.R_nc.shape[1] == 0:
        return np.zeros(3)
    R = Rotation.from_matrix(arrays.R_nc[arrays.used, 0])
    mean = R.mean()
    return (Rotation.from_rotvec(np.median((R * mean.inv()).as_rotvec(), axis=0)) * mean).as_rotvec()


def _is_slide(body: Body) -> np.ndarray:
    return np.array([n in SLIDES for n in body.joint_names])
