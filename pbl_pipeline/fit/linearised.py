"""Derivatives of small residuals, and products of many small matrices."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def linearised(residual: Callable[[Array], Array], x: Float[Array, "*n D"]) -> tuple[Array, Array]:
    """Residuals (..., E) of points (..., D) that each depend on their own point alone, and their derivatives (..., E,
    D) by its D numbers.
    """
    r, push = jax.linearize(residual, x)
    along = lambda e: push(jnp.broadcast_to(e, x.shape))  # noqa: E731
    return r, jax.vmap(along, out_axes=-1)(jnp.eye(x.shape[-1], dtype=x.dtype))


def times(a: Float[Array, "*m 3 3"], b: Float[Array, "*m 3 R"]) -> Float[Array, "*m 3 R"]:
    """Products of many small matrices, written out: a library would be called once for each."""
    return functools.reduce(jnp.add, [a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(3)])


def cross_matrix(x: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The matrix of the cross product with a vector."""
    zero = jnp.zeros_like(x[..., 0])
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return jnp.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=-1).reshape(*x.shape, 3)
