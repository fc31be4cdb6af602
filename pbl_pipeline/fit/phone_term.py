"""The paper's Lphone: the camera's orientation and the one that the phone's sensors measured."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from .problem import Problem, State
from .term import At, Phone, Term, Unknowns, huber


def residual_phone_deg(R_nc: jaxlie.SO3, measured: jaxlie.SO3) -> Float[Array, "*n 3"]:
    """Rotation vector, in world axes, from the measured to the fitted orientation of the phone."""
    return jnp.rad2deg((R_nc @ measured.inverse()).log())


def measured_orientation(p: Problem, clock_s: Float[Array, " F"]) -> jaxlie.SO3:
    """The phone's logged orientation (F,) at the frames, with its trial's clock ahead of the video's by `clock_s`."""
    quats = p.sample_quat_wxyz[p.trial]
    at = jnp.clip((p.time_s + clock_s - p.sample_start_s[p.trial]) / p.sample_step_s, 0.0, quats.shape[1] - 1.001)
    i = jnp.floor(at).astype(jnp.int32)
    take = jax.vmap(lambda q, k: q[k])
    before, after = jaxlie.SO3(take(quats, i)), jaxlie.SO3(take(quats, i + 1))
    return jaxlie.SO3.exp((after @ before.inverse()).log() * (at - i)[:, None]) @ before


def phone_at(p: Problem, state: State) -> Phone | None:
    """The phone of a problem at its frames and the clocks of a state; None if no camera turns."""
    if not p.moving:
        return None
    clock_s = state.clock_s[p.trial]
    return Phone(
        fitted=jaxlie.SO3.from_matrix(jnp.asarray(state.R_nc)[:, 0]),
        measured=lambda more: measured_orientation(p, clock_s + more),
        weight=p.weight * jnp.asarray(p.has_phone)[p.trial],
    )


def _of_phone(at: At) -> Phone:
    assert at.phone is not None  # the term is empty without one
    return at.phone


def _residual(at: At, turn_and_clock: Float[Array, "M 4"]) -> Float[Array, "M 3"]:
    phone = _of_phone(at)
    turn = jaxlie.SO3.exp(turn_and_clock[:, :3])
    return residual_phone_deg(turn @ phone.fitted, phone.measured(turn_and_clock[:, 3]))


def _angle(at: At, e2: Array) -> Array:
    """The angle itself (deg), as in the paper, smoothed below a width."""
    width = at.weights["huber_phone_deg"]
    return huber(e2, width) / width


#: Variables: a small turn of the camera (rotation vector, world axes) and a change of the clock (s), both 0.
LPHONE = Term(
    name="Lphone",
    weight="weight_phone",
    unknowns=Unknowns.PHONE,
    variables=lambda at: jnp.zeros((_of_phone(at).weight.shape[0], 4)),
    residual=_residual,
    count=lambda at: jnp.zeros(0) if at.phone is None else 1.0,
    frames=lambda at: _of_phone(at).weight,
    robust=_angle,
)
