"""Joints: limits, smoothness, the pose prior, and the pelvis of the marker augmenter."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .linearised import linearised
from .term import At, Term, Unknowns


def beyond_limit_deg(
    qpos: Float[Array, "*n Q"], low: Float[Array, " Q"], high: Float[Array, " Q"]
) -> Float[Array, "*n Q"]:
    """Angle of a joint beyond its limit (deg, negative below the lower one), 0 inside."""
    return jnp.rad2deg(jnp.maximum(qpos - high, 0.0) + jnp.minimum(qpos - low, 0.0))


def bent(in_three_frames: Float[Array, "F Q 3"], bend: Float[Array, "F 3"]) -> Float[Array, "F Q"]:
    """Second difference of each joint over frames, with the weights `bend` of the frames before, at and after."""
    return sum(bend[:, k, None] * in_three_frames[..., k] for k in range(3))  # type: ignore[return-value]


def three_frames(qpos: Float[Array, "F Q"]) -> Float[Array, "F Q 3"]:
    """Each joint in the frame before, at and after, 0 beyond the ends."""
    return jnp.stack([shift(qpos, 1), qpos, shift(qpos, -1)], axis=-1)


def shift(a: Array, by: int) -> Array:
    """Row i is row i - `by` of a, zeros beyond the ends."""
    none = jnp.zeros_like(a[: abs(by)])
    return jnp.concatenate([none, a[:-by]]) if by > 0 else jnp.concatenate([a[-by:], none])


def rises(pelvis: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Rise of the pelvis' forward axis and fall of its right axis, from its three turns (`PELVIS_TURNS`, rad): the
    sines of its tilt (backwards positive) and list against the vertical, whichever way it faces."""
    tilt, list_, rotation = (pelvis[..., i] for i in range(3))
    forward = jnp.sin(tilt) * jnp.cos(rotation) + jnp.cos(tilt) * jnp.sin(list_) * jnp.sin(rotation)
    right = jnp.sin(tilt) * jnp.sin(rotation) - jnp.cos(tilt) * jnp.sin(list_) * jnp.cos(rotation)
    return jnp.stack([forward, -right], axis=-1)


def inclination(pelvis: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Tilt and list (rad) of a pelvis against the vertical from its three turns."""
    return arc(rises(pelvis))


def arc(sine: Any, xp: Any = jnp) -> Any:
    """Angle (rad) of a sine, taken just short of 1, where the derivative of the arc is infinite."""
    return xp.arcsin(0.999 * sine)


def posture(qpos: Float[Array, "*n Q"], pelvis: Int[Array, " P"]) -> Float[Array, "*n Q"]:
    """Joint values with the tilt and list of the pelvis (`pelvis`: its tilt, list and rotation among the joints; none
    in a body without it) against the vertical."""
    if not pelvis.shape[0]:
        return qpos
    return qpos.at[..., pelvis[:2]].set(inclination(qpos[..., pelvis]))


def pose_z(
    pose: Float[Array, "*n Q"], neutral: Float[Array, "C Q"], whitener: Float[Array, "C Q Q"]
) -> Float[Array, "*n C Q"]:
    """Distance of a posture from the middle of each component in standard deviations: half its square is the negative
    logarithm of a normal distribution. The columns of `whitener` are 0 where a joint has no prior."""
    return jnp.einsum("...cq,cpq->...cp", pose[..., None, :] - neutral, whitener)


def pose_cost(e2: Float[Array, "*n C"], log_weight: Float[Array, " C"]) -> Float[Array, "*n"]:
    """Negative logarithm of the density of a mixture of normal distributions, without its constant, from the squared
    distance to each component: half of it where there is one component."""
    return -jax.nn.logsumexp(log_weight - 0.5 * e2, axis=-1)


def _pose_z(at: At, qpos: Float[Array, "F Q"]) -> Float[Array, "F C Q"]:
    w = at.weights
    return pose_z(posture(qpos, w.pelvis), w.neutral, w.whitener)


def _pose_prior_by_hand(at: At) -> tuple[Float[Array, "F Q"], Float[Array, "F Q Q"]]:
    """Force and curvature of the pose prior. A component's residuals are linear in a posture, so its curvature is the
    same in every frame, and only the pelvis' own three joints enter through its inclination."""
    w, z = at.weights, _pose_z(at, at.state.qpos)
    own = jax.nn.softmax(w.pose_log_weight - 0.5 * jnp.sum(z**2, axis=-1), axis=-1)
    own = POSE_PRIOR.frame_weights(at)[:, None] * own
    force = jnp.einsum("fc,fcp,cpq->fq", own, z, w.whitener)
    curvature = jnp.einsum("fc,cqr->fqr", own, jnp.einsum("cpq,cpr->cqr", w.whitener, w.whitener))
    if not w.pelvis.shape[0]:
        return force, curvature
    _, by_pelvis = linearised(inclination, at.state.qpos[:, w.pelvis])

    def through(rows: Float[Array, "F R Q"]) -> Float[Array, "F R Q"]:
        """Rows by a posture's values as rows by the joint values."""
        two = rows[..., w.pelvis[:1]] * by_pelvis[:, :1] + rows[..., w.pelvis[1:2]] * by_pelvis[:, 1:]
        return rows.at[..., w.pelvis].set(two.at[..., 2].add(rows[..., w.pelvis[2]]))

    return through(force[:, None])[:, 0], jnp.swapaxes(through(jnp.swapaxes(through(curvature), 1, 2)), 1, 2)


def _pelvis_residual(at: At, qpos: Float[Array, "F Q"]) -> Float[Array, "F 1 2"]:
    off = inclination(qpos[:, at.weights.pelvis]) - at.problem.pelvis
    return (off / jnp.deg2rad(at.weights["pelvis_sd_deg"]))[:, None]


LIMITS = Term(
    name="joint limits",
    weight="weight_limit_per_deg2",
    unknowns=Unknowns.JOINT,
    variables=lambda at: at.state.qpos[..., None],
    residual=lambda at, q: beyond_limit_deg(q[..., 0], at.weights.low, at.weights.high)[..., None],
    count=lambda at: 1.0,
)
#: A mean over all frames, those that do not count included: they lie on the way between those that do.
SMOOTHNESS = Term(
    name="smoothness",
    weight="",
    unknowns=Unknowns.JOINT_IN_THREE_FRAMES,
    variables=lambda at: three_frames(at.state.qpos),
    residual=lambda at, z: bent(z, at.problem.bend)[..., None],
    count=lambda at: at.weights.smooth,
    frames=lambda at: jnp.ones_like(at.problem.weight),
)
POSE_PRIOR = Term(
    name="pose prior",
    weight="weight_pose",
    unknowns=Unknowns.JOINTS,
    variables=lambda at: at.state.qpos,
    residual=_pose_z,
    count=lambda at: 1.0,
    robust=lambda at, e2: pose_cost(e2, at.weights.pose_log_weight),
    by_hand=_pose_prior_by_hand,
)
LPELVIS = Term(
    name="Lpelvis",
    weight="weight_pelvis",
    unknowns=Unknowns.JOINTS,
    variables=lambda at: at.state.qpos,
    residual=_pelvis_residual,
    count=lambda at: at.problem.c_pelvis[:, None] if at.weights.pelvis.shape[0] else jnp.zeros(0),
)
