"""The vertical of a camera that does not turn and whose tilt was not measured.

The pelvis of a person who walks on a level floor keeps its height, and its bobbing averages out: over a path of some
metres this determines the tilt along the path. Across it, a person's head is above the feet on average. Both make one
least-squares problem: the vertical is the direction along which the path varies least and the body points.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body

from .initial_pose import pelvis_path, pelvis_values
from .session import GAIT, LEVEL, Session
from .solution import Solution

#: Least length (m) of a path that is used: from the farthest point to the start of the frames that count.
MIN_PATH_M = 2.0
#: Standard deviation of the pelvis' height in walking (m), and of a body's mean lean (rad): to a side of its path, and
#: along it, where people stoop. The project's own.
BOB_SD_M, LEAN_SD_RAD, STOOP_SD_RAD = 0.03, np.deg2rad(3.0), np.deg2rad(10.0)
#: A frame in which both knees are bent by this much more than usual (rad) is not one of a walk.
SITTING_RAD = np.deg2rad(30.0)
#: Beyond this tilt (rad) the estimate is rejected, and the camera counts as level.
MOST_TILT_RAD = np.deg2rad(30.0)


def upright(session: Session, solution: Solution) -> tuple[Solution, tuple[str, ...]]:
    """The solution in a world whose z is up, and the source of each trial's vertical."""
    sources, seen = list(session.orientation), solution.outcome
    qpos, R_nc, points = solution.qpos.copy(), solution.R_nc.copy(), np.array(seen.x_world_m)
    for i, source in enumerate(sources):
        if source != LEVEL:
            continue
        frames = session.frames(i)
        used = session.arrays[i].used & on_their_feet(session.body, qpos[frames], session.arrays[i].used)
        x, R = pelvis_path(session.body, qpos[frames])
        axis = np.asarray(seen.body_axis_m)[frames][used].mean(axis=0)
        up = vertical(x[used], axis / np.linalg.norm(axis))
        if up is None:
            continue
        turn = _turn_to_z(up)
        values = pelvis_values(session.body, turn @ R, x @ turn.T)
        for name, value in values.items():
            qpos[frames, session.body.joint_names.index(name)] = value
        R_nc[frames] = turn @ R_nc[frames]
        points[frames] = (points[frames].reshape(-1, 3) @ turn.T.astype(points.dtype)).reshape(points[frames].shape)
        sources[i] = GAIT
    shown: Any = points
    solution = dataclasses.replace(solution, qpos=qpos, R_nc=R_nc, outcome=dataclasses.replace(seen, x_world_m=shown))
    return solution, tuple(sources)


def on_their_feet(body: Body, qpos: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(T,) bool: frames (T, 40) except those in which both knees are much more bent than usual: a person who sits down
    is lower, but not on a slope."""
    knees = -qpos[:, [body.joint_names.index(n) for n in ("knee_angle_r", "knee_angle_l")]].max(axis=1)
    return knees < np.median(knees[used]) + SITTING_RAD


def vertical(x: np.ndarray, axis: np.ndarray) -> np.ndarray | None:
    """Unit vector up (3,) from the pelvis' path (T, 3) and the body's axis (3,); None if the path is too short or the
    tilt too large."""
    if np.max(np.linalg.norm(x - x[0], axis=1), initial=0.0) < MIN_PATH_M:
        return None
    off = x - x.mean(axis=0)
    spread = off.T @ off / len(x)
    # A stoop must not count as a tilted camera: across the path the body defines the vertical, along it the path does.
    across = np.cross(np.linalg.eigh(spread)[1][:, -1], axis)
    across /= np.linalg.norm(across)
    along = np.cross(axis, across)
    lean = np.outer(across, across) / LEAN_SD_RAD**2 + np.outer(along, along) / STOOP_SD_RAD**2
    _, axes = np.linalg.eigh(spread / BOB_SD_M**2 + lean)
    up = axes[:, 0] * np.sign(axes[:, 0] @ axis)
    return None if np.arccos(np.clip(up[2], -1, 1)) > MOST_TILT_RAD else up


def _turn_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that takes a unit vector to z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sin = np.linalg.norm(axis)
    if sin < 1e-9:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sin * np.arctan2(sin, up[2])).as_matrix()
