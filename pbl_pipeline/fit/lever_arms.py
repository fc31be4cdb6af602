"""Standard deviations of joints from where markers sit on a person, and joints that a marker set does not determine.

A marker's position on a person is known to about a centimetre, in every frame alike, so no residual shows it. Where
only the prior of other joints holds a joint, as the tilt of a pelvis seen as two hip centres, the error is that of the
prior; where the markers beyond a joint lie a few centimetres from its axis, as a single point on the ankle does, the
centimetre alone is an angle, and the joint is not determined.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, marker_jacobian, scale_multipliers
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers

from .joint_terms import pose_z, posture
from .params import Params
from .problem import PointTable
from .session import Session, has_3d
from .solution import Solution
from .weights import Weights

#: Standard deviation (m) of a marker's position on the body; from this angle (rad) on a joint is not determined, and no
#: angle is less certain than the last (rad).
PLACED_M, OPEN_RAD, LEAST_CERTAIN_RAD = 0.01, np.deg2rad(20.0), np.deg2rad(90.0)
_FRAMES = 20


def with_marker_places(session: Session, solution: Solution, params: Params) -> Solution:
    """Return the solution with standard deviations that contain the places of markers in the world on the body, and
    that say which joints these, several cameras, or pixels alone leave open."""
    if solution.qpos_sd is None or any(isinstance(t, Keypoints) and has_3d(t) for t in session.trials):
        return solution
    used = np.flatnonzero(np.concatenate([a.used for a in session.arrays]))
    some = used[np.linspace(0, len(used) - 1, min(_FRAMES, len(used))).astype(int)]
    sd, alone = placement_sd(session, np.asarray(solution.qpos)[some], solution.scale, params)
    # A detector's own errors are in the paramset's least standard deviations.
    least = sd if isinstance(session.trials[0], WorldMarkers) else 0.0
    left_open = (alone >= OPEN_RAD) & ~session.body.is_slide
    return dataclasses.replace(solution, qpos_sd=np.maximum(solution.qpos_sd, np.where(left_open, alone, least)))


def placement_sd(
    session: Session, qpos: Float[np.ndarray, "K Q"], scale: Float[np.ndarray, " S"], params: Params
) -> tuple[Float[np.ndarray, " Q"], Float[np.ndarray, " Q"]]:
    """Standard deviations (rad, m) of joint values by markers that are off by `PLACED_M` in each axis, in the mean over
    the postures: with all joints and the body's proportions free and the paramset's priors of both, and of each joint
    alone with all others known."""
    by_q, by_s = _moves(session, qpos, scale)
    by_prior, w = _prior(session, qpos, params), Weights.of(session.body, params)
    q, s = by_q.shape[-1], by_s.shape[-1]
    J = np.concatenate([by_q, by_s], axis=-1) / PLACED_M
    points = np.swapaxes(J, 1, 2) @ J
    known = points + np.eye(q + s) / LEAST_CERTAIN_RAD**2
    known[:, :q, :q] += np.swapaxes(by_prior, 1, 2) @ by_prior
    known[:, q:, q:] += np.asarray(w.scale_precision)
    sd = np.sqrt(np.mean(np.diagonal(np.linalg.inv(known), axis1=1, axis2=2)[:, :q], axis=0))
    alone = np.mean(np.diagonal(points, axis1=1, axis2=2)[:, :q], axis=0)
    return sd, (alone + LEAST_CERTAIN_RAD**-2) ** -0.5


def _moves(
    session: Session, qpos: Float[np.ndarray, "K Q"], scale: Float[np.ndarray, " S"]
) -> tuple[Float[np.ndarray, "K P Q"], Float[np.ndarray, "K P S"]]:
    """Movements (m) of the markers that were seen by joint values and by the paper's scale parameters, x, y and z of
    each in turn."""
    seen = np.any([_seen(t) for t in session.trials], axis=0)
    if isinstance(session.trials[0], WorldMarkers):
        seen &= session.markers.weight_3d > 0
    places = session.problem.points, jnp.asarray(qpos, jnp.float32), jnp.asarray(scale, jnp.float32)
    found = _jacobian(session.body, *places)
    mixer = np.asarray(jax.jacfwd(scale_multipliers)(jnp.zeros(len(scale))))
    at = np.flatnonzero(seen)
    by_q, by_s = (np.asarray(a, np.float64)[:, at].reshape(len(qpos), 3 * len(at), -1) for a in found)
    return by_q, by_s @ mixer


@functools.partial(jax.jit, static_argnums=0)
def _jacobian(body: Body, points: PointTable, qpos: Array, scale: Array) -> tuple[Array, Array]:
    found = marker_jacobian(body, points, qpos, scale, jnp.zeros_like(points.position_m))
    return found.per_qpos, found.per_scale


def _prior(session: Session, qpos: Float[np.ndarray, "K Q"], params: Params) -> Float[np.ndarray, "K Q Q"]:
    """Changes, in standard deviations, of a posture's distance from the likeliest component of the pose prior by joint
    values."""
    w, x = Weights.of(session.body, params), jnp.asarray(qpos, jnp.float32)
    e2 = np.sum(np.asarray(pose_z(posture(x, w.pelvis), w.neutral, w.whitener)) ** 2, axis=-1)
    whitener = np.asarray(w.whitener)[np.argmax(np.asarray(w.pose_log_weight) - 0.5 * e2, axis=-1)]
    return whitener @ np.asarray(jax.vmap(jax.jacfwd(lambda q: posture(q, w.pelvis)))(x))


def _seen(trial: MultiView | WorldMarkers | Keypoints) -> np.ndarray:
    views = trial.views if isinstance(trial, MultiView) else (trial,)
    return np.any([np.any(v.confidence > 0, axis=0) for v in views], axis=0)
