"""The paper's optimiser as an `optax` chain, many steps in one compiled loop. Knows a loss, nothing of bodies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float


class Schedule(NamedTuple):
    """The optimiser's numbers, as arrays, so that others run the same compiled program: the learning rate falls
    exponentially from `rate_start` to `rate_end` over `steps`, after which nothing moves."""

    steps: Array
    rate_start: Array
    rate_end: Array
    b1: Array
    weight_decay: Array
    clip_norm: Array


def optimiser(schedule: Schedule, decayed: Any) -> optax.GradientTransformation:
    """Adam (Kingma and Ba 2015) with the gradient's norm clipped and decoupled weight decay (Loshchilov and Hutter
    2019) of the unknowns that the mask `decayed` names.
    """

    def rate(step: Any) -> Array:
        fall = (schedule.rate_end / schedule.rate_start) ** (step / schedule.steps)
        return jnp.where(step < schedule.steps, schedule.rate_start * fall, 0.0)

    return optax.chain(
        # One vector, so that clipping and Adam are a few operations whatever the number of layers.
        optax.flatten(optax.chain(optax.clip_by_global_norm(schedule.clip_norm), optax.scale_by_adam(schedule.b1))),
        optax.add_decayed_weights(schedule.weight_decay, decayed),
        optax.scale_by_learning_rate(rate),
    )


def run(
    loss: Callable[[Any, Any], Array], chain: optax.GradientTransformation, unknowns: Any, state: Any, draws: Any
) -> tuple[Any, Any, Float[Array, " K"]]:
    """K steps on `loss(unknowns, draw)`, one for each row of `draws`: unknowns and the chain's state after them, and
    the losses before each.
    """

    def step(carry: tuple[Any, Any], draw: Any) -> tuple[tuple[Any, Any], Array]:
        unknowns, state = carry
        value, slope = jax.value_and_grad(loss)(unknowns, draw)
        update, state = chain.update(slope, state, unknowns)
        return (optax.apply_updates(unknowns, update), state), value

    (unknowns, state), losses = jax.lax.scan(step, (unknowns, state), draws)
    return unknowns, state, losses
