"""The normal equations of a session: the terms of `objective.py`, linearised, as one bordered banded system.

Each term states its own residuals and weights (`Term.rows`); here is how their variables move with the unknowns. A
marker's or a sole's residual depends on the joints, the camera and what the session shares only through positions, so
its derivative is that of a function of a few numbers times the kinematic Jacobian.

Unknowns of a frame: qpos (Q) and, where the camera moves, a small rotation of it (3, world axes, from the left).
Shared: s (S), marker offsets (3 J), clocks (N, where the camera moves), floors (3 N), where the paramset asks for them
the detector's errors common to all frames of a trial (lean 3, depth J; N times), and the unknowns of wearable sensors
and of the surface that a depth camera sees.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from pbl_pipeline.body import Body, MarkerJacobian, marker_jacobian, scale_multipliers

from .depth_term import LDEPTH, by_surface
from .detector_error import DetectorError, detector_blocks, detector_error
from .feet_terms import later
from .imu_term import segments_at
from .joint_terms import shift
from .keypoint_terms import mean_weights
from .linearised import cross_matrix, times
from .objective import TERMS
from .phone_term import phone_at
from .problem import Problem, State, frames_at
from .solvers.linear import BorderedBandedSystem
from .term import At, Rows, SharedTerm, Term, Unknowns, frame_count
from .weights import Weights

#: Terms that are added by way of the markers' positions (`_marker_blocks`).
OF_MARKERS = (Unknowns.MARKER, Unknowns.MARKER_AND_SURFACE, Unknowns.CENTRED_MARKER)
OF_OTHERS = tuple(u for u in Unknowns if u not in OF_MARKERS)
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
    """Sum of the terms: H (F, U, U) and g (F, U) of the frames, `link` (F, U, U) of each with the next one,
    B (F, U, K), C (K, K) and h (K,) of what is shared; and the diagonals (F, U) that are to be added to H (`own`) and
    `link` (`next_1`), and that of the link with the frame after the next (`next_2`)."""

    H: Array
    g: Array
    link: Array
    own: Array
    next_1: Array
    next_2: Array
    B: Array
    C: Array
    h: Array


def linearise(body: Body, p: Problem, w: Weights, state: State) -> Linearised:
    """The cost of a session and its normal equations."""
    # GPUs round the factors of float32 products to ten bits unless told otherwise.
    with jax.default_matmul_precision("highest"):
        columns = _columns_of(state, p.moving)
        x, soles, costs, sum_ = _keypoint_terms(body, p, w, state, columns)
        markers, at_floor, _ = p.split(x)
        at = At(p, w, state, markers, at_floor, phone_at(p, state), segments_at(body, p, state))
        of_markers = list(_terms(at, *OF_MARKERS))
        values = [term.mean(at, cost) for term, cost in zip(of_markers, costs, strict=True)]
        seen = functools.reduce(jnp.add, [v for v, term in zip(values, of_markers, strict=True) if term is not LDEPTH])
        sum_, others = _add_shared(sum_, at, columns)
        others = functools.reduce(jnp.add, [v for v, t in zip(values, of_markers, strict=True) if t is LDEPTH], others)
        for term in _terms(at, *OF_OTHERS):
            sum_, value = _add_term(sum_, term, at, soles, columns)
            others += value
        on_diagonal = lambda a: a[..., None] * jnp.eye(a.shape[-1], dtype=a.dtype)  # noqa: E731
        H, link = sum_.H + on_diagonal(sum_.own + _held(p, columns)), sum_.link + on_diagonal(sum_.next_1)
        system = BorderedBandedSystem(H, link, sum_.next_2, sum_.B, sum_.C)
        dispersion = 2 * seen * frame_count(p) / jnp.maximum(_observed_numbers(p), 1.0)
        return Linearised(seen + others, system, sum_.g, sum_.h, x, dispersion)


def moved(state: State, dx: Float[Array, "F U"], dy: Float[Array, " K"]) -> State:
    """The state after a step of the unknowns."""
    q = state.qpos.shape[1]
    moving = dx.shape[1] > q
    R_nc = state.R_nc
    if moving:
        turn = jaxlie.SO3.exp(dx[:, q:]).as_matrix()
        R_nc = jnp.einsum("fij,fvjk->fvik", turn, R_nc, precision="highest")
    y, with_shared = _shared(state, moving)
    return dataclasses.replace(with_shared(y + dy), qpos=state.qpos + dx[:, :q], R_nc=R_nc)


# --- where the shared unknowns lie


class _Columns(NamedTuple):
    s: slice
    offset: slice
    clock: slice
    floor: slice
    detector: slice
    wearing: slice
    surface: slice
    frame: int  # unknowns of a frame
    size: int


def _columns_of(state: State, moving: bool) -> _Columns:
    sizes = [sum(a.size for a in jax.tree.leaves(part)) for part in _shared_parts(state, moving)]
    ends = np.cumsum(sizes).tolist()
    places = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    return _Columns(*places, state.qpos.shape[1] + 3 * moving, ends[-1])


def _shared_parts(state: State, moving: bool) -> tuple[Any, ...]:
    """The shared unknowns of a state; clocks where a camera moves."""
    detector = jnp.concatenate([state.lean, state.depth_m], axis=1)
    clock_s = state.clock_s if moving else state.clock_s[:0]
    return state.s, state.site_offset_m, clock_s, state.floor, detector, state.wearing, state.surface


def _shared(state: State, moving: bool) -> tuple[Float[Array, " K"], Callable[[Array], State]]:
    """The shared unknowns of a state, and the state with other ones."""
    y, parts_of = ravel_pytree(_shared_parts(state, moving))

    def with_shared(y: Float[Array, " K"]) -> State:
        s, offset, clock, floor, detector, wearing, surface = parts_of(y)
        return dataclasses.replace(
            state,
            s=s,
            site_offset_m=offset,
            clock_s=clock if moving else state.clock_s,
            floor=floor,
            lean=detector[:, :3],
            depth_m=detector[:, 3:],
            wearing=wearing,
            surface=surface,
        )

    return y, with_shared


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
) -> tuple[Array, _Soles, list[Array], _Blocks]:
    """All points, the soles with their derivatives, and costs (F,) and blocks of the keypoint terms, some frames at a
    time."""
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
        at = At(part, w, dataclasses.replace(state, qpos=qpos, R_nc=R_nc), markers.x_world_m, soles.x)
        costs, blocks, shared = _marker_blocks(at, markers, detector_error(part, state, R_nc))
        return (jac.x_world_m, soles, costs, blocks), shared

    if size == frames:
        (x, soles, costs, (H, g, B)), (C, h) = some(p, state.qpos, state.R_nc)
        return x, soles, costs, _with_room(H, g, B, C, h, columns)

    def step(carry: tuple[Array, Array], index: Array):
        out, (C, h) = some(frames_at(p, index), state.qpos[index], state.R_nc[index])
        return (carry[0] + C, carry[1] + h), out

    k = sum(s.stop - s.start for s in _of_markers(columns))
    (C, h), out = jax.lax.scan(step, (jnp.zeros((k, k)), jnp.zeros(k)), jnp.arange(frames).reshape(-1, size))
    x, soles, costs, (H, g, B) = jax.tree.map(lambda a: a.reshape(frames, *a.shape[2:]), out)
    return x, soles, costs, _with_room(H, g, B, C, h, columns)


def _marker_blocks(at: At, jac: MarkerJacobian, detector: DetectorError) -> tuple[list[Array], tuple, tuple]:
    """Costs (F,) of each keypoint term, and blocks of all: H (F, U, U), g (F, U), B (F, U, K), and C (K, K), h (K,), of
    s, offsets, the detector's errors and the surface."""
    p, x, U = at.problem, jac.x_world_m, jac.per_offset
    by_frame = [jac.per_qpos]
    if p.moving:
        by_frame.append(cross_matrix(x))  # a camera that turns sees every point turn the other way
    A = jnp.concatenate([*by_frame, jac.per_scale], axis=-1)
    n_s, n = jac.per_scale.shape[-1], A.shape[-1]
    q = n - n_s

    linear = [(term, term.rows(at)) for term in _terms(at, *OF_MARKERS)]
    # Force on each marker, and its curvature (F, J, 3, 3): of terms as they are, and of centred ones in each view.
    f, M = jnp.zeros_like(x), jnp.zeros((*x.shape, 3), x.dtype)
    for c, r, D, _ in (rows for t, rows in linear if t.unknowns is not Unknowns.CENTRED_MARKER):
        f += jnp.einsum("fvm,fvmij,fvmi->fmj", c, D, r)
        M += jnp.einsum("fvm,fvmik,fvmil->fmkl", c, D, D)
    centred = mean_weights(p.c_3d, p.weight_3d)
    force = jnp.zeros((*centred.shape, 3), x.dtype)
    W = jnp.zeros((*force.shape, 3), x.dtype)
    for c, r, D, _ in (rows for t, rows in linear if t.unknowns is Unknowns.CENTRED_MARKER):
        force += jnp.einsum("fvm,fvmij,fvmi->fvmj", c, D, r)
        W += jnp.einsum("fvm,fvmik,fvmil->fvmkl", c, D, D)
    f_3d = jnp.sum(force - centred[..., None] * jnp.sum(force, axis=2, keepdims=True), axis=1)

    frames, markers = x.shape[:2]
    flat = lambda a: a.reshape(frames, markers * 3, -1)  # noqa: E731
    W_all = jnp.sum(W, axis=1)
    # Pull on each marker where the unknowns move; the detector's errors move the 3D residuals alone.
    A = jnp.concatenate([A, detector.by_lean], axis=-1)
    pulled_by = jnp.concatenate([times(M + W_all, A[..., :n]), times(W_all, A[..., n:])], axis=-1)
    G = jnp.einsum("fkq,fkr->fqr", flat(A), flat(pulled_by))
    G = G.at[:, n:, :n].set(jnp.swapaxes(G[:, :n, n:], -1, -2))
    U_t = jnp.swapaxes(U, -1, -2)
    own = jnp.sum(times(U_t, times(M + W_all, U)), axis=0)
    C_oo = jnp.einsum("mij,mn->minj", own, jnp.eye(markers, dtype=x.dtype)).reshape(3 * markers, 3 * markers)
    # A centred residual moves with its marker less the mean over the markers, which all of them move.
    for b, Wv in zip(jnp.moveaxis(centred, 1, 0), jnp.moveaxis(W, 1, 0), strict=True):
        moves = jnp.einsum("fm,fmiq->fiq", b, A)
        pull = jnp.einsum("fmij,fmjq->fiq", Wv, A)
        whole = jnp.sum(Wv, axis=1)
        both = jnp.einsum("fiq,fir->fqr", pull, moves)
        G += jnp.einsum("fiq,fij,fjr->fqr", moves, whole, moves) - both - jnp.swapaxes(both, -1, -2)
        loose = pull - whole @ moves
        pulled_by -= times(Wv, moves[:, None]) + b[..., None, None] * loose[:, None]
        X = jnp.swapaxes(times(Wv, U), 1, 2).reshape(frames, 3, 3 * markers)
        Y = jnp.swapaxes(b[..., None, None] * U, 1, 2).reshape(frames, 3, 3 * markers)
        one = jnp.einsum("fik,fil->kl", X - 0.5 * whole @ Y, Y)
        C_oo -= one + one.T
    by_offset = times(U_t, pulled_by).reshape(frames, 3 * markers, A.shape[-1]).swapaxes(1, 2)
    C_so = jnp.sum(by_offset[:, q:n], axis=0)
    C = jnp.block([[jnp.sum(G[:, q:n, q:n], axis=0), C_so], [C_so.T, C_oo]])
    B = jnp.concatenate([G[:, :q, q:n], by_offset[:, :q]], axis=-1)
    pulled = jnp.einsum("fmiq,fmi->fq", A[..., :n], f + f_3d)
    pulled_o = jnp.einsum("fmik,fmi->mk", U, f + f_3d)
    h = jnp.concatenate([jnp.sum(pulled[:, q:], axis=0), pulled_o.reshape(-1)])
    if detector.trials.shape[1]:
        # Taken off again, so that the two are never stored beside each other.
        in_3d = pulled_by - jnp.pad(times(M, A[..., :n]), [(0, 0)] * 3 + [(0, A.shape[-1] - n)])
        B_d, C_d, C_dd, h_d = detector_blocks(detector, centred[:, 0], W_all, U_t, in_3d, G, f_3d, q)
        B, h = jnp.concatenate([B, B_d], axis=-1), jnp.concatenate([h, h_d])
        C = jnp.block([[C, C_d], [C_d.T, C_dd]])
    for c, r, D, _ in (rows for t, rows in linear if t.unknowns is Unknowns.MARKER_AND_SURFACE):
        cD, by = c[:, 0, :, None] * D[:, 0, :, 0], by_surface(at)
        by_A = jnp.einsum("fmiq,fmi,fmy->fqy", A[..., :n], cD, by)
        by_o = jnp.einsum("fmik,fmi,fmy->mky", U, cD, by).reshape(3 * markers, -1)
        C_y = jnp.concatenate([jnp.sum(by_A[:, q:], axis=0), by_o])
        C_y = jnp.pad(C_y, [(0, C.shape[0] - C_y.shape[0]), (0, 0)])
        C = jnp.block([[C, C_y], [C_y.T, jnp.einsum("fm,fmx,fmy->xy", c[:, 0], by, by)]])
        B = jnp.concatenate([B, by_A[:, :q]], axis=-1)
        h = jnp.concatenate([h, jnp.einsum("fm,fm,fmy->y", c[:, 0], r[:, 0, :, 0], by)])
    return [rows.cost for _, rows in linear], (G[:, :q, :q], -pulled[:, :q], B), (C, -h)


def _terms(at: At, *unknowns: Unknowns) -> Iterator[Term]:
    """The terms of these unknowns that the problem has something for."""
    return (t for t in TERMS if isinstance(t, Term) and t.unknowns in unknowns and not t.empty(at))


def _of_markers(columns: _Columns) -> tuple[slice, ...]:
    """The shared unknowns that the keypoints' terms depend on."""
    return columns.s, columns.offset, columns.detector, columns.surface


def _with_room(H: Array, g: Array, B: Array, C: Array, h: Array, columns: _Columns) -> _Blocks:
    """The keypoints' blocks with room for all shared unknowns and no links yet."""
    among_all = functools.partial(_spread, at=_of_markers(columns), size=columns.size)
    none = jnp.zeros_like(g)
    of_shared = among_all(B), among_all(among_all(C).T).T, among_all(h)
    return _Blocks(H, g, jnp.zeros_like(H), none, none, none, *of_shared)


def _spread(a: Float[Array, "*n A"], at: Sequence[slice], size: int) -> Float[Array, "*n {size}"]:
    """Values of some of the shared unknowns, one slice after the other in `a`, among all of them, zeros elsewhere. Not
    as a scatter, whose indices a batch multiplies."""
    zeros = lambda n: jnp.zeros((*a.shape[:-1], n), a.dtype)  # noqa: E731
    parts, end = [], 0
    for part, where in zip(jnp.split(a, np.cumsum([s.stop - s.start for s in at])[:-1], axis=-1), at, strict=True):
        parts += [zeros(where.start - end), part]
        end = where.stop
    return jnp.concatenate([*parts, zeros(size - end)], axis=-1)


# --- all other terms


def _add_term(sum_: _Blocks, term: Term, at: At, soles: _Soles, columns: _Columns) -> tuple[_Blocks, Array]:
    """The sum with a term, and the term's value."""
    if term.by_hand:
        force, curvature = term.by_hand(at)
        room = functools.partial(_room, size=columns.frame, first=0)
        return sum_._replace(H=sum_.H + room(curvature), g=sum_.g - room(force)), term.value(at)
    rows = term.rows(at)
    return _add_rows(sum_, rows, term.unknowns, at, soles, columns), term.mean(at, rows.cost)


def _add_rows(sum_: _Blocks, rows: Rows, unknowns: Unknowns, at: At, soles: _Soles, columns: _Columns) -> _Blocks:
    """Add a linearised term by how its variables move with the unknowns."""
    D, trials = rows.D, jax.nn.one_hot(at.problem.trial, at.state.floor.shape[0], dtype=sum_.H.dtype)
    match unknowns:
        case Unknowns.JOINT:
            return _add_bands(sum_, rows._replace(D=jnp.pad(D, [(0, 0)] * (D.ndim - 1) + [(1, 1)])))
        case Unknowns.JOINT_IN_THREE_FRAMES:
            return _add_bands(sum_, rows)
        case Unknowns.JOINTS:
            return _add_squares(sum_, columns, rows, D)
        case Unknowns.PHONE:
            one = Rows(*(a[:, None] for a in rows))
            by_clock = one.D[..., 3:] * trials[:, None, None]
            return _add_squares(
                sum_, columns, one, one.D[..., :3], [by_clock], [columns.clock], first=soles.by_q.shape[-1]
            )
        case Unknowns.SOLE_AND_FLOOR:
            by_floor = D[..., None, 3:] * trials[:, None, None, :, None]
            shared = [D[..., :3] @ soles.by_s, by_floor.reshape(*D.shape[:-1], -1)]
            return _add_squares(sum_, columns, rows, D[..., :3] @ soles.by_q, shared, [columns.s, columns.floor])
        case Unknowns.SOLE_IN_TWO_FRAMES:
            here, there = D[..., :3], D[..., 3:]
            by_s = here @ soles.by_s + there @ later(soles.by_s)
            following = there @ later(soles.by_q)
            return _add_squares(sum_, columns, rows, here @ soles.by_q, [by_s], [columns.s], following)
        case Unknowns.SEGMENT_IN_TWO_FRAMES:
            assert at.segments is not None
            by_q = at.segments.by_q
            shared = _of_wearing(D[..., 6:], trials)
            following = D[..., 3:6] @ later(by_q)
            return _add_squares(sum_, columns, rows, D[..., :3] @ by_q, [shared], [columns.wearing], following)
    raise AssertionError(unknowns)


def _of_wearing(D: Float[Array, "F m E 11"], trials: Float[Array, "F N"]) -> Float[Array, "F m E _"]:
    """Derivatives by a sensor's mounting, world, bias and clock as those by the fields of `Wearing`."""
    frames, m, e, _ = D.shape
    own = jnp.eye(m, dtype=D.dtype)
    mount, bias = (jnp.einsum("fmek,mj->fmejk", D[..., i : i + 3], own) for i in (0, 6))
    world = jnp.einsum("fmek,mj,fn->fmenjk", D[..., 3:6], own, trials)
    clock = jnp.einsum("fmek,fn->fmenk", D[..., 9:], trials)
    return jnp.concatenate([a.reshape(frames, m, e, -1) for a in (mount, world, bias, clock)], axis=-1)


def _add_squares(
    sum_: _Blocks,
    columns: _Columns,
    rows: Rows,
    here: Float[Array, "F P D n"],
    shared: Sequence[Float[Array, "F P D _"]] = (),
    at: Sequence[slice] = (),
    following: Float[Array, "F P D n"] | None = None,
    first: int = 0,
) -> _Blocks:
    """Add weighted squares of residuals. `here`: their derivatives by the unknowns of the frame from `first` on;
    `following`: by those of the next frame; `shared`: by the shared unknowns that lie `at` some places."""
    n, parts = here.shape[-1], [here] if following is None else [here, following]
    m, J = n * len(parts), jnp.concatenate([*parts, *shared], axis=-1)
    K = jnp.einsum("fpia,fp,fpib->fab", J, rows.c, J)
    force = jnp.einsum("fpia,fp,fpi->fa", J, rows.c, rows.r)
    H, B, g, link = K[:, :n, :n], K[:, :n, m:], force[:, :n], sum_.link
    if following is not None:
        second = slice(n, m)
        H, B, g = H + shift(K[:, second, second], 1), B + shift(K[:, second, m:], 1), g + shift(force[:, second], 1)
        link += _room(K[:, :n, second], columns.frame, first)
    room = functools.partial(_room, size=columns.frame, first=first)
    sum_ = sum_._replace(H=sum_.H + room(H), g=sum_.g - room(g), link=link)
    if not shared:
        return sum_
    among_all = functools.partial(_spread, at=at, size=columns.size)
    below = [(0, 0), (first, columns.frame - first - n), (0, 0)]
    return sum_._replace(
        B=sum_.B + jnp.pad(among_all(B), below),
        C=sum_.C + among_all(among_all(jnp.sum(K[:, m:, m:], axis=0)).T).T,
        h=sum_.h - among_all(jnp.sum(force[:, m:], axis=0)),
    )


def _add_bands(sum_: _Blocks, rows: Rows) -> _Blocks:
    """Add weighted squares of residuals (F, Q, E) of each joint in the frame before, at and after, by derivatives (F,
    Q, E, 3). That at t involves t - 1, t and t + 1, and that at t + 1 the following three."""
    c, r, D, _ = rows
    before, now, after = (c * jnp.sum(D[..., k] * r, axis=-1) for k in range(3))
    both = {(i, k): c * jnp.sum(D[..., i] * D[..., k], axis=-1) for i in range(3) for k in range(i, 3)}
    wide = lambda a: jnp.pad(a, [(0, 0), (0, sum_.g.shape[-1] - a.shape[-1])])  # noqa: E731
    return sum_._replace(
        g=sum_.g - wide(shift(before, -1) + now + shift(after, 1)),
        own=sum_.own + wide(shift(both[0, 0], -1) + both[1, 1] + shift(both[2, 2], 1)),
        next_1=sum_.next_1 + wide(both[1, 2] + shift(both[0, 1], -1)),
        next_2=sum_.next_2 + wide(shift(both[0, 2], -1)),
    )


def _add_shared(sum_: _Blocks, at: At, columns: _Columns) -> tuple[_Blocks, Array]:
    """The sum with the terms of the shared unknowns alone, all quadratic, and their value."""
    y, with_shared = _shared(at.state, at.problem.moving)
    terms = [term for term in TERMS if isinstance(term, SharedTerm) and not term.empty(at)]

    def cost(y: Array) -> Array:
        there = at._replace(state=with_shared(y))
        return functools.reduce(jnp.add, [term.value(there) for term in terms])

    n = frame_count(at.problem)
    slope, push = jax.linearize(jax.grad(cost), y)
    curvature = jax.vmap(push)(jnp.eye(columns.size, dtype=y.dtype))
    return sum_._replace(C=sum_.C + n * curvature, h=sum_.h - n * slope), cost(y)


def _held(p: Problem, columns: _Columns) -> Float[Array, "F U"]:
    """Addition to the diagonal of each frame: a frame without weight stays where it is, and one without an orientation
    keeps its camera."""
    bent = p.bend[:, 1] ** 2 + shift(p.bend[:, 0], -1) ** 2 + shift(p.bend[:, 2], 1) ** 2
    empty = ((p.weight == 0) & (bent == 0))[:, None]
    turns = (1e-3 + 1e6 * (1 - p.has_phone[p.trial]))[:, None] if p.moving else 0.0
    return empty + turns * (jnp.arange(columns.frame) >= columns.frame - 3)


def _room(a: Array, size: int, first: int) -> Array:
    """Values (F, n) or (F, n, n) of some unknowns of a frame, from `first` on, among all of them."""
    beside = (first, size - first - a.shape[-1])
    return jnp.pad(a, [(0, 0)] + [beside] * (a.ndim - 1))
