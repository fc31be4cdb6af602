"""The normal equations of a session: every residual of `objective.py`, differentiated, as one bordered banded system.

A keypoint's residual depends on the joints, the camera and what the session shares only through one marker's position,
so its derivative is that of a function of three numbers (`linearised`) times the kinematic Jacobian. Robust costs enter
as weighted squares (iteratively reweighted least squares).

Unknowns of a frame: qpos (Q) and, where the camera moves, a small rotation of it (3, world axes, from the left).
Shared: s (S), marker offsets (3 J), clocks (N, where the camera moves), floors (3 N) and, where the paramset asks for
them, what the detector gets wrong in all frames of a trial (lean 3, depth J; N times).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, MarkerJacobian, marker_jacobian, scale_multipliers

from .detector_error import DetectorError, detector_blocks, detector_error
from .linearised import linearised, times
from .objective import (
    At,
    Loffset,
    State,
    detector_prior,
    frame_count,
    huber_weight,
    in_camera,
    later,
    mean_weights,
    no_phone,
    offset_m,
    residual_2d_px,
    residual_3d_cm,
    residual_floor_cm,
    residual_phone_deg,
    residual_slide_cm,
    shared_prior,
    slide_contact,
    weighted,
)
from .priors import Weights, bent, beyond_limit_deg, inclination, pose_z, posture, responsibilities, shift
from .problem import Problem, frames_at
from .solvers.linear import BorderedBandedSystem

#: Frames whose markers are differentiated at once: bounds the memory of long sessions.
CHUNK = 512


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Linearised:
    """The cost at a state, its curvature times the number of frames (`system`) and its negative gradient (`g` of the
    frames' unknowns, `h` of the shared ones). `x`: the points there; `dispersion`: twice the keypoints' cost per
    observed number, which turns the cost's curvature into that of a log-likelihood.
    """

    cost: Float[Array, ""]
    system: BorderedBandedSystem
    g: Float[Array, "F U"]
    h: Float[Array, " K"]
    x: Float[Array, "F P 3"]
    dispersion: Float[Array, ""]


class _Blocks(NamedTuple):
    """What the terms add up to: H (F, U, U) and g (F, U) of the frames, `link` (F, U, U) of each with the next one, B
    (F, U, K), C (K, K) and h (K,) of what is shared."""

    H: Array
    g: Array
    link: Array
    B: Array
    C: Array
    h: Array


def linearise(body: Body, p: Problem, w: Weights, state: State) -> Linearised:
    """The cost of a session and its normal equations."""
    # GPUs round the factors of float32 products to ten bits unless told otherwise.
    with jax.default_matmul_precision("highest"):
        columns = _columns_of(state, p.moving)
        x, soles, blocks = _keypoint_terms(body, p, w, state, columns)
        blocks = _add_soles(blocks, p, w, state, soles, columns)
        blocks = _add_shared(blocks, p, w, state, columns)
        if p.moving:
            blocks = _add_phone(blocks, p, w, state, columns)
        blocks, next_2 = _add_joints(blocks, p, w, state)
        system = BorderedBandedSystem(blocks.H, blocks.link, next_2, blocks.B, blocks.C)
        markers, at_floor, _ = p.split(x)
        at = At(p, w, state, markers, at_floor, _phone(p, state))
        terms = weighted(at)
        dispersion = 2 * (terms["L3D"] + terms["L2D"]) * frame_count(p) / jnp.maximum(_observed_numbers(p), 1.0)
        cost = functools.reduce(jnp.add, terms.values())
        return Linearised(cost, system, blocks.g, blocks.h, x, dispersion)


def moved(state: State, dx: Float[Array, "F U"], dy: Float[Array, " K"]) -> State:
    """The state after a step of the unknowns."""
    sizes = _columns_of(state, dx.shape[1] > state.qpos.shape[1])
    turn = jaxlie.SO3.exp(dx[:, state.qpos.shape[1] :]).as_matrix() if sizes.clock else None
    R_nc = state.R_nc if turn is None else jnp.einsum("fij,fvjk->fvik", turn, state.R_nc, precision="highest")
    detector = dy[sizes.detector].reshape(state.lean.shape[0], 3 + state.depth_m.shape[1])
    return State(
        qpos=state.qpos + dx[:, : state.qpos.shape[1]],
        R_nc=R_nc,
        s=state.s + dy[sizes.s],
        site_offset_m=state.site_offset_m + dy[sizes.offset].reshape(-1, 3),
        clock_s=state.clock_s + dy[sizes.clock] if sizes.clock else state.clock_s,
        floor=state.floor + dy[sizes.floor].reshape(-1, 3),
        lean=state.lean + detector[:, :3],
        depth_m=state.depth_m + detector[:, 3:],
    )


def measured_orientation(p: Problem, clock_s: Float[Array, " F"]) -> jaxlie.SO3:
    """The phone's logged orientation (F,) at the frames, with its trial's clock ahead of the video's by `clock_s`."""
    quats = p.sample_quat_wxyz[p.trial]
    at = jnp.clip((p.time_s + clock_s - p.sample_start_s[p.trial]) / p.sample_step_s, 0.0, quats.shape[1] - 1.001)
    i = jnp.floor(at).astype(jnp.int32)
    take = jax.vmap(lambda q, k: q[k])
    before, after = jaxlie.SO3(take(quats, i)), jaxlie.SO3(take(quats, i + 1))
    return jaxlie.SO3.exp((after @ before.inverse()).log() * (at - i)[:, None]) @ before


# --- where the shared unknowns lie


class _Columns(NamedTuple):
    s: slice
    offset: slice
    clock: slice | None
    floor: slice
    detector: slice
    frame: int  # unknowns of a frame
    size: int


def _columns_of(state: State, moving: bool) -> _Columns:
    of_detector = state.lean.size + state.depth_m.size
    sizes = [state.s.size, state.site_offset_m.size, state.clock_s.size * moving, state.floor.size, of_detector]
    ends = [sum(sizes[: i + 1]) for i in range(5)]
    s, offset, clock, floor, detector = (slice(end - size, end) for end, size in zip(ends, sizes, strict=True))
    return _Columns(s, offset, clock if moving else None, floor, detector, state.qpos.shape[1] + 3 * moving, ends[-1])


def _phone(p: Problem, state: State) -> tuple[jaxlie.SO3, jaxlie.SO3, Array]:
    if not p.moving:
        return no_phone()
    weights = p.weight * p.has_phone[p.trial] / frame_count(p)
    return jaxlie.SO3.from_matrix(state.R_nc[:, 0]), measured_orientation(p, state.clock_s[p.trial]), weights


def _observed_numbers(p: Problem) -> Array:
    seen = lambda c: jnp.sum((c > 0) * p.weight.reshape(-1, *[1] * (c.ndim - 1)))  # noqa: E731
    return 3 * seen(p.c_3d) + 2 * seen(p.c_2d) + 3 * seen(p.c_world)


# --- keypoints


class _Soles(NamedTuple):
    x: Array  # (F, P, 3)
    by_q: Array  # (F, P, 3, Q)
    by_s: Array  # (F, P, 3, S)


def _keypoint_terms(
    body: Body, p: Problem, w: Weights, state: State, columns: _Columns
) -> tuple[Array, _Soles, _Blocks]:
    """All points, the soles with their derivatives, and the blocks of the keypoint terms, some frames at a time."""
    frames = p.weight.shape[0]
    size = next(s for s in (frames, CHUNK, CHUNK * 3 // 4) if frames % s == 0 and s <= CHUNK)
    offsets, scale = p.point_offsets(state.site_offset_m), scale_multipliers(state.s)
    mixer = jax.jacfwd(scale_multipliers)(state.s)
    first_sole, n_soles = p.weight_3d.shape[0], p.contact.shape[1]

    def some(part: Problem, qpos: Array, R_nc: Array):
        jac = marker_jacobian(body, p.points, qpos, scale, offsets)
        jac = dataclasses.replace(jac, per_scale=jac.per_scale @ mixer)
        at = slice(first_sole, first_sole + n_soles)
        soles = _Soles(jac.x_world_m[:, at], jac.per_qpos[:, at], jac.per_scale[:, at])
        markers: MarkerJacobian = jax.tree.map(lambda a: a[:, :first_sole], jac)
        (H, g, B), shared = _marker_blocks(part, w, markers, R_nc, detector_error(part, state, R_nc))
        return (jac.x_world_m, soles, H, g, B), shared

    if size == frames:
        (x, soles, H, g, B), (C, h) = some(p, state.qpos, state.R_nc)
        return x, soles, _with_room(H, g, B, C, h, columns)

    def step(carry: tuple[Array, Array], index: Array):
        out, (C, h) = some(frames_at(p, index), state.qpos[index], state.R_nc[index])
        return (carry[0] + C, carry[1] + h), out

    k = state.s.size + state.site_offset_m.size + state.lean.size + state.depth_m.size
    (C, h), out = jax.lax.scan(step, (jnp.zeros((k, k)), jnp.zeros(k)), jnp.arange(frames).reshape(-1, size))
    x, soles, H, g, B = jax.tree.map(lambda a: a.reshape(frames, *a.shape[2:]), out)
    return x, soles, _with_room(H, g, B, C, h, columns)


def _marker_blocks(
    p: Problem, w: Weights, jac: MarkerJacobian, R_nc: Array, detector: DetectorError
) -> tuple[tuple, tuple]:
    """Blocks of the keypoint terms: H (F, U, U), g (F, U), B (F, U, K) and C (K, K), h (K,), of s, offsets and what the
    detector gets wrong."""
    x, U = jac.x_world_m, jac.per_offset
    by_frame = [jac.per_qpos]
    if p.moving:
        by_frame.append(_cross_matrix(x))  # a camera that turns sees every point turn the other way
    A = jnp.concatenate([*by_frame, jac.per_scale], axis=-1)
    n_s, n = jac.per_scale.shape[-1], A.shape[-1]
    q = n - n_s
    frame = p.weight[:, None]

    f, M = jnp.zeros_like(x), jnp.zeros((*x.shape, 3), x.dtype)
    if p.c_world.shape[1]:
        r, D = linearised(lambda x: residual_3d_cm(x, p.x_world), x)
        c = w.weight_3d * frame * p.c_world * p.weight_3d * huber_weight(r, w.huber_3d_cm)
        f += jnp.einsum("fm,fmij,fmi->fmj", c, D, r)
        M += jnp.einsum("fm,fmik,fmil->fmkl", c, D, D)

    r, D = linearised(lambda x: residual_2d_px(in_camera(x, R_nc, p.p_nc), p.xy_px, p.camera_matrix), x)
    c = w.weight_2d * frame[..., None] * p.c_2d * huber_weight(r, w.huber_2d_px)
    f += jnp.einsum("fvm,fvmij,fvmi->fmj", c, D, r)
    M += jnp.einsum("fvm,fvmik,fvmil->fmkl", c, D, D)

    centred = mean_weights(p.c_3d, p.weight_3d)
    away = offset_m(in_camera(x, R_nc, p.p_nc), detector.x_cam, centred)
    r, D = linearised(lambda x: residual_3d_cm(in_camera(x, R_nc, p.p_nc) - away, detector.x_cam, w.depth_ratio), x)
    c = w.weight_3d * frame[..., None] * p.c_3d * p.weight_3d * huber_weight(r, w.huber_3d_cm)
    force = jnp.einsum("fvm,fvmij,fvmi->fvmj", c, D, r)
    f_3d = jnp.sum(force - centred[..., None] * jnp.sum(force, axis=2, keepdims=True), axis=1)
    W = jnp.einsum("fvm,fvmik,fvmil->fvmkl", c, D, D)

    frames, markers = x.shape[:2]
    flat = lambda a: a.reshape(frames, markers * 3, -1)  # noqa: E731
    W_all = jnp.sum(W, axis=1)
    # What the detector gets wrong moves the 3D residuals alone.
    wide = lambda a: jnp.pad(a, [(0, 0)] * 3 + [(0, detector.by_lean.shape[-1])])  # noqa: E731
    of_2d = wide(times(M, A))
    A = jnp.concatenate([A, detector.by_lean], axis=-1)
    cross = times(W_all, A)
    G = jnp.einsum("fkq,fkr->fqr", flat(A), flat(cross + of_2d))
    G = G.at[:, n:, :n].set(jnp.swapaxes(G[:, :n, n:], -1, -2))
    U_t = jnp.swapaxes(U, -1, -2)
    own = jnp.sum(times(U_t, times(M + W_all, U)), axis=0)
    C_oo = jnp.einsum("mij,mn->minj", own, jnp.eye(markers, dtype=x.dtype)).reshape(3 * markers, 3 * markers)
    # A centred residual moves with its marker less the mean over the markers, which all of them move.
    for b, Wv in zip(jnp.moveaxis(centred, 1, 0), jnp.moveaxis(W, 1, 0), strict=True):
        moves = jnp.einsum("fm,fmiq->fiq", b, A)
        pull = jnp.sum(times(Wv, A), axis=1)
        whole = jnp.sum(Wv, axis=1)
        both = jnp.einsum("fiq,fir->fqr", pull, moves)
        G += jnp.einsum("fiq,fij,fjr->fqr", moves, whole, moves) - both - jnp.swapaxes(both, -1, -2)
        loose = pull - whole @ moves
        cross = cross - times(Wv, moves[:, None]) - b[..., None, None] * loose[:, None]
        X = jnp.swapaxes(times(Wv, U), 1, 2).reshape(frames, 3, 3 * markers)
        Y = jnp.swapaxes(b[..., None, None] * U, 1, 2).reshape(frames, 3, 3 * markers)
        one = jnp.einsum("fik,fil->kl", X - 0.5 * whole @ Y, Y)
        C_oo -= one + one.T
    by_offset = times(U_t, cross + of_2d).reshape(frames, 3 * markers, A.shape[-1]).swapaxes(1, 2)
    C_so = jnp.sum(by_offset[:, q:n], axis=0)
    C = jnp.block([[jnp.sum(G[:, q:n, q:n], axis=0), C_so], [C_so.T, C_oo]])
    B = jnp.concatenate([G[:, :q, q:n], by_offset[:, :q]], axis=-1)
    pulled = jnp.einsum("fmiq,fmi->fq", A[..., :n], f + f_3d)
    pulled_o = jnp.einsum("fmik,fmi->mk", U, f + f_3d)
    h = jnp.concatenate([jnp.sum(pulled[:, q:], axis=0), pulled_o.reshape(-1)])
    if detector.trials.shape[1]:
        B_d, C_d, C_dd, h_d = detector_blocks(detector, centred[:, 0], W_all, U_t, cross, G, f_3d, q)
        B, h = jnp.concatenate([B, B_d], axis=-1), jnp.concatenate([h, h_d])
        C = jnp.block([[C, C_d], [C_d.T, C_dd]])
    return (G[:, :q, :q], -pulled[:, :q], B), (C, -h)


def _with_room(H: Array, g: Array, B: Array, C: Array, h: Array, columns: _Columns) -> _Blocks:
    """The keypoints' blocks with room for all shared unknowns and no links yet."""
    among_all = functools.partial(_spread, at=(columns.s, columns.offset, columns.detector), size=columns.size)
    return _Blocks(H, g, jnp.zeros_like(H), among_all(B), among_all(among_all(C).T).T, among_all(h))


def _spread(a: Float[Array, "*n A"], at: Sequence[slice], size: int) -> Float[Array, "*n {size}"]:
    """Values of some of the shared unknowns, one slice after the other in `a`, among all of them, zeros elsewhere. Not
    as a scatter, whose indices a batch multiplies."""
    zeros = lambda n: jnp.zeros((*a.shape[:-1], n), a.dtype)  # noqa: E731
    parts, end = [], 0
    for part, where in zip(jnp.split(a, np.cumsum([s.stop - s.start for s in at])[:-1], axis=-1), at, strict=True):
        parts += [zeros(where.start - end), part]
        end = where.stop
    return jnp.concatenate([*parts, zeros(size - end)], axis=-1)


def _cross_matrix(x: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    zero = jnp.zeros_like(x[..., 0])
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return jnp.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=-1).reshape(*x.shape, 3)


# --- joints


def _add_joints(sum_: _Blocks, p: Problem, w: Weights, state: State) -> tuple[_Blocks, Array]:
    """Limits, pose prior and smoothness, and the diagonals (F, U) of the links with the frame after the next. Frames
    that count for nothing stay where they are.
    """
    r, D = linearised(lambda q: beyond_limit_deg(q[..., 0], w.low, w.high)[..., None], state.qpos[..., None])
    each = w.weight_limit * p.weight[:, None]
    diagonal, force = each * D[..., 0, 0] ** 2, each * D[..., 0, 0] * r[..., 0]
    each = w.weight_pose * p.weight[:, None]
    z = pose_z(posture(state.qpos, w.pelvis), w.neutral, w.whitener)
    own = each * responsibilities(z, w.pose_log_weight)
    towards = jnp.einsum("fc,fcp,cpq->fq", own, z, w.whitener)
    curvature = jnp.einsum("fc,cqr->fqr", own, jnp.einsum("cpq,cpr->cqr", w.whitener, w.whitener))
    if w.pelvis.shape[0]:
        # Only the pelvis' own three joints are seen through its tilt and list.
        inclined, by_pelvis = linearised(inclination, state.qpos[:, w.pelvis])
        # Among a posture's values these two are the pelvis' own.
        each = w.weight_pelvis * p.weight * p.c_pelvis / w.pelvis_sd**2
        towards = towards.at[:, w.pelvis[:2]].add(each[:, None] * (inclined - p.pelvis))
        curvature = curvature.at[:, w.pelvis[:2], w.pelvis[:2]].add(each[:, None])
        through = lambda a: _through(a, by_pelvis, w.pelvis)  # noqa: E731
        towards = through(towards[:, None])[:, 0]
        curvature = jnp.swapaxes(through(jnp.swapaxes(through(curvature), 1, 2)), 1, 2)
    force += towards
    r, transposed = jax.vjp(lambda q: bent(q, p.bend), state.qpos)
    force += transposed(w.smooth * r)[0]
    # The difference at t involves t - 1, t and t + 1; that at t + 1 the following three.
    at, after = p.bend[:, 1], p.bend[:, 2]
    later_before, later_at, later_after = shift(p.bend, -1).T
    around = at**2 + later_before**2 + shift(after, 1) ** 2
    diagonal += around[:, None] * w.smooth
    next_1 = (at * after + later_before * later_at)[:, None] * w.smooth
    next_2 = (later_before * later_after)[:, None] * w.smooth
    wide = lambda a: jnp.pad(a, [(0, 0), (0, sum_.g.shape[-1] - a.shape[-1])])  # noqa: E731
    empty = (p.weight == 0) & (around == 0)
    on_diagonal = lambda a: a[..., None] * jnp.eye(a.shape[-1], dtype=a.dtype)  # noqa: E731
    q = state.qpos.shape[1]
    H = (sum_.H + on_diagonal(wide(diagonal) + empty[:, None])).at[:, :q, :q].add(curvature)
    link = sum_.link + on_diagonal(wide(next_1))
    return sum_._replace(H=H, g=sum_.g - wide(force), link=link), wide(next_2)


def _through(a: Float[Array, "F R Q"], by_pelvis: Float[Array, "F 2 3"], pelvis: Array) -> Float[Array, "F R Q"]:
    """Rows by a posture's values as rows by the joint values."""
    of_pelvis = a[..., pelvis[:1]] * by_pelvis[:, :1] + a[..., pelvis[1:2]] * by_pelvis[:, 1:]
    return a.at[..., pelvis].set(of_pelvis.at[..., 2].add(a[..., pelvis[2]]))


# --- shared unknowns, phone, soles


def _add_shared(sum_: _Blocks, p: Problem, w: Weights, state: State, columns: _Columns) -> _Blocks:
    """Marker offsets and the priors of scale, clocks, floors and the detector's errors, all quadratic."""

    def cost(y: Array) -> Array:
        clock = y[columns.clock] if columns.clock else jnp.zeros(1)
        floor = y[columns.floor].reshape(-1, 3)
        lean, depth_m = jnp.split(
            y[columns.detector].reshape(state.lean.shape[0], 3 + state.depth_m.shape[1]), [3], axis=1
        )
        offset = w.weight_offset_per_m2 * Loffset(y[columns.offset].reshape(-1, 3))
        detector = w.weight_detector * detector_prior(p, w, lean, depth_m)
        return frame_count(p) * (offset + detector + shared_prior(p, w, y[columns.s], clock, floor))

    detector = jnp.concatenate([state.lean, state.depth_m], axis=1)
    parts = [state.s, state.site_offset_m, *([state.clock_s] if columns.clock else []), state.floor, detector]
    y = jnp.concatenate([a.reshape(-1) for a in parts])
    return sum_._replace(C=sum_.C + jax.hessian(cost)(y), h=sum_.h - jax.grad(cost)(y))


def _add_phone(sum_: _Blocks, p: Problem, w: Weights, state: State, columns: _Columns) -> _Blocks:
    """The phone's orientation: rotations of the camera (the last 3 unknowns of a frame) and the clocks."""
    R_nc, clock = jaxlie.SO3.from_matrix(state.R_nc[:, 0]), state.clock_s[p.trial]

    def residual(z: Array) -> Array:
        return residual_phone_deg(jaxlie.SO3.exp(z[:, :3]) @ R_nc, measured_orientation(p, clock + z[:, 3]))

    r, D = linearised(residual, jnp.zeros((clock.shape[0], 4), clock.dtype))
    has_phone = p.has_phone[p.trial]
    c = w.weight_phone / w.huber_phone_deg * p.weight * has_phone * huber_weight(r, w.huber_phone_deg)
    K = jnp.einsum("f,fik,fil->fkl", c, D, D)
    force = jnp.einsum("f,fik,fi->fk", c, D, r)
    # A frame without orientation keeps its camera.
    hold = (1e-3 + 1e6 * (1 - has_phone))[:, None, None] * jnp.eye(3, dtype=K.dtype)
    trials = jax.nn.one_hot(p.trial, p.has_phone.shape[0], dtype=K.dtype)
    at = columns.clock
    return sum_._replace(
        H=sum_.H.at[:, -3:, -3:].add(K[:, :3, :3] + hold),
        g=sum_.g.at[:, -3:].add(-force[:, :3]),
        B=sum_.B.at[:, -3:, at].add(K[:, :3, 3:] * trials[:, None]),
        C=sum_.C.at[at, at].add(jnp.diag(K[:, 3, 3] @ trials)),
        h=sum_.h.at[at].add(-force[:, 3] @ trials),
    )


def _add_soles(sum_: _Blocks, p: Problem, w: Weights, state: State, soles: _Soles, columns: _Columns) -> _Blocks:
    """Feet on the floor, which also couple a frame's joints with the next one's."""
    n, q = state.floor.shape[0], soles.by_q.shape[-1]
    x, floor = soles.x, jnp.broadcast_to(state.floor[p.trial][:, None], soles.x.shape)
    frame = p.weight[:, None]

    at_floor = jnp.concatenate([x, floor], axis=-1)
    r, D = linearised(lambda z: residual_floor_cm(z[..., :3], z[..., 3:]), at_floor)
    one_hot = jax.nn.one_hot(p.trial, n, dtype=x.dtype)[:, None, None, :, None]
    by_floor = (D[..., None, 3:] * one_hot).reshape(*D.shape[:-1], 3 * n)
    by_all = jnp.concatenate([D[..., :3] @ soles.by_q, D[..., :3] @ soles.by_s, by_floor], axis=-1)
    c = frame * p.contact * w.weight_floor * huber_weight(r, w.huber_floor_cm)
    K, force = _squares(by_all, c, r)
    H, B, C = K[:, :q, :q], K[:, :q, q:], jnp.sum(K[:, q:, q:], axis=0)
    g, h = force[:, :q], jnp.sum(force[:, q:], axis=0)

    now_and_next = jnp.concatenate([x, later(x)], axis=-1)
    r, D = linearised(lambda z: residual_slide_cm(z[..., :3], z[..., 3:], p.rate[:, None]), now_and_next)
    here, there = D[..., :3], D[..., 3:]
    by_s = here @ soles.by_s + there @ later(soles.by_s)
    by_all = jnp.concatenate([here @ soles.by_q, there @ later(soles.by_q), by_s], axis=-1)
    c = frame * slide_contact(p) * w.weight_slide * huber_weight(r, w.huber_slide_cm)
    K, force = _squares(by_all, c, r)
    n_s, first, second, both = by_s.shape[-1], slice(q), slice(q, 2 * q), slice(2 * q, None)
    H += K[:, first, first] + shift(K[:, second, second], 1)
    B = B.at[..., :n_s].add(K[:, first, both] + shift(K[:, second, both], 1))
    C = C.at[:n_s, :n_s].add(jnp.sum(K[:, both, both], axis=0))
    g += force[:, first] + shift(force[:, second], 1)
    h = h.at[:n_s].add(jnp.sum(force[:, both], axis=0))

    # The shared unknowns of the soles are s and the floors, which do not lie side by side.
    among_all = functools.partial(_spread, at=(columns.s, columns.floor), size=columns.size)
    return sum_._replace(
        H=sum_.H.at[:, :q, :q].add(H),
        g=sum_.g.at[:, :q].add(-g),
        link=sum_.link.at[:, :q, :q].add(K[:, first, second]),
        B=sum_.B.at[:, :q].add(among_all(B)),
        C=sum_.C + among_all(among_all(C).T).T,
        h=sum_.h - among_all(h),
    )


def _squares(J: Float[Array, "F P D A"], c: Float[Array, "F P"], r: Float[Array, "F P D"]) -> tuple[Array, Array]:
    """Curvature (F, A, A) and gradient (F, A) of half the weighted squares of residuals with a Jacobian."""
    return jnp.einsum("fpia,fp,fpib->fab", J, c, J), jnp.einsum("fpia,fp,fpi->fa", J, c, r)
