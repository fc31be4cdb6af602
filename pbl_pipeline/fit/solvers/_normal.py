"""The cost of a session over per-frame poses, and its normal equations at one point.

The derivatives are written out (`body/_jacobian.py`): a frame's Hessian is a sum over its markers of small products,
the 3D term's centring adds three-dimensional corrections, and what all frames share borders the frames' blocks. Robust
costs enter as weighted squares (iteratively reweighted least squares).
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body
from pbl_pipeline.body._jacobian import MarkerTable, marker_jacobian, table_positions

from .. import _costs as costs
from .._marker_cost import Kinds, marker_cost
from .._observations import Observations
from ._arrow import Arrow
from ._contact import contact_cost, contact_terms, floor_cost

#: Frames whose markers are differentiated at once: bounds the memory of long sessions.
CHUNK = 512


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Weights:
    """The numbers of a paramset as arrays, so that another paramset runs the same compiled program."""

    weight_3d: Float[Array, ""]
    weight_2d: Float[Array, ""]
    weight_phone: Float[Array, ""]
    weight_offset_per_m2: Float[Array, ""]
    depth_ratio: Float[Array, ""]
    huber_3d_cm: Float[Array, ""]
    huber_2d_px: Float[Array, ""]
    huber_phone_deg: Float[Array, ""]
    weight_limit: Float[Array, ""]
    weight_pose: Float[Array, ""]
    weight_scale: Float[Array, ""]
    scale_sd: Float[Array, ""]
    scale_sides_sd: Float[Array, ""]
    #: Half of it times the squared overall scale parameter; 0 where the keypoints tell the size.
    weight_size: Float[Array, ""]
    clock_sd_s: Float[Array, ""]
    #: Feet on the floor (`_contact.py`).
    weight_floor: Float[Array, ""]
    weight_slide: Float[Array, ""]
    huber_floor_cm: Float[Array, ""]
    huber_slide_cm: Float[Array, ""]
    slope_sd: Float[Array, ""]
    neutral: Float[Array, " 40"]
    inverse_sd: Float[Array, " 40"]
    #: Per (rad per frame^2 at 30 Hz)^2, of slides per (m per frame^2)^2.
    smooth: Float[Array, " 40"]
    low: Float[Array, " 40"]
    high: Float[Array, " 40"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The unknowns. `s`: the paper's scale parameters; `clock_s`: sensor time minus video time of each trial; `floor`:
    its height (m) and slopes along the world's x and y, of each trial."""

    qpos: Float[Array, "F 40"]
    R_nc: Float[Array, "F V 3 3"]
    s: Float[Array, " 8"]
    site_offset_m: Float[Array, "J 3"]
    clock_s: Float[Array, " N"]
    floor: Float[Array, "N 3"]


def scale_multipliers(s: Float[Array, " 8"]) -> Float[Array, " 8"]:
    """Multipliers of the scale groups: 1 + overall for "overall", 1 + overall + own for the others."""
    return 1.0 + s[0] + jnp.concatenate([jnp.zeros(1, s.dtype), s[1:]])


#: Multipliers are 1 + MIXER @ s (`scale_multipliers`).
MIXER = np.eye(8)
MIXER[:, 0] = 1.0


def cost(body: Body, table: MarkerTable, obs: Observations, w: Weights, kinds: Kinds, state: State) -> Array:
    """The cost of a session: means over frames and markers, as the paper's, plus priors."""
    n = jnp.maximum(jnp.sum(obs.weight), 1.0)
    total = keypoint_cost(body, table, obs, w, kinds, state)
    if kinds.moving:
        error, _ = _phone_error_deg(obs, state)
        total += w.weight_phone * costs.huber_of_square(jnp.sum(error**2, -1), w.huber_phone_deg) / w.huber_phone_deg
    total += 0.5 * w.weight_limit * jnp.sum(costs.beyond_limit_deg(state.qpos, w.low, w.high) ** 2, axis=-1)
    if kinds.contact:
        total += contact_cost(body, obs, w, scale_multipliers(state.s), state)
    bent = 0.5 * jnp.sum(costs.second_difference(state.qpos, obs.bend) ** 2 * w.smooth)
    shared = w.weight_offset_per_m2 * costs.offset_m2(state.site_offset_m)
    shared += w.weight_pose * costs.pose_prior(state.qpos, w.neutral, w.inverse_sd, obs.weight)
    shared += w.weight_scale * costs.scale_prior(state.s, w.scale_sd, w.scale_sides_sd)
    shared += 0.5 * w.weight_size * state.s[0] ** 2
    if kinds.moving:
        shared += 0.5 * jnp.sum((state.clock_s / w.clock_sd_s) ** 2) / n
    if kinds.contact:
        shared += floor_cost(state.floor, w.slope_sd) / n
    return (jnp.sum(total * obs.weight) + bent) / n + shared


def keypoint_cost(
    body: Body, table: MarkerTable, obs: Observations, w: Weights, kinds: Kinds, state: State
) -> Float[Array, " F"]:
    """`marker_cost` of a state, in each frame."""
    x = table_positions(body, table, state.qpos, scale_multipliers(state.s), state.site_offset_m)
    return marker_cost(x, obs, state.R_nc, table, w, kinds)


def dispersion(
    body: Body, table: MarkerTable, obs: Observations, w: Weights, kinds: Kinds, state: State
) -> Float[Array, ""]:
    """Twice the keypoints' cost per observed number: what turns the cost's curvature into that of a log-likelihood."""
    seen = lambda c: jnp.sum((c > 0) * obs.weight.reshape(-1, *[1] * (c.ndim - 1)))  # noqa: E731
    numbers = 3 * seen(obs.c_3d) * kinds.camera_3d + 2 * seen(obs.c_2d) * kinds.camera_2d
    numbers += 3 * seen(obs.c_world) * kinds.world
    total = jnp.sum(keypoint_cost(body, table, obs, w, kinds, state) * obs.weight)
    return 2 * total / jnp.maximum(numbers, 1.0)


def _from_camera(x: Float[Array, "F J 3"], obs: Observations) -> Float[Array, "F V J 3"]:
    return x[:, None] - obs.p_nc[:, :, None]


def _phone_error_deg(obs: Observations, state: State) -> tuple[Float[Array, "F 3"], Float[Array, "F 3"]]:
    """Rotation vector (deg, world) from measured to fitted orientation, and d/d clock of the measured (rad/s)."""
    quats = obs.sample_quat_wxyz[obs.trial]
    at = (obs.time_s + state.clock_s[obs.trial] - obs.sample_start_s[obs.trial]) / obs.sample_step_s
    at = jnp.clip(at, 0.0, quats.shape[1] - 1.001)
    i = jnp.floor(at).astype(jnp.int32)
    take = jax.vmap(lambda q, k: q[k])
    before, after = jaxlie.SO3(take(quats, i)), jaxlie.SO3(take(quats, i + 1))
    step = (after @ before.inverse()).log()
    measured = jaxlie.SO3.exp(step * (at - i)[:, None]) @ before
    error = (jaxlie.SO3.from_matrix(state.R_nc[:, 0]) @ measured.inverse()).log()
    return jnp.rad2deg(error) * obs.has_phone[obs.trial][:, None], step / obs.sample_step_s


def normal_equations(
    body: Body, table: MarkerTable, obs: Observations, w: Weights, kinds: Kinds, state: State
) -> tuple[Arrow, Float[Array, "F Q"], Float[Array, " K"]]:
    """Curvature of `cost` times the number of frames, and its negative gradient.

    Unknowns of a frame: qpos (40) and, where the camera moves, a small rotation of it (3, world axes, from the left).
    Shared: s (8), marker offsets (3 J), clocks (N, where the camera moves), floors (3 N, where feet stand on them).
    """
    with jax.default_matmul_precision("highest"):
        n = jnp.maximum(jnp.sum(obs.weight), 1.0)
        frames = obs.weight.shape[0]
        size = next(s for s in (frames, CHUNK, CHUNK * 3 // 4) if frames % s == 0 and s <= CHUNK)
        per_frame = {f.name for f in dataclasses.fields(obs) if getattr(obs, f.name).shape[:1] == (frames,)}
        per_frame &= {"x_cam", "c_3d", "xy_px", "c_2d", "x_world", "c_world", "p_nc", "camera_matrix", "weight"}
        pieces = {k: getattr(obs, k) for k in sorted(per_frame)} | {"qpos": state.qpos, "R": state.R_nc}
        pieces = {k: v.reshape(frames // size, size, *v.shape[1:]) for k, v in pieces.items()}

        def chunk(carry, part):
            part = dict(part)
            qpos, R_nc = part.pop("qpos"), part.pop("R")
            one = dataclasses.replace(obs, **part)
            H, g, B, C, h = _marker_terms(body, table, one, w, kinds, qpos, R_nc, state)
            return (carry[0] + C, carry[1] + h), (H, g, B)

        k = 8 + state.site_offset_m.size
        start = (jnp.zeros((k, k)), jnp.zeros(k))
        if size == frames:
            (C, h), (H, g, B) = chunk(start, {k: v[0] for k, v in pieces.items()})
        else:
            (C, h), out = jax.lax.scan(chunk, start, pieces)
            H, g, B = (a.reshape(frames, *a.shape[2:]) for a in out)
        H, g, next_1, next_2 = _pose_terms(obs, w, state, H, g)
        C, h = _shared_terms(w, state, n, C, h)
        if kinds.moving:
            H, g, B, C, h = _phone_terms(obs, w, state, H, g, B, C, h)
        if kinds.contact:
            H, g, next_1, B, C, h = _contact_terms(body, obs, w, state, H, g, next_1, B, C, h)
        # Frames that count for nothing stay where they are.
        empty = (obs.weight == 0) & jnp.all(_neighbourhood(obs.bend) == 0, axis=-1)
        H = H + empty[:, None, None] * jnp.eye(H.shape[-1])
        widen = lambda a: jnp.pad(a, [(0, 0), (0, H.shape[-1] - a.shape[-1])])  # noqa: E731
    return Arrow(H, next_1 if kinds.contact else widen(next_1), widen(next_2), B, C), g, h


def _neighbourhood(bend: Float[Array, "F 3"]) -> Float[Array, "F 3"]:
    """Weights with which each frame takes part in the second differences after, at and before it."""
    none = jnp.zeros_like(bend[:1])
    after, before = jnp.concatenate([bend[1:], none]), jnp.concatenate([none, bend[:-1]])
    return jnp.stack([after[:, 0], bend[:, 1], before[:, 2]], axis=-1)


def _cross_matrix(x: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    zero = jnp.zeros_like(x[..., 0])
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return jnp.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=-1).reshape(*x.shape, 3)


def _robust(e: Float[Array, "*n D"], width: Array) -> Float[Array, "*n"]:
    """`huber_weight` of a vector."""
    return costs.huber_weight(jnp.sum(e**2, axis=-1), width)


def _times(a: Float[Array, "*m 3 3"], b: Float[Array, "*m 3 R"]) -> Float[Array, "*m 3 R"]:
    """Products of many small matrices, written out: a library would be called once for each."""
    return functools.reduce(jnp.add, [a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(3)])


def _marker_terms(body, table, obs, w, kinds, qpos, R_nc, state):
    """Blocks of the keypoint terms: H (F, Q, Q), g (F, Q), B (F, Q, K), C (K, K), h (K,)."""
    jac = marker_jacobian(body, table, qpos, scale_multipliers(state.s), state.site_offset_m)
    x, U = jac.x_world_m, jac.per_offset
    by_s = jac.per_scale @ jnp.asarray(MIXER, x.dtype)
    parts = [jac.per_qpos, by_s] if not kinds.moving else [jac.per_qpos, _cross_matrix(x), by_s]
    A = jnp.concatenate(parts, axis=-1)
    q = A.shape[-1] - 8
    count = obs.weight[:, None] / obs.n_markers
    M = jnp.zeros((*x.shape, 3), x.dtype)
    f = jnp.zeros_like(x)
    if kinds.world:
        e = 100 * (x - obs.x_world)
        c = w.weight_3d * obs.c_world * table.weight_3d * count * _robust(e, w.huber_3d_cm)
        f += 100 * c[..., None] * e
        M += 1e4 * c[..., None, None] * jnp.eye(3, dtype=x.dtype)
    if kinds.camera_2d:
        x_cam = jnp.einsum("fvji,fvmj->fvmi", R_nc, _from_camera(x, obs))
        e = costs.project_px(x_cam, obs.camera_matrix) - obs.xy_px
        D = jnp.einsum("fvmik,fvjk->fvmij", costs.project_jacobian(x_cam, obs.camera_matrix), R_nc)
        c = w.weight_2d * obs.c_2d * count[:, None] / obs.n_views * _robust(e, w.huber_2d_px)
        f += jnp.einsum("fvm,fvmij,fvmi->fmj", c, D, e)
        M += jnp.einsum("fvm,fvmik,fvmil->fmkl", c, D, D)
    centred = []
    if kinds.camera_3d:
        per_m = 100 * jnp.array([1.0, 1.0, 0.0]) + 100 * w.depth_ratio * jnp.array([0.0, 0.0, 1.0])
        for v in range(obs.c_3d.shape[1]):
            seen = jnp.where(obs.c_3d[:, v] > 0, table.weight_3d, 0.0)
            b = seen / jnp.maximum(jnp.sum(seen, axis=-1, keepdims=True), 1e-6)
            # To the camera's axes, in cm, depth at its own weight.
            T = jnp.swapaxes(R_nc[:, v], -1, -2) * per_m[:, None]
            e = jnp.einsum("fij,fmj->fmi", T, costs.center(x, seen))
            e -= costs.center(obs.x_cam[:, v], seen) * per_m
            c = w.weight_3d * obs.c_3d[:, v] * table.weight_3d * count / obs.n_views * _robust(e, w.huber_3d_cm)
            force = jnp.einsum("fm,fij,fmi->fmj", c, T, e)
            f += force - b[..., None] * jnp.sum(force, axis=1, keepdims=True)
            W = c[..., None, None] * jnp.einsum("fik,fil->fkl", T, T)[:, None]
            M += W
            centred.append((b, W))

    frames, markers = x.shape[:2]
    flat = lambda a: a.reshape(frames, markers * 3, -1)  # noqa: E731
    MA = _times(M, A)
    G = jnp.einsum("fkq,fkr->fqr", flat(A), flat(MA))
    cross = MA
    own = jnp.sum(_times(jnp.swapaxes(U, -1, -2), _times(M, U)), axis=0)
    C_oo = jnp.einsum("mij,mn->minj", own, jnp.eye(markers, dtype=x.dtype)).reshape(3 * markers, 3 * markers)
    for b, W in centred:
        mean = jnp.einsum("fm,fmiq->fiq", b, A)
        pull = jnp.sum(_times(W, A), axis=1)
        total = jnp.sum(W, axis=1)
        both = jnp.einsum("fiq,fir->fqr", pull, mean)
        G += jnp.einsum("fiq,fij,fjr->fqr", mean, total, mean) - both - jnp.swapaxes(both, -1, -2)
        loose = pull - total @ mean
        cross = cross - _times(W, mean[:, None]) - b[..., None, None] * loose[:, None]
        X = jnp.swapaxes(_times(W, U), 1, 2).reshape(frames, 3, 3 * markers)
        Y = jnp.swapaxes(b[..., None, None] * U, 1, 2).reshape(frames, 3, 3 * markers)
        one = jnp.einsum("fik,fil->kl", X - 0.5 * total @ Y, Y)
        C_oo -= one + one.T
    by_offset = _times(jnp.swapaxes(U, -1, -2), cross)
    by_offset = by_offset.reshape(frames, 3 * markers, q + 8).swapaxes(1, 2)
    C_so = jnp.sum(by_offset[:, q:], axis=0)
    C = jnp.block([[jnp.sum(G[:, q:, q:], axis=0), C_so], [C_so.T, C_oo]])
    B = jnp.concatenate([G[:, :q, q:], by_offset[:, :q]], axis=-1)
    pulled = jnp.einsum("fmiq,fmi->fq", A, f)
    h = jnp.concatenate([jnp.sum(pulled[:, q:], axis=0), jnp.einsum("fmik,fmi->mk", U, f).reshape(-1)])
    return G[:, :q, :q], -pulled[:, :q], B, C, -h


def _pose_terms(obs, w, state, H, g):
    """Limits, pose prior and second differences."""
    beyond = costs.beyond_limit_deg(state.qpos, w.low, w.high)
    per_deg = 180 / jnp.pi
    smooth = w.smooth
    bend = obs.bend
    bent = costs.second_difference(state.qpos, bend)
    around = _neighbourhood(bend)
    none = jnp.zeros_like(bent[:1])
    after, before = jnp.concatenate([bent[1:], none]), jnp.concatenate([none, bent[:-1]])
    pull = around[:, :1] * after + around[:, 1:2] * bent + around[:, 2:] * before
    own = jnp.sum(around**2, axis=-1)[:, None] * smooth
    later = jnp.concatenate([bend[1:], jnp.zeros_like(bend[:1])])
    # Frame t with t + 1: in the difference at t (weights 1, 2) and at t + 1 (weights 0, 1); with t + 2: at t + 1.
    next_1 = (bend[:, 1] * bend[:, 2] + later[:, 0] * later[:, 1])[:, None] * smooth
    next_2 = (later[:, 0] * later[:, 2])[:, None] * smooth
    weight = obs.weight[:, None]
    diagonal = weight * (w.weight_limit * (beyond != 0) * per_deg**2 + w.weight_pose * w.inverse_sd**2) + own
    force = weight * (w.weight_limit * beyond * per_deg + w.weight_pose * (state.qpos - w.neutral) * w.inverse_sd**2)
    force += smooth * pull
    extra = H.shape[-1] - diagonal.shape[-1]
    diagonal, force = (jnp.pad(a, [(0, 0), (0, extra)]) for a in (diagonal, force))
    return H + diagonal[..., None] * jnp.eye(H.shape[-1], dtype=H.dtype), g - force, next_1, next_2


def _shared_terms(w, state, n, C, h):
    """Priors of scale and marker offsets."""
    curve = jax.hessian(lambda s: costs.scale_prior(s, w.scale_sd, w.scale_sides_sd))(state.s)
    slope = curve @ state.s
    offset = 2 * n * w.weight_offset_per_m2
    C = C + jnp.diag(jnp.concatenate([jnp.zeros(8, C.dtype), jnp.full(state.site_offset_m.size, 1.0) * offset]))
    C = C.at[:8, :8].add(n * w.weight_scale * curve).at[0, 0].add(n * w.weight_size)
    slope = (w.weight_scale * slope).at[0].add(w.weight_size * state.s[0])
    force = jnp.concatenate([n * slope, offset * state.site_offset_m.reshape(-1)])
    return C, h - force


def _phone_terms(obs, w, state, H, g, B, C, h):
    """The phone's orientation: rotations of the camera (the last 3 unknowns of a frame) and the clocks."""
    error, rate = _phone_error_deg(obs, state)
    c = w.weight_phone / w.huber_phone_deg * obs.weight * obs.has_phone[obs.trial] * _robust(error, w.huber_phone_deg)
    deg = 180 / jnp.pi
    K = c[:, None, None] * deg**2 * jnp.eye(3, dtype=error.dtype)
    force = c[:, None] * error * deg
    # A frame without orientation keeps its camera: one unit of curvature is enough to hold it.
    hold = 1e6 * (1 - obs.has_phone[obs.trial])[:, None, None] * jnp.eye(3)
    H = H.at[:, -3:, -3:].add(K + hold + 1e-3 * jnp.eye(3))
    g = g.at[:, -3:].add(-force)
    trials = jax.nn.one_hot(obs.trial, obs.has_phone.shape[0], dtype=error.dtype)
    clock = -jnp.einsum("fij,fj,fn->fin", K, rate, trials)
    B = jnp.concatenate([B, jnp.zeros((*B.shape[:2], trials.shape[1])).at[:, -3:].set(clock)], axis=-1)
    corner = jnp.einsum("fi,fij,fj,fn->n", rate, K, rate, trials) + 1 / w.clock_sd_s**2
    slope = jnp.einsum("fi,fi,fn->n", rate, force, trials) - state.clock_s / w.clock_sd_s**2
    k = C.shape[0]
    C = jnp.pad(C, [(0, corner.size), (0, corner.size)]).at[k:, k:].add(jnp.diag(corner))
    return H, g, B, C, jnp.concatenate([h, slope])


def _contact_terms(body, obs, w, state, H, g, next_1, B, C, h):
    """Feet on the floor: also couples a frame's joints with the next one's, and adds the floors to what is shared."""
    dH, link, dB, dC, dg, dh = contact_terms(
        body, obs, w, scale_multipliers(state.s), jnp.asarray(MIXER, H.dtype), state
    )
    q, k, n = H.shape[-1], C.shape[0], state.floor.size
    wide = lambda a, *axes: jnp.pad(a, [(0, q - 40 if i in axes else 0) for i in range(a.ndim)])  # noqa: E731
    next_1 = wide(next_1, 1)[..., None] * jnp.eye(q, dtype=H.dtype) + wide(link, 1, 2)
    dB = wide(dB, 1)
    B = jnp.concatenate([B.at[..., :8].add(dB[..., :8]), dB[..., 8:]], axis=-1)
    C = jnp.pad(C, [(0, n), (0, n)]).at[:8, :8].add(dC[:8, :8]).at[k:, k:].set(dC[8:, 8:])
    C = C.at[:8, k:].set(dC[:8, 8:]).at[k:, :8].set(dC[8:, :8])
    h = jnp.concatenate([h.at[:8].add(-dh[:8]), -dh[8:]])
    return H + wide(dH, 1, 2), g - wide(dg, 1), next_1, B, C, h
