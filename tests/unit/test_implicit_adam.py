"""The paper's solver: its kinematics, costs and optimiser against others', its results against the truth."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.body._jacobian import MarkerTable, table_positions
from pbl_pipeline.body._marker_chain import chained_markers
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import CostParams, ImplicitAdamParams, ViewParams
from pbl_pipeline.fit._costs import distance_2d_px2, distance_3d_cm2, huber_of_square
from pbl_pipeline.fit._inputs import Session, make_session
from pbl_pipeline.fit._marker_cost import MarkerWeights, kinds_of, marker_cost
from pbl_pipeline.fit._network_start import camera_start, keypoint_start, paper_start
from pbl_pipeline.fit._paper_objective import PAPER_COST, angle_between_deg, paper_objective
from pbl_pipeline.fit._params import PAPER_2025
from pbl_pipeline.fit._trajectory import encode, evaluate, fit_ranges, frequencies, initial_networks
from pbl_pipeline.fit.solvers import implicit_adam as solver
from pbl_pipeline.fit.solvers.implicit_adam import adam_step, solve_implicit_adam
from pbl_pipeline.synthetic import (
    NO_NOISE,
    PhoneSensor,
    observe,
    observe_markers,
    observe_views,
    pelvis_positions,
    walk_qpos,
)

pytestmark = pytest.mark.slow

TIME_S = np.arange(60) / 30
RNG = np.random.default_rng(7)


def session_of(*seen, motion: str = "static") -> Session:
    return make_session(seen, [str(i) for i in range(len(seen))], ViewParams(), [motion] * len(seen))


def quick(steps: int, **changes) -> ImplicitAdamParams:
    return dataclasses.replace(PAPER_2025, steps=steps, samples_per_trial=32, hidden=(64, 64), **changes)


@pytest.fixture(scope="module")
def handheld():
    """Two trials of a held phone without noise, their truth, and the session."""
    qpos = [walk_qpos(TIME_S, seed=i, path="straight") for i in (1, 2)]
    still = PhoneSensor(white_deg=0.0, drift_deg=0.0, clock_offset_s=0.0)
    seen = [
        observe(q, TIME_S, seed=i, camera_motion="handheld", noise=NO_NOISE, sensor=still) for i, q in enumerate(qpos)
    ]
    return qpos, seen, session_of(*(s.keypoints for s in seen), motion="handheld")


def test_markers_and_their_reverse_derivative_are_those_of_the_table():
    body, table = load_body(), MarkerTable.of(marker_set("bml_movi_87"), 96)
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    at = f32(RNG.normal(0, 0.6, (5, 40))), f32(1 + 0.1 * RNG.normal(size=8)), f32(0.01 * RNG.normal(size=(96, 3)))
    pull = f32(RNG.normal(size=(5, 96, 3)))

    def both(positions):
        x, back = jax.vjp(positions, *at)
        return x, back(pull)

    want, want_back = jax.jit(lambda: both(lambda *a: table_positions(body, table, *a)))()
    got, got_back = jax.jit(lambda: both(lambda *a: jnp.moveaxis(chained_markers(body, table, *a), -1, 0)))()
    np.testing.assert_allclose(got, want, atol=2e-6)
    for g, w in zip(got_back, want_back, strict=True):
        np.testing.assert_allclose(g, w, atol=2e-5 * float(jnp.abs(w).max()))


def test_marker_cost_is_the_sum_of_the_terms(handheld):
    _, _, session = handheld
    obs, table = session.obs, session.table
    qpos = np.tile(keypoint_start(session, 0), (len(obs.weight), 1)).astype(np.float32)
    x = table_positions(session.body, table, jnp.asarray(qpos), jnp.ones(8), jnp.zeros((len(table.weight), 3)))
    cost = CostParams(weight_3d=0.7, weight_2d=0.3, huber_3d_cm=8.0, huber_2d_px=20.0, depth_ratio=0.5)
    kinds = kinds_of(session)
    got = jax.jit(lambda x: marker_cost(x, obs, obs.R_nc, table, MarkerWeights.of(cost), kinds))(x)
    e3 = distance_3d_cm2(x[:, None], obs.x_cam, obs.R_nc, obs.c_3d, table.weight_3d, 0.5)
    e2 = distance_2d_px2(x[:, None], obs.xy_px, obs.R_nc, obs.camera_matrix)
    want = 0.7 * jnp.sum(huber_of_square(e3, 8.0) * obs.c_3d * table.weight_3d, axis=(1, 2)) / 87
    want += 0.3 * jnp.sum(huber_of_square(e2, 20.0) * obs.c_2d, axis=(1, 2)) / 87
    assert float(jnp.max(want)) > 10
    np.testing.assert_allclose(got, want, rtol=1e-4)


def test_angle_between_orientations_and_its_gradient_where_they_agree():
    a = Rotation.from_rotvec([0.3, -0.2, 0.9])
    b = Rotation.from_rotvec(np.deg2rad(25) * np.array([0.6, 0.8, 0])) * a
    q = lambda r: jnp.asarray(r.as_quat(scalar_first=True), jnp.float32)  # noqa: E731
    assert float(angle_between_deg(q(a), q(b))) == pytest.approx(25, rel=1e-5)
    assert float(angle_between_deg(-q(a), q(b))) == pytest.approx(25, rel=1e-5)
    assert float(angle_between_deg(q(a), q(a))) == 0
    assert np.all(np.isfinite(jax.grad(angle_between_deg)(q(a), q(a))))


def test_adam_is_optax_adam_on_networks_and_body():
    steps, decayed = 40, 6
    params = dataclasses.replace(PAPER_2025, steps=steps, clip_norm=2.0, weight_decay=0.1, learning_rate_end=1e-4)
    numbers = solver._numbers(load_body(), params)
    rate = optax.exponential_decay(1e-3, steps, 0.1)
    other = optax.chain(optax.clip_by_global_norm(2.0), optax.adamw(rate, b1=0.8, weight_decay=0.1, mask=[True, False]))
    slope = lambda p: jnp.sin(7 * p) * 3 + p  # noqa: E731
    p = jnp.asarray(RNG.normal(size=9), jnp.float32)
    q = [p[:decayed], p[decayed:]]
    mean = square = jnp.zeros(9)
    state = other.init(q)
    for k in range(steps):
        p, mean, square = adam_step(p, mean, square, slope(p), jnp.asarray(k), decayed, numbers)
        update, state = other.update([slope(a) for a in q], state, q)
        q = [a + u for a, u in zip(q, update, strict=True)]  # type: ignore[call-overload]
    np.testing.assert_allclose(p, np.concatenate(q), atol=1e-5)
    after, _, _ = adam_step(p, mean, square, slope(p), jnp.asarray(steps), decayed, numbers)
    np.testing.assert_array_equal(after, p)


def test_time_encoding_covers_the_band_and_is_padded_with_nothing():
    omega = frequencies(6.0, 80.0, 2)
    assert omega[0] == pytest.approx(math.pi / 6)
    assert 80 <= omega[-1] < 80 * 2**0.5
    np.testing.assert_allclose(omega[2:] / omega[:-2], 2.0)
    omega = omega[:5]
    code = encode(np.array([0.0, 1.3]), omega)
    assert code.shape == (2, 16)
    np.testing.assert_allclose(code[1, :5], np.sin(1.3 * omega))
    np.testing.assert_allclose(code[1, 8:13], np.cos(1.3 * omega))
    assert np.all(code[:, [5, 6, 7, 13, 14, 15]] == 0)


def test_networks_use_the_encoding_again_and_do_not_depend_on_their_number():
    networks = initial_networks(3, 2, 5, (12, 12, 12, 12), 2, 43)
    assert [w.shape for w, _ in networks] == [(2, 16, 12), (2, 28, 12), (2, 28, 12), (2, 12, 12), (2, 12, 43)]
    more = initial_networks(3, 4, 5, (12, 12, 12, 12), 2, 43)
    for (w, b), (w4, b4) in zip(networks, more, strict=True):
        np.testing.assert_array_equal(w, w4[:2])
        np.testing.assert_array_equal(b, b4[:2])
    assert np.all(networks[-1][1] == 0)
    assert not np.array_equal(networks[0][0][0], networks[0][0][1])
    code = jnp.asarray(encode(np.array([[0.1, 0.7], [0.1, 0.7]]), frequencies(2.0, 5.0, 2)[:5]), jnp.float32)
    out = np.asarray(evaluate(networks, code))  # type: ignore[arg-type]
    x = by_hand = np.asarray(code[1, 1])
    for i, (w, b) in enumerate(networks):
        x = by_hand if i == 0 else np.concatenate([x, by_hand]) if i <= 2 else x
        x = x @ w[1] + b[1]
        x = np.maximum(x, 0) if i < 4 else x
    np.testing.assert_allclose(out[1, 1], x, atol=1e-6)


def test_the_paper_starts_ahead_of_the_cameras_median_orientation(handheld):
    _, seen, session = handheld
    low, high, _ = fit_ranges(session.body.joint_names, np.asarray(session.body.joint_range_rad))
    R = Rotation.from_rotvec(camera_start(session, 1))
    off = (R * Rotation.from_matrix(seen[1].R_nc).inv()).magnitude()
    from_first = (Rotation.from_matrix(seen[1].R_nc[0]) * Rotation.from_matrix(seen[1].R_nc).inv()).magnitude()
    assert np.median(off) < np.median(from_first)
    qpos = paper_start(session, 1, 1.5, 0.5 * (low + high))
    np.testing.assert_allclose(pelvis_positions(qpos[None])[0], 1.5 * R.as_matrix()[:, 2], atol=1e-9)
    np.testing.assert_allclose(qpos[6:], (0.5 * (low + high))[6:])


def test_the_solver_begins_at_its_start(handheld):
    """Before the first step the trajectory is nearly constant at the start pose and orientation."""
    _, _, session = handheld
    solution = solve_implicit_adam(session, quick(0))
    start = camera_start(session, 0)
    off = (Rotation.from_matrix(solution.R_nc[session.frames(0), 0]) * Rotation.from_rotvec(start).inv()).magnitude()
    assert np.rad2deg(off).max() < 8
    assert solution.iterations == 0
    assert not solution.converged
    assert solution.loss_trace.shape == (0, 2)


def padded(session: Session) -> Session:
    """The same session with more frames, markers and trials of padding."""
    obs, frames, markers, n = session.obs, 37, 11, 3
    out = {}
    for f in dataclasses.fields(obs):
        a = np.asarray(getattr(obs, f.name))
        widths = [(0, 0)] * a.ndim
        if f.name in ("has_phone", "sample_quat_wxyz", "sample_start_s"):
            widths[0] = (0, n)
        elif a.ndim:
            widths[0] = (0, frames)
        if f.name in ("x_cam", "c_3d", "xy_px", "c_2d"):
            widths[2] = (0, markers)
        if f.name in ("x_world", "c_world"):
            widths[1] = (0, markers)
        edge = f.name in ("trial", "R_nc", "p_nc", "camera_matrix", "time_s")
        out[f.name] = jnp.asarray(np.pad(a, widths, mode="edge" if edge else "constant") if a.ndim else a)
    table = MarkerTable.of(session.markers, session.table.weight.shape[0] + markers)
    return dataclasses.replace(session, obs=type(obs)(**out), table=table)


@pytest.mark.parametrize("motion", ["static", "handheld"])
def test_padding_changes_nothing(motion):
    trials = [observe(walk_qpos(TIME_S, seed=i), TIME_S, seed=i, camera_motion=motion).keypoints for i in (3, 4)]
    session = session_of(*trials, motion=motion)
    # One step moves every unknown by the learning rate, so a few show whatever differs before rounding adds up.
    params = quick(12, learning_rate_end=1e-3)
    a, b = solve_implicit_adam(session, params), solve_implicit_adam(padded(session), params)
    for i in range(2):
        np.testing.assert_allclose(b.qpos[session.frames(i)], a.qpos[session.frames(i)], atol=1e-5)
        np.testing.assert_allclose(b.R_nc[session.frames(i)], a.R_nc[session.frames(i)], atol=1e-5)
    np.testing.assert_allclose(b.s, a.s, atol=1e-5)
    np.testing.assert_allclose(b.site_offset_m, a.site_offset_m, atol=1e-5)
    assert a.site_offset_m.shape == (87, 3)
    assert np.abs(a.site_offset_m).max() > 1e-3  # it moved


def test_frames_and_phone_samples_are_drawn_from_those_that_count(handheld):
    _, seen, _ = handheld
    k = seen[0].keypoints
    confidence = k.confidence.copy()
    confidence[10:25] = 0
    hidden = dataclasses.replace(k, confidence=confidence)
    session = session_of(hidden, seen[1].keypoints, motion="handheld")
    data, unknowns = solver._initialise(session, quick(1))
    static = solver._Static(session.body, kinds_of(session), 32, False, solver._shapes(unknowns))
    rows, phone = (np.asarray(a) for a in solver._draw(jax.random.key(0), data, static))
    assert rows.shape == phone.shape == (solver.CHUNK, 2, 32)
    used = np.flatnonzero(np.asarray(session.obs.weight) > 0)
    assert set(rows[:, 0].ravel()) == {r for r in used if r < 60}
    assert set(rows[:, 1].ravel()) == {r for r in used if r >= 60}
    time_s, quat, count = solver._phone_samples(session, 2)
    inside = time_s[0, : count[0]]
    assert inside.max() > TIME_S[25]
    assert not np.any((inside > TIME_S[9]) & (inside < TIME_S[25]))
    assert set(phone[:, 0].ravel()) == set(range(count[0]))
    assert phone[:, 1].min() >= time_s.shape[1]
    k2 = seen[1].keypoints
    at = np.argmin(np.abs(k2.phone_time_s - (k2.time_s[0] + time_s[1, 5])))
    np.testing.assert_allclose(np.abs(quat[1, 5] @ k2.phone_quat_wxyz[at]), 1, atol=1e-9)


def test_a_held_phone_is_recovered(handheld):
    qpos, seen, session = handheld
    params = dataclasses.replace(PAPER_2025, steps=1500, samples_per_trial=32, hidden=(128, 128), start="keypoints")
    solution = solve_implicit_adam(session, params)
    names = list(session.body.joint_names)
    columns = [names.index(f"{j}_{s}") for j in ("hip_flexion", "knee_angle") for s in "rl"]
    for i, (q, one) in enumerate(zip(qpos, seen, strict=True)):
        R = solution.R_nc[session.frames(i), 0]
        turned = np.rad2deg((Rotation.from_matrix(R) * Rotation.from_matrix(one.R_nc).inv()).magnitude())
        assert np.median(turned) < 1.5
        error = np.rad2deg(np.abs(solution.qpos[session.frames(i)][:, columns] - q[:, columns]))
        assert np.median(error) < 4.0
    assert solution.loss_trace[-1, 0] == 1500
    np.testing.assert_array_equal(solution.clock_s, 0)
    assert solution.qpos_sd is None


def test_the_papers_total_at_the_truth_and_beside_it(handheld):
    qpos, _, session = handheld
    q = np.full((len(session.obs.weight), 40), np.nan)
    R = np.array(session.obs.R_nc, np.float64)
    for i in range(2):
        q[session.frames(i)] = qpos[i]
    zero = np.zeros(8), np.zeros((87, 3))
    at_truth = paper_objective(session, q, R, *zero)
    assert at_truth < 0.2  # the log is turned evenly between its samples
    # A turn of everything about the vertical is seen by the phone alone, 3 deg at every frame.
    names = list(session.body.joint_names)
    about = Rotation.from_euler("z", 3, degrees=True).as_matrix()
    turned = q.copy()
    angles = [names.index(f"pelvis_{n}") for n in ("tilt", "list", "rotation")]
    used = np.isfinite(q[:, 0])
    stands = Rotation.from_quat(session.body.mj_model.body("pelvis").quat, scalar_first=True)
    pelvis = stands.inv() * Rotation.from_matrix(about) * stands * Rotation.from_euler("ZXY", q[used][:, angles])
    for column, angle in zip(angles, pelvis.as_euler("ZXY").T, strict=True):
        turned[used, column] = angle
    where = pelvis_positions(q) @ about.T - pelvis_positions(np.zeros((1, 40)))
    for joint, column in (("pelvis_tx", where[:, 0]), ("pelvis_tz", -where[:, 1]), ("pelvis_ty", where[:, 2])):
        turned[:, names.index(joint)] = column
    assert paper_objective(session, turned, about @ R, *zero) == pytest.approx(at_truth + 3.0, abs=0.02)
    offset = np.zeros((87, 3))
    offset[4, 1] = 1e-6
    moved = paper_objective(session, q, R, np.zeros(8), offset)
    assert moved == pytest.approx(at_truth, abs=1e-4)
    offset[:, 0] = 0.01  # 100 * 87 * 0.01^2, and what the points then are off
    assert paper_objective(session, q, R, np.zeros(8), offset) > at_truth + 0.87
    assert (PAPER_COST.weight_3d, PAPER_COST.weight_2d, PAPER_COST.weight_phone) == (1.0, 0.1, 1.0)


def test_the_papers_total_of_markers_in_the_world_is_not_centred():
    q = walk_qpos(TIME_S, seed=5)
    session = make_session([observe_markers(q, TIME_S, noise_m=0.0)], ["a"], ViewParams())
    F = len(session.obs.weight)
    at = np.zeros((F, 40))
    at[session.frames(0)] = q
    zero = np.zeros((F, 0, 3, 3)), np.zeros(8), np.zeros((len(session.markers), 3))
    assert paper_objective(session, at, *zero) < 0.01
    at[:, 0] += 0.02  # everything 2 cm ahead: 2 cm^2 by the confidence
    weight = np.asarray(session.obs.c_world)[:60, : len(session.markers)] * session.markers.weight_3d
    assert paper_objective(session, at, *zero) == pytest.approx(2.0 * weight.mean(), rel=0.01)


@pytest.mark.parametrize("kind", ["markers", "views"])
def test_markers_in_the_world_and_several_cameras_are_fitted(kind):
    q = walk_qpos(TIME_S, seed=6, path="treadmill")
    markers, views = observe_markers(q, TIME_S, noise_m=0.0), observe_views(q, TIME_S, noise=NO_NOISE)
    trial = markers if kind == "markers" else views
    session = make_session([trial], ["a"], ViewParams())
    solution = solve_implicit_adam(session, quick(500))
    assert solution.loss_trace[-1, 1] < 0.5 * solution.loss_trace[0, 1]
    off = pelvis_positions(solution.qpos[session.frames(0)]) - pelvis_positions(q)
    assert np.median(np.abs(off)) < 0.08
    assert solution.R_nc.shape[1] == (0 if kind == "markers" else len(views.views))


def test_a_loss_that_is_not_finite_is_told(handheld):
    _, _, session = handheld
    broken = dataclasses.replace(session, obs=dataclasses.replace(session.obs, x_cam=session.obs.x_cam * jnp.nan))
    with pytest.raises(PblError, match="nan") as error:
        solve_implicit_adam(broken, quick(5))
    assert error.value.code == "FIT_DIVERGED"
