"""Joints of the legs that a marker set does not determine: those whose markers hardly move with them.

A marker's position on a person is known to about a centimetre, and the fit moves it there. Where the markers beyond a
joint lie a few centimetres from its axis, as a single point on the ankle does, that centimetre is an angle.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers

from .session import Session, has_3d
from .solution import Solution
from .standing import bodies_at, marker_places

#: Standard deviation (m) of a marker's position on the body; from this angle (rad) on a joint is not determined, and no
#: angle is less certain than the last (rad).
PLACED_M, OPEN_RAD, LEAST_CERTAIN_RAD = 0.01, np.deg2rad(20.0), np.deg2rad(90.0)
#: Others, such as the wrists of sets without hands, keep the standard deviation of the prior that holds them.
_LEGS = ("hip_", "knee_", "ankle_", "subtalar_", "mtp_")
_FRAMES, _STEP_RAD = 20, 1e-3


def with_open_joints(session: Session, solution: Solution) -> Solution:
    """Return the solution with standard deviations that say which joints markers, several cameras, and pixels alone
    leave open."""
    if solution.qpos_sd is None or any(isinstance(t, Keypoints) and has_3d(t) for t in session.trials):
        return solution
    used = np.flatnonzero(np.concatenate([a.used for a in session.arrays]))
    some = used[np.linspace(0, len(used) - 1, min(_FRAMES, len(used))).astype(int)]
    lever = lever_arms_m(session, np.asarray(solution.qpos)[some])
    sd = np.minimum(PLACED_M / np.maximum(lever, 1e-9), LEAST_CERTAIN_RAD)
    leg = np.array([n.startswith(_LEGS) for n in session.body.joint_names])
    left_open = np.where(leg & (sd >= OPEN_RAD), sd, 0.0)
    return dataclasses.replace(solution, qpos_sd=np.maximum(solution.qpos_sd, left_open))


def lever_arms_m(session: Session, qpos: Float[np.ndarray, "K Q"]) -> Float[np.ndarray, " Q"]:
    """Movement (m) of all markers that were seen, by one radian of each joint: root of the mean over the postures of
    the sum of squares."""
    body, seen = session.body, np.any([_seen(t) for t in session.trials], axis=0)
    if isinstance(session.trials[0], WorldMarkers):
        seen &= session.markers.weight_3d > 0
    at = np.flatnonzero(seen)
    k, q = qpos.shape
    moved = np.tile(qpos, (q + 1, 1)).reshape(q + 1, k, q)
    moved[np.arange(q), :, np.arange(q)] += _STEP_RAD
    places = marker_places(*bodies_at(body, moved.reshape(-1, q)), session.markers, at).reshape(q + 1, k, len(at), 3)
    return np.sqrt(np.mean(np.sum((places[:-1] - places[-1]) ** 2, axis=(2, 3)), axis=1)) / _STEP_RAD


def _seen(trial: MultiView | WorldMarkers | Keypoints) -> np.ndarray:
    views = trial.views if isinstance(trial, MultiView) else (trial,)
    return np.any([np.any(v.confidence > 0, axis=0) for v in views], axis=0)
