"""The algebra of the Gauss-Newton solver: structured systems, derivatives of markers and of the cost, its terms."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import MarkerSet, body_poses, load_body, marker_positions, marker_set
from pbl_pipeline.body._jacobian import MarkerTable, marker_jacobian, table_positions
from pbl_pipeline.body._kinematics import scaled_body_pos
from pbl_pipeline.fit import CostParams, GaussNewtonParams, ViewParams
from pbl_pipeline.fit._costs import (
    beyond_limit_deg,
    distance_2d_px2,
    distance_3d_cm2,
    project_jacobian,
    project_px,
    second_difference,
)
from pbl_pipeline.fit._inputs import Session, make_session
from pbl_pipeline.fit._observations import SAMPLE_S, bend_weights
from pbl_pipeline.fit.solvers import _arrow
from pbl_pipeline.fit.solvers._arrow import Arrow, marginal_variance, solve
from pbl_pipeline.fit.solvers._contact import _height_cm, _way_cm, sole_positions, standing
from pbl_pipeline.fit.solvers._normal import State, _phone_error_deg, cost, normal_equations, scale_multipliers
from pbl_pipeline.fit.solvers.gauss_newton import kinds_of, start_of, weights_of
from pbl_pipeline.synthetic import observe, observe_markers, observe_views, walk_qpos

pytestmark = pytest.mark.slow

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


def random_arrow(frames: int, rng: np.random.Generator, q: int = 5, k: int = 4) -> tuple[Arrow, np.ndarray]:
    """A positive definite arrow and the same matrix in full."""
    rows = rng.normal(size=(frames, q, q))
    diagonal = rows @ rows.swapaxes(1, 2) + 8 * np.eye(q)
    next_1, next_2 = rng.normal(size=(2, frames, q))
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
        for step, link in ((1, next_1), (2, next_2)):
            if t + step < frames:
                to = slice((t + step) * q, (t + step + 1) * q)
                full[at, to] = full[to, at] = np.diag(link[t])
    full[-k:, -k:] = corner
    assert np.linalg.eigvalsh(full)[0] > 0.05
    return Arrow(*(jnp.asarray(a, jnp.float32) for a in (diagonal, next_1, next_2, border, corner))), full


def solution_and_variance(arrow, g, h):
    """Both in one program, which compiles what they share once."""
    return solve(arrow, g, h), marginal_variance(arrow)


@pytest.mark.parametrize("frames", [2, 4, 6, 10, 14, 24])
def test_the_arrow_is_solved_as_the_full_matrix(frames):
    rng = np.random.default_rng(frames)
    arrow, full = random_arrow(frames, rng)
    g, h = rng.normal(size=(frames, 5)), rng.normal(size=4)
    (x, y), (by_frame, shared) = jax.jit(solution_and_variance)(
        arrow, jnp.asarray(g, jnp.float32), jnp.asarray(h, jnp.float32)
    )
    want = np.linalg.solve(full, np.concatenate([g.ravel(), h]))
    np.testing.assert_allclose(np.concatenate([np.ravel(x), y]), want, atol=2e-5 * np.abs(want).max())
    variance = np.diag(np.linalg.inv(full))
    np.testing.assert_allclose(np.concatenate([np.ravel(by_frame), shared]), variance, rtol=1e-4)


@pytest.mark.parametrize(("k", "columns"), [(4, 3), (4, 32), (6, 3)])
def test_a_large_border_by_columns_gives_the_same(k, columns, monkeypatch):
    rng = np.random.default_rng(k)
    arrow, full = random_arrow(10, rng, k=k)
    g, h = rng.normal(size=(10, 5)), rng.normal(size=k)
    monkeypatch.setattr(_arrow, "LARGE_BORDER", 0)
    monkeypatch.setattr(_arrow, "COLUMNS", columns)
    (x, y), (by_frame, shared) = solution_and_variance(arrow, jnp.asarray(g, jnp.float32), jnp.asarray(h, jnp.float32))
    want = np.linalg.solve(full, np.concatenate([g.ravel(), h]))
    np.testing.assert_allclose(np.concatenate([np.ravel(x), y]), want, atol=2e-5 * np.abs(want).max())
    np.testing.assert_allclose(np.concatenate([np.ravel(by_frame), shared]), np.diag(np.linalg.inv(full)), rtol=1e-4)


def test_many_arrows_at_once():
    rng = np.random.default_rng(7)
    arrows, fulls = zip(*[random_arrow(6, rng) for _ in range(3)], strict=True)
    many = jax.tree.map(lambda *a: jnp.stack(a), *arrows)
    g, h = rng.normal(size=(3, 6, 5)), rng.normal(size=(3, 4))
    (x, y), (by_frame, _) = jax.jit(jax.vmap(solution_and_variance))(
        many, jnp.asarray(g, jnp.float32), jnp.asarray(h, jnp.float32)
    )
    for i, full in enumerate(fulls):
        want = np.linalg.solve(full, np.concatenate([g[i].ravel(), h[i]]))
        np.testing.assert_allclose(np.concatenate([np.ravel(x[i]), y[i]]), want, atol=2e-5 * np.abs(want).max())
        np.testing.assert_allclose(np.ravel(by_frame[i]), np.diag(np.linalg.inv(full))[:30], rtol=1e-4)


# --- markers and their derivatives ---


def random_body_state(rng: np.random.Generator, poses: int, markers: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    body = load_body()
    low, high = (np.clip(a, -2.5, 2.5) for a in np.asarray(body.joint_range_rad).T)
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    qpos = rng.uniform(low, high, (poses, len(low)))
    return f32(qpos), f32(rng.uniform(0.8, 1.25, 8)), f32(rng.normal(0, 0.02, (markers, 3)))


def test_derivatives_of_markers_are_those_of_automatic_differentiation():
    body, table = load_body(), MarkerTable.of(few_markers(), 24)
    qpos, scale, offset = random_body_state(np.random.default_rng(1), 5, 24)
    ours = jax.jit(marker_jacobian, static_argnames="body")(body, table, qpos, scale, offset)
    plain = marker_positions(body, few_markers(), qpos, scale, offset[:20])
    np.testing.assert_allclose(ours.x_world_m[:, :20], plain, atol=1e-5)

    def one(q, s, o):
        return table_positions(body, table, q[None], s, o)[0]

    by_q, by_s, by_o = jax.jit(jax.vmap(jax.jacfwd(one, (0, 1, 2)), (0, None, None)))(qpos, scale, offset)
    np.testing.assert_allclose(ours.per_qpos, by_q, atol=1e-5)
    np.testing.assert_allclose(ours.per_scale, by_s, atol=1e-5)
    own = np.einsum("tmimj->tmij", by_o)
    np.testing.assert_allclose(ours.per_offset, own, atol=1e-5)
    assert np.count_nonzero(np.abs(by_o) > 1e-6) == np.count_nonzero(np.abs(own) > 1e-6)  # a marker moves itself alone


def test_bodies_are_where_mujoco_and_mjx_have_them():
    import mujoco
    from mujoco import mjx

    body = load_body()
    qpos, scale, _ = random_body_state(np.random.default_rng(2), 8, 1)
    xpos, xmat = body_poses(body, qpos, scale)
    positions = np.asarray(scaled_body_pos(body, scale))

    model = body.mj_model.__copy__()
    model.body_pos[1:] = positions
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    for t in range(len(qpos)):
        data.qpos[:] = np.asarray(qpos[t], np.float64)
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        np.testing.assert_allclose(xpos[t], data.xpos[1:], atol=1e-5)
        np.testing.assert_allclose(xmat[t].reshape(-1, 9), data.xmat[1:], atol=1e-5)

    on_device = mjx.put_model(model)
    at = jax.jit(lambda d, q: mjx.kinematics(on_device, d.replace(qpos=q)))
    for t in range(2):
        there = at(mjx.make_data(on_device), qpos[t])
        np.testing.assert_allclose(xpos[t], there.xpos[1:], atol=1e-5)
        np.testing.assert_allclose(xmat[t], there.xmat[1:].reshape(-1, 3, 3), atol=1e-5)


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
        pose_prior_deg=(("hip_rotation", 3.0, 8.0), ("knee_angle", -5.0, 20.0)),
        weight_scale=0.4,
    ),
)


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
    session = make_session(trials, ["a", "b"], PARAMS.view, [motion] * 2, few)
    if "floor" in kind:
        seen = np.random.default_rng(5).random(session.obs.contact.shape) * session.obs.weight[:, None]
        session = dataclasses.replace(session, obs=dataclasses.replace(session.obs, contact=jnp.asarray(seen)))
    return session


def away(session: Session, seed: int = 3) -> State:
    """A state away from the start in every unknown, some joints beyond their limits."""
    rng, state = np.random.default_rng(seed), start_of(session)
    turn = Rotation.from_rotvec(rng.normal(0, 0.01, (len(state.qpos), 3))).as_matrix()
    noise = lambda a, sd: jnp.asarray(a + rng.normal(0, sd, a.shape), jnp.float32)  # noqa: E731
    turned = jnp.asarray(np.einsum("fij,fvjk->fvik", turn, state.R_nc), jnp.float32)
    return State(
        qpos=noise(state.qpos, 0.15),
        R_nc=turned if session.moving else state.R_nc,
        s=noise(state.s, 0.05),
        site_offset_m=noise(state.site_offset_m, 0.01) * session.table.weight[:, None],
        clock_s=noise(state.clock_s, 0.02) + 0.003,
        floor=noise(state.floor - np.array([1.2, 0.0, 0.0]), 0.03),
    )


@pytest.mark.parametrize("kind", ["static", "moving", "views", "world", "floor", "moving floor"])
def test_normal_equations_hold_the_gradient_of_the_cost(kind):
    session = small_session(kind)
    w, state, kinds = weights_of(session, PARAMS), away(session), kinds_of(session)
    obs, fixed = session.obs, (session.body, session.table, session.obs, w, kinds)
    assert kinds.moving == ("moving" in kind)
    assert kinds.contact == ("floor" in kind)
    n = float(jnp.sum(obs.weight))
    assert 30 < n < len(obs.weight)  # and padding

    def total(change):
        turn = jaxlie.SO3.exp(change["turn"]).as_matrix()
        moved = State(
            qpos=state.qpos + change["qpos"],
            R_nc=jnp.einsum("fij,fvjk->fvik", turn, state.R_nc, precision="highest"),
            s=state.s + change["s"],
            site_offset_m=state.site_offset_m + change["offset"],
            clock_s=state.clock_s + change["clock"],
            floor=state.floor + change["floor"],
        )
        return n * cost(*fixed, moved)

    none = {
        "qpos": jnp.zeros_like(state.qpos),
        "turn": jnp.zeros((len(state.qpos), 3)),
        "s": jnp.zeros(8),
        "offset": jnp.zeros_like(state.site_offset_m),
        "clock": jnp.zeros_like(state.clock_s),
        "floor": jnp.zeros_like(state.floor),
    }
    want = jax.jit(jax.grad(total))(none)
    matrix, g, h = jax.jit(lambda s: normal_equations(*fixed, s))(state)
    k = 8 + state.site_offset_m.size
    ours = {"qpos": g[:, :40], "s": h[:8], "offset": h[8:k].reshape(-1, 3)}
    if kinds.moving:
        ours |= {"turn": g[:, 40:], "clock": h[k : k + 2]}
    if kinds.contact:
        ours["floor"] = h[-6:].reshape(-1, 3)
    for name, value in ours.items():
        w_ = np.asarray(want[name])
        assert np.abs(w_).max() > 0.1, name
        np.testing.assert_allclose(-np.asarray(value), w_, atol=1e-3 * np.abs(w_).max(), rtol=1e-3, err_msg=name)
    assert np.all(np.linalg.eigvalsh(np.asarray(matrix.corner, np.float64)) > -1e-3 * np.abs(matrix.corner).max())
    np.testing.assert_allclose(matrix.diagonal, np.swapaxes(matrix.diagonal, 1, 2), atol=1e-3 * np.abs(g).max())


def test_curvature_of_the_soles_is_that_of_their_residuals():
    """v' H v of what they add to the matrix against the residuals' change along v (Gauss-Newton, no robust weights)."""
    session = small_session("floor")
    params = dataclasses.replace(PARAMS, huber_floor_cm=1e6, huber_slide_cm=1e6)
    w, state, obs = weights_of(session, params), away(session), session.obs
    matrix, nothing = {}, jnp.zeros(())
    without = dataclasses.replace(w, weight_floor=nothing, weight_slide=nothing)
    for name, weights in (("all", w), ("none", without)):
        equations = functools.partial(normal_equations, session.body, session.table, obs, weights, kinds_of(session))
        matrix[name] = jax.jit(equations)(state)[0]
    own = jax.tree.map(lambda a, b: np.asarray(a - b, np.float64), matrix["all"], matrix["none"])

    def residuals(qpos, s, floor):
        x = sole_positions(session.body, qpos, scale_multipliers(s))
        height, (way, _, share) = _height_cm(x, obs, floor)[0], _way_cm(x, obs)
        return (
            jnp.sqrt(obs.weight[:, None] * obs.contact * w.weight_floor) * height,
            jnp.sqrt(share * w.weight_slide)[..., None] * way,
        )

    rng = np.random.default_rng(6)
    v = [rng.normal(size=np.shape(a)).astype(np.float32) for a in (state.qpos, state.s, state.floor)]
    _, change = jax.jvp(residuals, (state.qpos, state.s, state.floor), tuple(v))
    want = sum(float(jnp.sum(c**2)) for c in change)
    q, y = v[0].astype(float), np.zeros(own.corner.shape[0])
    y[:8], y[-6:] = v[1], v[2].ravel()
    got = np.einsum("fa,fab,fb", q, own.diagonal, q) + 2 * np.einsum("fa,fab,fb", q[:-1], own.next_1[:-1], q[1:])
    got += 2 * np.einsum("fa,fak,k", q, own.border, y) + y @ own.corner @ y
    assert got == pytest.approx(want, rel=1e-4)


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
    np.testing.assert_allclose(second_difference(q, jnp.asarray(bend, jnp.float32)), want, atol=2e-5)
    even = bend_weights(np.arange(5) / 30, np.ones(5, bool))
    np.testing.assert_allclose(even[1:-1], [[1, -2, 1]] * 3, atol=1e-9)


def test_second_differences_span_gaps_and_end_with_the_frames_that_count():
    used = np.array([0, 1, 1, 0, 0, 1, 1, 0], bool)
    assert np.flatnonzero(bend_weights(np.arange(8) / 30, used).any(axis=1)).tolist() == [2, 3, 4, 5]
    assert not bend_weights(np.arange(8) / 30, np.zeros(8, bool)).any()


def test_depth_counts_by_its_ratio():
    R, c = jnp.eye(3), jnp.ones(2)
    model = jnp.array([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0]])
    # Apart by 2 cm across and 6 cm along the camera's axis; centred, each point is off by half of it.
    detected = model + jnp.array([[0.01, 0.0, 0.03], [-0.01, 0.0, -0.03]])
    for ratio in (1.0, 0.5):
        got = distance_3d_cm2(model, detected, R, c, 1.0, ratio)
        np.testing.assert_allclose(got, [1 + 9 * ratio**2] * 2, rtol=1e-3)


def test_distance_in_pixels_of_a_moved_and_turned_camera():
    # 90 deg about world z: the camera's right is world +x, its forward world +y.
    R = jnp.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    K = jnp.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    x = jnp.array([[1.0, 5.0, 0.5]]) - jnp.array([0.0, 1.0, 0.0])
    # Ahead by 4 m, right by 1 m, up by 0.5 m: 250 px right and 125 px up of the middle.
    np.testing.assert_allclose(distance_2d_px2(x, jnp.array([[753.0, 271.0]]), R, K), [9 + 16], rtol=1e-3)


def test_derivative_of_the_projection_also_near_and_behind_the_camera():
    K = jnp.array([[900.0, 0, 500], [0, 1100, 400], [0, 0, 1]])
    x = jnp.array([[0.3, -0.2, 4.0], [0.3, 0.1, 0.12], [-0.1, 0.2, -0.05]])
    want = jax.vmap(jax.jacfwd(lambda p: project_px(p[None], K)[0]))(x)
    np.testing.assert_allclose(project_jacobian(x, K), want, rtol=1e-4, atol=1e-2)


def test_phone_error_by_hand():
    """A phone that turns by 40 deg/s about z, a fitted camera that is 1.5 deg further, a clock that is 25 ms late."""
    session = small_session("moving")
    start_s, obs = float(session.obs.sample_start_s[0]), session.obs
    at_s = start_s + SAMPLE_S * np.arange(obs.sample_quat_wxyz.shape[1])
    z = np.array([0.0, 0, 1])
    quat = Rotation.from_rotvec(np.deg2rad(40 * at_s)[:, None] * z).as_quat(scalar_first=True)
    quat = jnp.asarray(np.broadcast_to(quat, obs.sample_quat_wxyz.shape), jnp.float32)
    obs = dataclasses.replace(obs, sample_quat_wxyz=quat)
    camera = Rotation.from_rotvec(np.deg2rad(40 * np.asarray(obs.time_s) + 1.5)[:, None] * z).as_matrix()
    state = dataclasses.replace(
        start_of(session), R_nc=jnp.asarray(camera[:, None], jnp.float32), clock_s=jnp.asarray([0.025, 0.0])
    )
    error, rate = _phone_error_deg(obs, state)
    trial = np.asarray(obs.trial)
    np.testing.assert_allclose(error, (1.5 - 40 * np.array([0.025, 0.0])[trial])[:, None] * z, atol=2e-3)
    np.testing.assert_allclose(rate, np.deg2rad(40) * np.broadcast_to(z, rate.shape), atol=1e-3)
