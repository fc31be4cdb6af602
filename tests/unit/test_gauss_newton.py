"""The algebra of the Gauss-Newton solver: structured systems, derivatives of markers and of the cost, its terms."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import (
    MarkerSet,
    chain_frames,
    load_body,
    marker_jacobian,
    marker_positions,
    marker_set,
    mjx_frames,
    scale_multipliers,
)
from pbl_pipeline.fit import CostParams, GaussNewtonParams, ViewParams, normal_equations
from pbl_pipeline.fit.depth_term import LDEPTH, SURFACE
from pbl_pipeline.fit.feet_terms import later, residual_floor_cm, residual_slide_cm, slide_contact
from pbl_pipeline.fit.imu_term import LIMU, WEARING, segments_at
from pbl_pipeline.fit.joint_terms import bent, beyond_limit_deg, three_frames
from pbl_pipeline.fit.keypoint_terms import (
    in_camera,
    project_px,
    residual_2d_px,
)
from pbl_pipeline.fit.lanes import begin_of, finish, fit_problem
from pbl_pipeline.fit.linearised import linearised
from pbl_pipeline.fit.normal_equations import linearise, moved
from pbl_pipeline.fit.objective import TERMS, total
from pbl_pipeline.fit.per_frame import limits_of, standing, start_of
from pbl_pipeline.fit.phone_term import measured_orientation, phone_at, residual_phone_deg
from pbl_pipeline.fit.problem import (
    SAMPLE_S,
    Depths,
    State,
    Surface,
    TrialArrays,
    Wearables,
    Wearing,
    bend_weights,
    pack,
    point_table,
)
from pbl_pipeline.fit.session import Session, make_session
from pbl_pipeline.fit.solvers import linear
from pbl_pipeline.fit.solvers.gauss_newton import LevenbergMarquardt, Limits
from pbl_pipeline.fit.solvers.linear import BorderedBandedSystem, marginal_variance, solve
from pbl_pipeline.fit.solvers.result import Result
from pbl_pipeline.fit.term import At, Term, Unknowns
from pbl_pipeline.fit.weights import Weights
from research.walker.observe import observe
from research.walker.views import observe_markers, observe_views
from research.walker.walk import walk_qpos

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("little_optimised")]

TIME_S = np.arange(24) / 30


def few_markers() -> MarkerSet:
    """20 of the 87 points, one of which tells no 3D position."""
    full = marker_set("bml_movi_87")
    keep = np.linspace(0, len(full) - 1, 20).astype(int)
    weight = full.weight_3d[keep].copy()
    weight[3] = 0.0
    return MarkerSet(
        name="few",
        names=tuple(full.names[i] for i in keep),
        body_names=tuple(full.body_names[i] for i in keep),
        body_index=full.body_index[keep],
        position_m=full.position_m[keep],
        weight_3d=weight,
    )


# --- the structured system ---


def random_system(
    frames: int, rng: np.random.Generator, q: int = 5, k: int = 4
) -> tuple[BorderedBandedSystem, np.ndarray]:
    """A positive definite system and the same matrix in full."""
    rows = rng.normal(size=(frames, q, q))
    diagonal = rows @ rows.swapaxes(1, 2) + 8 * np.eye(q)
    next_1, next_2 = 0.5 * rng.normal(size=(frames, q, q)), rng.normal(size=(frames, q))
    next_1[-1:], next_2[-2:] = 0, 0
    border = rng.normal(size=(frames, q, k))
    corner = rng.normal(size=(k, k))
    corner = corner @ corner.T + (q * frames + 5) * np.eye(k)
    full = np.zeros((frames * q + k,) * 2)
    for t in range(frames):
        at = slice(t * q, (t + 1) * q)
        full[at, at] = diagonal[t]
        full[at, -k:] = border[t]
        full[-k:, at] = border[t].T
        for step, link in ((1, next_1[t]), (2, np.diag(next_2[t]))):
            if t + step < frames:
                to = slice((t + step) * q, (t + step + 1) * q)
                full[at, to], full[to, at] = link, link.T
    full[-k:, -k:] = corner
    assert np.linalg.eigvalsh(full)[0] > 0.05
    return BorderedBandedSystem(
        *(jnp.asarray(a, jnp.float32) for a in (diagonal, next_1, next_2, border, corner))
    ), full


def solution_and_variance(system, g, h):
    """Both in one program, which compiles what they share once."""
    return *solve(system, g, h), *marginal_variance(system)


def right_side(rng: np.random.Generator, *shape: int, k: int = 4) -> tuple[jax.Array, jax.Array]:
    g, h = rng.normal(size=(*shape, 5)), rng.normal(size=(*shape[:-1], k))
    return jnp.asarray(g, jnp.float32), jnp.asarray(h, jnp.float32)


def assert_solved(full: np.ndarray, g, h, x, y, by_frame, shared) -> None:
    """The solution and the variances are those of the full matrix."""
    want = np.linalg.solve(full, np.concatenate([np.ravel(g), h]))
    np.testing.assert_allclose(np.concatenate([np.ravel(x), y]), want, atol=2e-5 * np.abs(want).max())
    variance = np.diag(np.linalg.inv(full))
    np.testing.assert_allclose(np.concatenate([np.ravel(by_frame), shared]), variance, rtol=1e-4)


@pytest.mark.parametrize(
    ("frames", "chain"), [(2, 1), (6, 1), (10, 1), (24, 1), (14, 2), (24, 3), (2, 99), (14, 99), (24, 99)]
)
def test_a_bordered_system_is_solved_as_the_full_matrix(frames, chain, monkeypatch):
    monkeypatch.setitem(linear.CHAIN, jax.default_backend(), chain)
    rng = np.random.default_rng(frames)
    system, full = random_system(frames, rng)
    side = right_side(rng, frames)
    assert_solved(full, *side, *jax.jit(solution_and_variance)(system, *side))


@pytest.mark.parametrize(("k", "columns"), [(4, 3), (4, 32), (6, 3)])
def test_a_large_border_by_columns_gives_the_same(k, columns, monkeypatch):
    rng = np.random.default_rng(k)
    system, full = random_system(10, rng, k=k)
    side = right_side(rng, 10, k=k)
    monkeypatch.setattr(linear, "LARGE_BORDER", 0)
    monkeypatch.setattr(linear, "COLUMNS", columns)
    assert_solved(full, *side, *solution_and_variance(system, *side))


class Model(NamedTuple):
    cost: jax.Array
    system: BorderedBandedSystem
    g: jax.Array
    h: jax.Array


@pytest.mark.parametrize("over", [4.0, 0.5])
def test_a_curvature_that_is_wrong_neither_creeps_nor_swings(over):
    """One of two frames has `over` times its own curvature: plain steps leave 3/4 of the way, or as much behind."""
    factor = jnp.array([[1.0], [over]])

    def evaluate(state):
        x, y = state
        none = jnp.zeros((2, 1, 1))
        system = BorderedBandedSystem(jnp.asarray(factor)[..., None], none, jnp.zeros((2, 1)), none, jnp.eye(1))
        return Model(1.0 + 0.5 * jnp.sum(x**2) + 0.5 * jnp.sum(y**2), system, -x, -y)

    def move(state, dx, dy):
        return state[0] + dx, state[1] + dy

    start = jnp.array([[0.1], [0.1]]), jnp.zeros(1)
    limits = Limits(jnp.asarray(1e-5), jnp.asarray(-1.0), jnp.asarray(50))
    solver = LevenbergMarquardt(evaluate, move, jnp.ones(2))
    end = solver.iterate(solver.init(start), limits)
    assert int(end.result) == Result.SMALL_STEP
    assert int(end.iteration) <= 15
    assert float(jnp.max(jnp.abs(end.state[0]))) < 1e-4


def test_many_systems_at_once():
    rng = np.random.default_rng(7)
    systems, fulls = zip(*[random_system(6, rng) for _ in range(3)], strict=True)
    many = jax.tree.map(lambda *a: jnp.stack(a), *systems)
    side = right_side(rng, 3, 6)
    found = jax.jit(jax.vmap(solution_and_variance))(many, *side)
    for full, *one in zip(fulls, *side, *found, strict=True):
        assert_solved(full, *one)


# --- markers and their derivatives ---


def random_body_state(rng: np.random.Generator, poses: int, markers: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    body = load_body()
    low, high = (np.clip(a, -2.5, 2.5) for a in np.asarray(body.joint_range_rad).T)
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    qpos = rng.uniform(low, high, (poses, len(low)))
    return f32(qpos), f32(rng.uniform(0.8, 1.25, 8)), f32(rng.normal(0, 0.02, (markers, 3)))


def test_derivatives_of_markers_are_those_of_automatic_differentiation():
    body = load_body()
    table = point_table(body, few_markers(), 24)
    n = len(table.body_index)
    qpos, scale, offset = random_body_state(np.random.default_rng(1), 5, n)
    ours = jax.jit(marker_jacobian, static_argnames="body")(body, table, qpos, scale, offset)
    plain = marker_positions(body, few_markers(), qpos, scale, offset[:20])
    np.testing.assert_allclose(ours.x_world_m[:, :20], plain, atol=1e-5)

    def one(q, s, o):
        return marker_positions(body, table, q, s, o)

    by_q, by_s, by_o = jax.jit(jax.vmap(jax.jacfwd(one, (0, 1, 2)), (0, None, None)))(qpos, scale, offset)
    np.testing.assert_allclose(ours.per_qpos, by_q, atol=1e-5)
    np.testing.assert_allclose(ours.per_scale, by_s, atol=1e-5)
    own = np.einsum("tmimj->tmij", by_o)
    np.testing.assert_allclose(ours.per_offset, own, atol=1e-5)
    assert np.count_nonzero(np.abs(by_o) > 1e-6) == np.count_nonzero(np.abs(own) > 1e-6)  # a marker moves itself alone


# --- the gradient of the cost ---

#: Every term counts, most with a weight that no paramset has.
PARAMS = GaussNewtonParams(
    smooth_per_rad2=300.0,
    weight_limit_per_deg2=0.2,
    clock_sd_s=0.05,
    weight_floor=0.05,
    weight_slide=0.2,
    slope_sd_deg=4.0,
    view=ViewParams(min_in_view_s=0.5, min_confidence=0.1),
    cost=CostParams(
        weight_3d=0.7,
        weight_2d=0.3,
        depth_ratio=0.6,
        huber_3d_cm=4.0,
        weight_pose=0.3,
        pose_prior_deg=(("hip_rotation", 3.0, 8.0), ("knee_angle", -5.0, 20.0), ("arm_flex", 0.0, 20.0)),
        pose_prior="people",
        weight_scale=0.4,
    ),
    weight_detector=0.2,
)


@pytest.mark.long
def test_the_markers_are_the_same_by_mjx_forward_and_reverse():
    body, markers = load_body(), few_markers()
    rng = np.random.default_rng(8)
    at = random_body_state(rng, 5, 20)
    pull = jnp.asarray(rng.normal(size=(5, 20, 3)), jnp.float32)

    def both(forward):
        x, back = jax.vjp(lambda *a: marker_positions(body, markers, *a, forward=forward), *at)
        return x, *back(pull)

    for ours, theirs in zip(jax.jit(lambda: both(chain_frames))(), jax.jit(lambda: both(mjx_frames))(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5 * float(jnp.abs(theirs).max()))


def small_session(kind: str) -> Session:
    """Two trials of 24 frames each."""
    few, trials, motion = few_markers(), [], "handheld" if "moving" in kind else "static"
    for seed in (0, 1):
        qpos = walk_qpos(TIME_S, seed)
        if kind == "world":
            trials.append(observe_markers(qpos, TIME_S, marker_set=few, noise_m=0.02, seed=seed))
        elif kind == "views":
            trials.append(observe_views(qpos, TIME_S, n_views=2, marker_set=few, seed=seed, with_3d=True))
        else:
            trials.append(observe(qpos, TIME_S, marker_set=few, seed=seed, camera_motion=motion).keypoints)
    session = make_session(trials, ["a", "b"], PARAMS, [motion] * 2, few)
    if "pelvis" in kind:
        p, rng = session.problem, np.random.default_rng(6)
        tilt, known = jnp.asarray(rng.normal(0, 0.3, p.pelvis.shape)), jnp.asarray(rng.integers(0, 2, len(p.c_pelvis)))
        session = dataclasses.replace(session, problem=dataclasses.replace(p, pelvis=tilt, c_pelvis=known))
    if "floor" in kind:
        p = session.problem
        seen = jnp.asarray(np.random.default_rng(5).random(p.contact.shape) * p.weight[:, None])
        session = dataclasses.replace(session, problem=dataclasses.replace(p, contact=seen))
    if "sensors" in kind:
        session = dataclasses.replace(
            session, problem=dataclasses.replace(session.problem, wearables=wearables(session))
        )
    if "depths" in kind:
        session = dataclasses.replace(session, problem=dataclasses.replace(session.problem, depths=depths(session)))
    return session


def depths(session: Session) -> Depths:
    """Depths of anything at some markers, some of them far off."""
    rng, p = np.random.default_rng(13), session.problem
    shape = len(p.weight), len(p.weight_3d)
    count = (rng.random(shape) < 0.3) * p.weight[:, None]
    values = {
        "depth_m": rng.normal(4, 0.1, shape),
        "count": count,
        "skin_m": rng.normal(-0.05, 0.02, shape),
        "offset_sd_m": np.full(shape[1], 0.02),
        "dispersion": 0.3,
    }
    return Depths(**{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})


def wearables(session: Session) -> Wearables:
    """Sensors on the pelvis and a shank that measured anything, in all frames but a few."""
    rng, p = np.random.default_rng(12), session.problem
    frames, trials = len(p.weight), len(p.has_phone)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (trials * 2, 256, 3)), axis=1).reshape(-1, 3))
    quats = lambda *n: Rotation.random(int(np.prod(n)), rng).as_quat(scalar_first=True).reshape(*n, 4)  # noqa: E731
    count = (rng.random((frames, 2)) < 0.9) * p.weight[:, None]
    values = {
        "body_index": [session.body.body_names.index(n) for n in ("pelvis", "tibia_l")],
        "quat_wxyz": turns.as_quat(scalar_first=True).reshape(trials, 2, 256, 4),
        "turned": rng.normal(size=(frames, 2, 3, 3)),
        "count": count,
        "follows": 0.8 * count * np.roll(count, -1, axis=0) * (np.diff(p.trial, append=-1) == 0)[:, None],
        "mount": quats(2),
        "world": quats(trials, 2),
        "mount_sd_deg": [20.0, 3.0],
        "sd_rad": [0.3, 0.5],
        "bias_sd_rad_s": [0.02, 0.05],
        "level_sd_rad": np.full((trials, 2), 0.1),
        "tilt_sd_rad": np.linspace(0, 0.2, trials),
        "middle_s": np.full(trials, 0.4),
        "clock_s": np.zeros(trials),
        "dispersion": 0.3,
    }
    index = values.pop("body_index")
    return Wearables(jnp.asarray(index), **{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})


def away(session: Session, seed: int = 3, detector: bool = False) -> State:
    """A state away from the start in every unknown, some joints beyond their limits."""
    rng, state = np.random.default_rng(seed), start_of(session)
    d, markers = len(state.floor) * detector, len(state.site_offset_m)
    turn = Rotation.from_rotvec(rng.normal(0, 0.01, (len(state.qpos), 3))).as_matrix()
    noise = lambda a, sd: jnp.asarray(a + rng.normal(0, sd, a.shape), jnp.float32)  # noqa: E731
    turned = jnp.asarray(np.einsum("fij,fvjk->fvik", turn, state.R_nc), jnp.float32)
    return State(
        qpos=noise(state.qpos, 0.15),
        R_nc=turned if session.problem.moving else state.R_nc,
        s=noise(state.s, 0.05),
        site_offset_m=noise(state.site_offset_m, 0.01) * (np.arange(len(state.site_offset_m)) < 20)[:, None],
        clock_s=noise(state.clock_s, 0.02) + 0.003,
        floor=noise(state.floor - np.array([1.2, 0.0, 0.0]), 0.03),
        lean=noise(np.zeros((d, 3)), 0.1),
        depth_m=noise(np.zeros((d, markers)), 0.05),
        wearing=None if session.problem.wearables is None else wearing(session, rng),
        surface=None
        if session.problem.depths is None
        else Surface(noise(np.zeros(markers), 0.02), jnp.asarray(1.03, jnp.float32)),
    )


def wearing(session: Session, rng: np.random.Generator) -> Wearing:
    n = len(session.problem.has_phone)
    at = lambda sd, *shape: jnp.asarray(rng.normal(0, sd, shape), jnp.float32)  # noqa: E731
    return Wearing(at(0.1, 2, 3), at(0.1, n, 2, 3), at(0.02, 2, 3), at(0.02, n, 2))


def at_state(session: Session, w: Weights, state: State) -> At:
    """Arguments of the terms at a state, without the normal equations."""
    p, scale = session.problem, scale_multipliers(state.s)
    x = marker_positions(session.body, p.points, state.qpos, scale, p.point_offsets(state.site_offset_m))
    markers, soles, _ = p.split(x)
    return At(p, w, state, markers, soles, phone_at(p, state), segments_at(session.body, p, state))


@pytest.mark.parametrize(
    "kind",
    [
        "views",
        "world",
        "floor pelvis",
        "moving floor",
        "moving detector",
        "moving sensors",
        "detector sensors depths",
        "moving depths",
    ],
)
def test_normal_equations_hold_the_gradient_of_the_cost(kind):
    session, detector = small_session(kind), "detector" in kind
    params = dataclasses.replace(PARAMS, weight_pelvis=0.5) if "pelvis" in kind else PARAMS
    p, w, state = session.problem, Weights.of(session.body, params), away(session, detector=detector)
    assert p.moving == ("moving" in kind)
    n = float(jnp.sum(p.weight))
    assert 30 < n < len(p.weight)  # and padding

    def parts(h):
        """The fields of `Wearing` among the last of the shared unknowns."""
        sizes = [a.size for a in jax.tree.leaves(state.wearing)]
        return np.split(np.asarray(h)[-sum(sizes) :], np.cumsum(sizes)[:-1])

    def changed(dx, dy):
        return n * total(at_state(session, w, moved(state, dx, dy)))

    at = jax.jit(lambda s: linearise(session.body, p, w, s))(state)
    value, (want_g, want_h) = jax.jit(jax.value_and_grad(changed, (0, 1)))(jnp.zeros_like(at.g), jnp.zeros_like(at.h))
    assert float(at.cost) == pytest.approx(float(value) / n, rel=1e-5)
    k = 8 + state.site_offset_m.size
    pairs = {
        "qpos": (at.g[:, :40], want_g[:, :40]),
        "s": (at.h[:8], want_h[:8]),
        "offset": (at.h[8:k], want_h[8:k]),
    }
    if p.moving:
        pairs |= {"turn": (at.g[:, 40:], want_g[:, 40:]), "clock": (at.h[k : k + 2], want_h[k : k + 2])}
        k += 2
    pairs["floor"] = (at.h[k : k + 6], want_h[k : k + 6])
    if state.surface is not None:
        end = -state.surface.offset_m.size - 1
        pairs |= {"skin": (at.h[end:-1], want_h[end:-1]), "metre": (at.h[-1:], want_h[-1:])}
        at, want_h = dataclasses.replace(at, h=at.h[:end]), want_h[:end]
    if state.wearing is not None:
        end = -sum(a.size for a in jax.tree.leaves(state.wearing))
        pairs |= {
            f.name: (a, b) for f, a, b in zip(dataclasses.fields(Wearing), parts(at.h), parts(want_h), strict=True)
        }
        at, want_h = dataclasses.replace(at, h=at.h[:end]), want_h[:end]
    if detector:
        own, want = (h[k + 6 :].reshape(2, -1) for h in (at.h, want_h))
        pairs |= {"lean": (own[:, :3], want[:, :3]), "depth": (own[:, 3:], want[:, 3:])}
    for name, (ours, want) in pairs.items():
        most = np.abs(want).max()
        assert most > (0.1 if name != "floor" or "floor" in kind else 1e-4), name
        np.testing.assert_allclose(-np.asarray(ours), want, atol=1e-3 * most, rtol=1e-3, err_msg=name)
    corner, diagonal = np.asarray(at.system.corner, np.float64), at.system.diagonal
    assert np.all(np.linalg.eigvalsh(corner) > -1e-3 * np.abs(corner).max())
    np.testing.assert_allclose(diagonal, np.swapaxes(diagonal, 1, 2), atol=1e-3 * np.abs(at.g).max())


@pytest.mark.parametrize("kind", ["floor detector", "moving"])
def test_a_fit_without_sensors_and_depths_is_the_same_program_as_without_their_terms(kind, monkeypatch):
    """Equal programs have equal results, to the last bit."""
    session = small_session(kind)
    p, state = session.problem, away(session, detector="detector" in kind)
    w = Weights.of(session.body, PARAMS)

    def program() -> str:
        return jax.jit(lambda p, s: linearise(session.body, p, w, s)).lower(p, state).as_text()

    whole, known = program(), {LIMU, WEARING, LDEPTH, SURFACE}
    assert known < set(normal_equations.TERMS)
    monkeypatch.setattr(normal_equations, "TERMS", tuple(t for t in normal_equations.TERMS if t not in known))
    assert program() == whole


def test_curvature_of_the_detectors_depths_is_the_change_of_the_gradient():
    """Residuals are linear in the depths where no robust cost bends them, so both agree whatever the step."""
    session = small_session("static")
    cost = dataclasses.replace(PARAMS.cost, huber_3d_cm=1e6)
    w, p = Weights.of(session.body, dataclasses.replace(PARAMS, cost=cost)), session.problem
    state = away(session, detector=True)
    step = np.random.default_rng(9).normal(0, 0.05, state.depth_m.shape)
    linear = jax.jit(lambda s: linearise(session.body, p, w, s))
    one, other = (
        linear(state),
        linear(dataclasses.replace(state, depth_m=state.depth_m + jnp.asarray(step, jnp.float32))),
    )
    unknown = np.zeros(one.h.shape)
    unknown[-2 * (3 + step.shape[1]) :].reshape(2, -1)[:, 3:] = step
    for before, after, rows in ((one.g, other.g, one.system.border), (one.h, other.h, one.system.corner)):
        want = np.asarray(before, np.float64) - np.asarray(rows, np.float64) @ unknown
        np.testing.assert_allclose(after, want, atol=2e-4 * np.abs(want).max(), rtol=1e-3)


def test_curvature_of_the_soles_is_that_of_their_residuals():
    """v' H v of what they add to the matrix against the residuals' change along v (Gauss-Newton, no robust weights)."""
    session = small_session("floor")
    params = dataclasses.replace(PARAMS, huber_floor_cm=1e6, huber_slide_cm=1e6)
    w, state, p = Weights.of(session.body, params), away(session), session.problem
    without = Weights.of(session.body, dataclasses.replace(params, weight_floor=0.0, weight_slide=0.0))
    linear = jax.jit(lambda w: linearise(session.body, p, w, state))
    system = [linear(w).system for w in (w, without)]
    own = jax.tree.map(lambda a, b: np.asarray(a - b, np.float64), *system)

    def residuals(qpos, s, floor):
        offsets = p.point_offsets(state.site_offset_m)
        x = p.split(marker_positions(session.body, p.points, qpos, scale_multipliers(s), offsets))[1]
        height = residual_floor_cm(x, floor[p.trial][:, None])
        slide = residual_slide_cm(x, later(x), p.rate[:, None])
        return (
            jnp.sqrt(p.weight[:, None] * p.contact * w["weight_floor"])[..., None] * height,
            jnp.sqrt(p.weight[:, None] * slide_contact(p) * w["weight_slide"])[..., None] * slide,
        )

    rng = np.random.default_rng(6)
    v = [rng.normal(size=np.shape(a)).astype(np.float32) for a in (state.qpos, state.s, state.floor)]
    _, change = jax.jit(lambda *v: jax.jvp(residuals, (state.qpos, state.s, state.floor), v))(*v)
    want = sum(float(jnp.sum(c**2)) for c in change)
    q, y = v[0].astype(float), np.zeros(own.corner.shape[0])
    y[:8], y[-6:] = v[1], v[2].ravel()
    got = np.einsum("fa,fab,fb", q, own.diagonal, q) + 2 * np.einsum("fa,fab,fb", q[:-1], own.next_1[:-1], q[1:])
    got += 2 * np.einsum("fa,fak,k", q, own.border, y) + y @ own.corner @ y
    assert got == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize("pelvis", [False, True])
def test_what_is_made_by_hand_is_what_follows_from_the_term(pelvis):
    """Force and curvature by hand against those of the linearised residuals, where a body has a pelvis that inclines
    and where it has none."""
    session = small_session("pelvis")
    prior = dataclasses.replace(PARAMS.cost, pose_prior="people-3" if pelvis else "")
    w, state = Weights.of(session.body, dataclasses.replace(PARAMS, cost=prior)), away(session)
    assert (w.pelvis.shape[0] > 0) == pelvis
    (term,) = [t for t in TERMS if isinstance(t, Term) and t.by_hand]
    assert (term.name, term.unknowns) == ("pose prior", Unknowns.JOINTS)

    def both(state: State):
        at = at_state(session, w, state)
        return term.by_hand(at), term.rows(at)[:3]  # pyright: ignore[reportOptionalCall]

    by_hand, (c, r, D) = jax.jit(both)(state)
    want = np.einsum("fcpq,fc,fcp->fq", D, c, r), np.einsum("fcpq,fc,fcpr->fqr", D, c, D)
    for ours, other in zip(by_hand, want, strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-4 * np.abs(other).max())


def test_soles_that_stand():
    """Still for half a second, then swung at 3 m/s; another never moves, a third moves all the time."""
    time_s = np.arange(60) / 60
    x = np.zeros((60, 3, 3))
    x[30:, 0, 0] = 3 * (time_s[30:] - time_s[30])
    x[:, 2, 0] = 3 * time_s
    stands = standing(time_s, x)
    assert stands[:25, 0].min() > 0.9
    assert stands[35:, 0].max() < 0.1
    assert stands[:, 1].min() > 0.9
    assert stands[5:-5, 2].max() < 0.1


# --- the terms by hand ---


def test_beyond_a_limit_by_hand():
    q = jnp.deg2rad(jnp.array([[-12.0, 0.0, 33.0], [-10.0, 5.0, 30.0]]))
    low, high = jnp.deg2rad(jnp.array([-10.0, -10, -10])), jnp.deg2rad(jnp.array([30.0, 30, 30]))
    np.testing.assert_allclose(beyond_limit_deg(q, low, high), [[-2, 0, 3], [0, 0, 0]], atol=1e-5)


def test_second_difference_of_a_parabola_with_uneven_time_stamps():
    time_s = np.array([0.0, 0.03, 0.05, 0.09, 0.10, 0.16, 0.20])
    used = np.ones(7, bool)
    bend = bend_weights(time_s, used)
    assert np.all(bend[[0, -1]] == 0)
    q = jnp.asarray(np.stack([3 + 2 * time_s - 4.5 * time_s**2, 7 - time_s], axis=1), jnp.float32)
    # The second derivative, -9 per s^2, for a step of 1/30 s; none of a straight line.
    want = np.zeros((7, 2))
    want[1:-1, 0] = -9 / 900
    np.testing.assert_allclose(bent(three_frames(q), jnp.asarray(bend, jnp.float32)), want, atol=2e-5)
    even = bend_weights(np.arange(5) / 30, np.ones(5, bool))
    np.testing.assert_allclose(even[1:-1], [[1, -2, 1]] * 3, atol=1e-9)


def test_second_differences_span_gaps_and_end_with_the_frames_that_count():
    used = np.array([0, 1, 1, 0, 0, 1, 1, 0], bool)
    assert np.flatnonzero(bend_weights(np.arange(8) / 30, used).any(axis=1)).tolist() == [2, 3, 4, 5]
    assert not bend_weights(np.arange(8) / 30, np.zeros(8, bool)).any()


def test_distance_in_pixels_of_a_moved_and_turned_camera():
    # 90 deg about world z: the camera's right is world +x, its forward world +y.
    R = jnp.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    K = jnp.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    x = in_camera(jnp.array([[[1.0, 5.0, 0.5]]]), R[None, None], jnp.array([[[0.0, 1.0, 0.0]]]))
    # Ahead by 4 m, right by 1 m, up by 0.5 m: 250 px right and 125 px up of the middle.
    np.testing.assert_allclose(residual_2d_px(x, jnp.array([[753.0, 271.0]]), K)[0, 0], [[-3, 4]], rtol=1e-3)


def test_derivatives_of_residuals_are_their_own_also_near_and_behind_the_camera():
    K = jnp.array([[900.0, 0, 500], [0, 1100, 400], [0, 0, 1]])
    x = jnp.array([[0.3, -0.2, 4.0], [0.3, 0.1, 0.12], [-0.1, 0.2, -0.05]])
    want = jax.vmap(jax.jacfwd(lambda p: project_px(p[None], K)[0]))(x)
    value, got = linearised(lambda p: project_px(p, K), x)
    np.testing.assert_allclose(value, project_px(x, K))
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-2)


def test_phone_error_by_hand():
    """A phone that turns by 40 deg/s about z, a fitted camera that is 1.5 deg further, a clock that is 25 ms late."""
    p = small_session("moving").problem
    at_s = float(p.sample_start_s[0]) + SAMPLE_S * np.arange(p.sample_quat_wxyz.shape[1])
    z = np.array([0.0, 0, 1])
    quat = Rotation.from_rotvec(np.deg2rad(40 * at_s)[:, None] * z).as_quat(scalar_first=True)
    p = dataclasses.replace(
        p, sample_quat_wxyz=jnp.asarray(np.broadcast_to(quat, p.sample_quat_wxyz.shape), jnp.float32)
    )
    p = jax.tree.map(jnp.asarray, p)
    camera = Rotation.from_rotvec(np.deg2rad(40 * np.asarray(p.time_s) + 1.5)[:, None] * z).as_matrix()
    fitted, clock_s = jaxlie.SO3.from_matrix(jnp.asarray(camera, jnp.float32)), jnp.array([0.025, 0.0])[p.trial]
    error, rate = linearised(
        lambda t: residual_phone_deg(fitted, measured_orientation(p, clock_s + t[:, 0])), jnp.zeros((len(clock_s), 1))
    )
    np.testing.assert_allclose(error, (1.5 - 40 * np.asarray(clock_s))[:, None] * z, atol=2e-3)
    np.testing.assert_allclose(rate[..., 0], -40 * np.broadcast_to(z, error.shape), atol=0.06)


# --- another body ---

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <custom>
    <text name="version" data="1"/>
    <text name="scale_group/overall" data="*"/>
    <text name="scale_group/forearm" data="hand"/>
  </custom>
  <worldbody>
    <body name="base" pos="4 0 0">
      <joint name="along" type="slide" axis="0 1 0"/>
      <joint name="lift" type="hinge" axis="0 1 0" range="-1 1" limited="true"/>
      <geom size="0.01"/>
      <body name="hand" pos="0 0 0.4">
        <joint name="bend" type="hinge" axis="1 0 0"/>
        <geom size="0.01"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_body_of_three_joints_goes_through_the_same_code(tmp_path):
    """Other joints, other scale groups, no feet: its movement and the size of its forearm are found again."""
    (tmp_path / "arm.xml").write_text(ARM)
    body = load_body(tmp_path / "arm.xml")
    assert body.joint_names == ("along", "lift", "bend")
    assert body.scale_names == ("overall", "forearm")
    t = np.arange(40) / 30
    truth = np.stack([0.3 * np.sin(2 * t), 0.5 * np.cos(3 * t), 0.8 * np.sin(4 * t)], axis=1)
    places = np.array([[0, 0.1, 0], [0, -0.1, 0.1], [0.1, 0, 0.2], [0, 0.05, 0.1], [0.05, 0, 0.2], [-0.05, -0.05, 0.3]])
    markers = MarkerSet(
        name="arm",
        names=tuple("abcdef"),
        body_names=("base",) * 3 + ("hand",) * 3,
        body_index=np.array([0, 0, 0, 1, 1, 1]),
        position_m=places,
        weight_3d=np.ones(6),
    )
    scale = np.array([1.0, 1.2])
    x = np.asarray(marker_positions(body, markers, truth, scale, np.zeros((6, 3))))
    trial = TrialArrays(
        time_s=t,
        used=np.ones(40, bool),
        x_cam=np.zeros((40, 0, 6, 3)),
        c_3d=np.zeros((40, 0, 6)),
        xy_px=np.zeros((40, 0, 6, 2)),
        c_2d=np.zeros((40, 0, 6)),
        x_world=x,
        c_world=np.ones((40, 6)),
        R_nc=np.zeros((40, 0, 3, 3)),
        p_nc=np.zeros((40, 0, 3)),
        camera_matrix=np.zeros((40, 0, 3, 3)),
        pixel_px=np.zeros((40, 0)),
    )
    p = jax.tree.map(jnp.asarray, pack([trial], body, markers))
    params = GaussNewtonParams(smooth_per_rad2=0.01, smooth_per_m2=0.01, cost=CostParams(weight_offset_per_m2=1e6))
    frames, n_markers = len(p.weight), len(p.weight_3d)
    start = State(
        qpos=jnp.zeros((frames, 3)),
        R_nc=p.R_nc,
        s=jnp.zeros(2),
        site_offset_m=jnp.zeros((n_markers, 3)),
        clock_s=jnp.zeros(1),
        floor=jnp.zeros((1, 3)),
    )
    w, limits = Weights.of(body, params), limits_of(params)
    solve = jax.jit(fit_problem, static_argnames="body")
    begin = jax.jit(begin_of, static_argnames="body")(body, p, w, start)
    end = solve(body, p, w, begin, limits)
    assert int(end.result) in (Result.SMALL_STEP, Result.SMALL_GAIN)
    # One iteration a call, as where a bar is drawn, takes the same steps.
    at = begin
    for n in range(int(end.iteration) + 1):
        assert int(at.result) == Result.MAX_STEPS_REACHED
        at = solve(body, p, w, at, dataclasses.replace(limits, iterations=jnp.asarray(n, jnp.int32)))
    assert int(at.result) == int(end.result)
    jax.tree.map(np.testing.assert_array_equal, at, end)
    np.testing.assert_allclose(end.state.qpos[:40], truth, atol=5e-3)
    np.testing.assert_allclose(scale_multipliers(end.state.s), scale, atol=5e-3)
    variance, seen = finish(p, end.latest, end.state.R_nc)
    assert variance.shape == (frames, 3)
    assert float(np.nanmax(seen.residual_3d_m[:40, :6])) < 5e-3
