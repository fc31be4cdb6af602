"""A detector's errors common to all frames of a trial, as unknowns of the normal equations."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .keypoint_terms import corrected
from .linearised import linearised, times
from .problem import Problem, State


class DetectorError(NamedTuple):
    """Derivatives of a marker less its detected point (world axes) by the lean of its trial and by its own depth; and
    the trial of each frame as rows of 0 and 1. L is 3 and D the number of trials, or both are 0 without these unknowns.
    """

    by_lean: Array  # (F, M, 3, L)
    by_depth: Array  # (F, 3)
    trials: Array  # (F, D)


def detector_error(p: Problem, state: State, R_nc: Array) -> DetectorError:
    n = state.lean.shape[0]
    trials = jax.nn.one_hot(p.trial, n, dtype=R_nc.dtype)
    if n == 0:
        frames, _, markers, _ = p.x_cam.shape
        none = jnp.zeros((frames, markers, 3, 0), R_nc.dtype)
        return DetectorError(none, jnp.zeros((frames, 3), R_nc.dtype), trials)
    lean = jnp.broadcast_to(state.lean[p.trial][:, None], p.x_cam[:, 0].shape)
    depth_m = state.depth_m[p.trial]
    _, by_lean = linearised(lambda z: corrected(p.x_cam[:, 0, :, None], z, depth_m[..., None])[..., 0, :], lean)
    return DetectorError(-times(R_nc, by_lean), -R_nc[:, 0, :, 2], trials)


def detector_blocks(
    detector: DetectorError, b: Array, W: Array, U_t: Array, cross: Array, G: Array, f: Array, q: int
) -> tuple[Array, Array, Array, Array]:
    """Contribution of the E = 3 + M unknowns of each of D trials to the normal equations: products with the q unknowns
    of a frame (F, q, D E), with scale and offsets (S + 3 M, D E) and with each other (D E, D E), and the gradient (D
    E,).

    `b`: weights of the mean that is removed; `W`: curvature of each marker's 3D residual; `U_t`: each marker by its
    offset, transposed; `cross`: force on each marker in 3D where the unknowns of frame, scale and lean move, the mean
    removed; `G`: products of those; `f`: force on each marker in 3D now. A depth moves its own marker alone, so its
    products are those of `cross` with one direction.
    """
    u, each = detector.by_depth, detector.trials
    frames, markers = b.shape
    eye, n = jnp.eye(markers, dtype=b.dtype), G.shape[-1] - detector.by_lean.shape[-1]
    # A sum instead of a product, for which `cross` would have to be stored.
    by_depth = jnp.swapaxes(jnp.sum(u[:, None, :, None] * cross, axis=2), 1, 2)
    Wu = jnp.einsum("fmij,fj->fmi", W, u)
    own = jnp.einsum("fmi,fi->fm", Wu, u)
    mixed = b[:, :, None] * own[:, None]
    depths = own[:, :, None] * eye - mixed - jnp.swapaxes(mixed, 1, 2)
    depths += b[:, :, None] * b[:, None] * jnp.sum(own, axis=1)[:, None, None]
    # Rows: unknowns of a frame, scale, lean, depths; columns: lean, depths.
    upper = jnp.concatenate([G[:, :, n:], by_depth], axis=-1)
    rows = jnp.concatenate([upper, jnp.concatenate([jnp.swapaxes(by_depth[:, n:], 1, 2), depths], axis=-1)], axis=1)
    of_trials = jnp.einsum("fre,ft->frte", rows[:, :n], each).reshape(frames, n, -1)
    with_each_other = jnp.einsum("fde,ft,tu->tdue", rows[:, n:], each, jnp.eye(each.shape[1], dtype=b.dtype))

    by_lean = times(U_t, cross[..., n:]).reshape(frames, 3 * markers, -1)
    offset_and_lean = jnp.einsum("fol,ft->otl", by_lean, each)
    b_U_t, to_offset = b[..., None, None] * U_t, jnp.einsum("fmki,fmi->fmk", U_t, Wu)
    whole = jnp.einsum("fmki,fi->fmk", b_U_t, jnp.sum(Wu, axis=1))
    offset_and_depth = jnp.einsum("fmk,fj,ft->mktj", whole - to_offset, b, each)
    offset_and_depth -= jnp.einsum("fmki,fji,ft->mktj", b_U_t, Wu, each)
    offset_and_depth += jnp.einsum("fmk,ft,mj->mktj", to_offset, each, eye)
    offset_and_depth = offset_and_depth.reshape(3 * markers, each.shape[1], markers)
    with_offsets = jnp.concatenate([offset_and_lean, offset_and_depth], axis=-1).reshape(3 * markers, -1)

    pulled = jnp.concatenate([jnp.einsum("fmil,fmi->fl", detector.by_lean, f), jnp.einsum("fi,fmi->fm", u, f)], axis=1)
    with_shared = jnp.concatenate([jnp.sum(of_trials[:, q:], axis=0), with_offsets])
    size = with_shared.shape[1]
    return of_trials[:, :q], with_shared, with_each_other.reshape(size, size), (each.T @ pulled).reshape(-1)
