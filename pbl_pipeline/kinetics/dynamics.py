"""Motion with its derivatives, and the force that it needs: Newton and Euler over all bodies, by C MuJoCo."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, make_interp_spline

from pbl_pipeline.body import PELVIS_TURNS, SLIDES, Body, scaled_model
from pbl_pipeline.gait.events.signal import uniform_segments

from .inertia import segment_inertia

#: Standard gravity (m/s^2); a force of 1 body weight is this per kilogram.
GRAVITY = 9.80665
#: Rate of the uniform grid of all curves in time.
GRID_HZ = 100.0
#: Longer gaps between frames split the motion; shorter stretches cannot be differentiated.
MAX_GAP_S, MIN_SEGMENT_S = 0.15, 1.0


@dataclasses.dataclass(frozen=True)
class Motion:
    """Joint values and their derivatives on a uniform grid: time_s (N,); qpos, qvel, qacc (N, Q) in rad, m, s."""

    time_s: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """Forces of a motion, per kilogram of the person, at N times; world frame, z up."""

    force_n: np.ndarray  # (N, 3) external force without gravity, N/kg
    moment_nm: np.ndarray  # (N, 3) its moment about the world's origin, Nm/kg
    centre_m: np.ndarray  # (N, 3) centre of mass
    generalised: np.ndarray  # (N, Q) generalised forces if that force acted on the pelvis, Nm/kg and N/kg
    axis: np.ndarray  # (N, Q, 3) of each joint
    anchor_m: np.ndarray  # (N, Q, 3) of each joint
    xpos: np.ndarray  # (N, B, 3)
    xmat: np.ndarray  # (N, B, 3, 3)


def smooth_motion(time_s: np.ndarray, qpos: Float[np.ndarray, "T Q"], cutoff_hz: float) -> list[Motion]:
    """Return the motion with its derivatives, one for each stretch without long gaps; none if all are too short.

    Joint values are put on a grid of `GRID_HZ` and low-passed there and back (`uniform_segments`, order 4, -3 dB at
    `cutoff_hz`); the derivatives are those of the quintic spline through the result. `time_s` (T,); rows of `qpos` that
    are not finite are gaps.
    """
    segments = uniform_segments(
        np.asarray(time_s, float),
        np.asarray(qpos, float),
        grid_hz=GRID_HZ,
        cutoff_hz=cutoff_hz,
        filter_order=4,
        max_gap_s=MAX_GAP_S,
        min_segment_s=MIN_SEGMENT_S,
        interpolator=CubicSpline,  # a monotone one has kinks where it is flat
    )
    motions = []
    for s in segments:
        spline = make_interp_spline(s.time_s, s.values, k=5)
        motions.append(Motion(s.time_s, s.values, spline.derivative(1)(s.time_s), spline.derivative(2)(s.time_s)))
    return motions


def inverse_dynamics(body: Body, scale: Float[np.ndarray, " S"], motion: Motion) -> Dynamics:
    """Return the force that a motion needs, without contacts and joint limits: `mj_inverse` in each frame, by the parts
    of it that a body without damping, springs and armature needs."""
    model = _dynamic_model(body, tuple(np.asarray(scale, np.float64).tolist()))
    data = mujoco.MjData(model)
    n, q, b = len(motion.time_s), model.nv, model.nbody - 1
    generalised, axis, anchor = np.empty((n, q)), np.empty((n, q, 3)), np.empty((n, q, 3))
    centre = np.empty((n, 3))
    xpos, xmat = np.empty((n, b, 3)), np.empty((n, b, 3, 3))
    given = [(data.qpos, motion.qpos), (data.qvel, motion.qvel), (data.qacc, motion.qacc)]
    # Each access to a field of `data` makes a new array.
    found = [
        *((axis, data.xaxis), (anchor, data.xanchor), (centre, data.subtree_com[0])),
        *((xpos, data.xpos[1:]), (xmat, data.xmat[1:].reshape(-1, 3, 3))),
    ]
    for i in range(n):
        for field, values in given:
            field[:] = values[i]
        for part in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            part(model, data)
        mujoco.mj_rne(model, data, 1, generalised[i])
        for values, field in found:
            values[i] = field
    slides = [body.joint_names.index(name) for name in SLIDES]
    turns = [body.joint_names.index(name) for name in PELVIS_TURNS]
    # The generalised forces are projections: of the force on each slide, of the moment about the pelvis on each turn.
    force = np.linalg.solve(axis[:, slides], generalised[:, slides, None])[..., 0]
    about = np.linalg.solve(axis[:, turns], generalised[:, turns, None])[..., 0]
    moment = about + np.cross(xpos[:, 0], force)
    return Dynamics(force, moment, centre, generalised, axis, anchor, xpos, xmat)


@functools.lru_cache(maxsize=8)
def _dynamic_model(body: Body, scale: tuple[float, ...]) -> mujoco.MjModel:
    """Return the scaled body with its inertia, free of contacts and joint limits."""
    model, inertia = scaled_model(body, np.array(scale)), segment_inertia(body, np.array(scale))
    model.body_mass[1:] = inertia.mass
    model.body_ipos[1:] = inertia.centre_m
    model.body_inertia[1:] = inertia.moment_m2
    model.body_iquat[1:] = (1.0, 0.0, 0.0, 0.0)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
