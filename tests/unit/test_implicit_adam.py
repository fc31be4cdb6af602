"""The paper's solver: its kinematics, costs and optimiser against others', its results against the truth."""

import dataclasses
import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import marker_positions
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import CostParams, ImplicitAdamParams, implicit, problem
from pbl_pipeline.fit.implicit import solve_implicit
from pbl_pipeline.fit.initial_pose import median_orientation, median_pose, paper_pose
from pbl_pipeline.fit.keypoint_terms import L2D, L3D
from pbl_pipeline.fit.phone_term import LPHONE
from pbl_pipeline.fit.problem import State
from pbl_pipeline.fit.session import Session, make_session
from pbl_pipeline.fit.solvers.adam import Schedule, optimiser
from pbl_pipeline.fit.term import At, Phone
from pbl_pipeline.fit.trajectory import encode, evaluate, fit_ranges, frequencies, initial_trajectories
from pbl_pipeline.fit.weights import PAPER_PHONE_DEG, Weights
from pbl_pipeline.synthetic import NO_NOISE, PhoneSensor, pelvis_positions
from research.paper_objective import PAPER_COST, objective_of
from research.walker.observe import observe
from research.walker.views import observe_markers, observe_views
from research.walker.walk import walk_qpos
from tests import Limits, not_none

pytestmark = pytest.mark.slow

TIME_S = np.arange(60) / 30
PAPER_2025 = ImplicitAdamParams()
RNG = np.random.default_rng(7)


def session_of(*seen, motion: str = "static") -> Session:
    return make_session(seen, [str(i) for i in range(len(seen))], ImplicitAdamParams(), [motion] * len(seen))


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


@pytest.fixture
def few_steps_a_call(limits: Limits) -> Iterator[None]:
    """The compiled loop does 5 steps instead of 250."""
    compiled: Any = implicit._run_chunk
    limits(implicit, CHUNK=5)
    compiled.clear_cache()  # of the same sizes with other steps
    yield
    compiled.clear_cache()


def test_keypoint_terms_against_the_formula_in_double_precision(handheld):
    """L3D and L2D of the paper, written out with NumPy."""
    _, _, session = handheld
    p, body = jax.tree.map(jnp.asarray, session.problem), session.body
    cost = CostParams(weight_3d=0.7, weight_2d=0.3, huber_3d_cm=8.0, huber_2d_px=20.0, depth_ratio=0.5)
    qpos = jnp.asarray(np.tile(median_pose(session, 0), (len(p.weight), 1)), jnp.float32)
    zero = jnp.zeros((len(p.weight_3d), 3))
    n = p.has_phone.shape[0]
    state = State(qpos, p.R_nc, jnp.zeros(8), zero, jnp.zeros(n), jnp.zeros((n, 3)))

    @jax.jit
    def terms(state):
        x, soles, _ = p.split(marker_positions(body, p.points, state.qpos, jnp.ones(8), p.point_offsets(zero)))
        w = Weights.of(body, dataclasses.replace(PAPER_2025, cost=cost))
        at = At(p, w, state, x, soles)
        return x, {term.name: term.value(at) for term in (L3D, L2D)}

    x, got = terms(state)
    weight, x, marker_weight = (np.asarray(a, float) for a in (p.weight, x, p.weight_3d))
    x_cam = np.einsum("fji,fmj->fmi", np.asarray(p.R_nc[:, 0], float), x)
    detected, c = np.asarray(p.x_cam[:, 0], float), np.asarray(p.c_3d[:, 0], float)
    seen = np.where(c > 0, marker_weight, 0.0)
    mean = lambda a: (seen[..., None] * a).sum(1, keepdims=True) / np.maximum(seen.sum(1), 1e-9)[:, None, None]  # noqa: E731
    huber = lambda e, d: np.where(e > d, d * (e - 0.5 * d), 0.5 * e**2)  # noqa: E731
    off = 100 * ((x_cam - mean(x_cam)) - (detected - mean(detected))) * [1, 1, 0.5]
    want = np.sum(c * marker_weight * huber(np.linalg.norm(off, axis=-1), 8.0), axis=1)
    assert float(got["L3D"]) == pytest.approx(float(0.7 * np.sum(want * weight) / weight.sum()), rel=1e-4)
    K = np.asarray(p.camera_matrix[:, 0], float)
    uv = np.einsum("fij,fmj->fmi", K, x_cam)
    off = uv[..., :2] / uv[..., 2:] - np.asarray(p.xy_px[:, 0], float)
    want = np.sum(np.asarray(p.c_2d[:, 0]) * huber(np.linalg.norm(off, axis=-1), 20.0), axis=1)
    assert float(got["L2D"]) == pytest.approx(float(0.3 * np.sum(want * weight) / weight.sum()), rel=1e-4)
    assert float(np.asarray(p.c_2d)[5].sum()) == pytest.approx(
        float(np.mean(session.trials[0].confidence[5])), rel=1e-5
    )


def test_angle_between_orientations_and_its_gradient_where_they_agree():
    a = Rotation.from_rotvec([0.3, -0.2, 0.9])
    b = Rotation.from_rotvec(np.deg2rad(25) * np.array([0.6, 0.8, 0])) * a
    q = lambda r: jnp.asarray(r.as_quat(scalar_first=True), jnp.float32)  # noqa: E731

    def angle(a, b):
        frame: Any = SimpleNamespace(weight=jnp.ones(1))
        numbers: Any = {"weight_phone": 1.0, "huber_phone_deg": PAPER_PHONE_DEG}
        nothing: Any = None
        phone = Phone(jaxlie.SO3(a[None]), lambda _: jaxlie.SO3(b[None]), frame.weight)
        return LPHONE.value(At(frame, numbers, nothing, nothing, nothing, phone))

    assert float(angle(q(a), q(b))) == pytest.approx(25, rel=1e-4)
    assert float(angle(-q(a), q(b))) == pytest.approx(25, rel=1e-4)
    assert float(angle(q(a), q(a))) == pytest.approx(0, abs=1e-4)
    assert np.all(np.isfinite(jax.grad(angle)(q(a), q(a))))


def test_adam_clips_decays_the_networks_alone_and_stops_after_its_steps():
    steps = 40
    numbers = (steps, 1e-3, 1e-4, 0.8, 0.1, 2.0)
    ours = optimiser(Schedule(*(jnp.asarray(n, jnp.float32) for n in numbers)), [True, False])
    rate = optax.exponential_decay(1e-3, steps, 0.1)
    other = optax.chain(optax.clip_by_global_norm(2.0), optax.adamw(rate, b1=0.8, weight_decay=0.1, mask=[True, False]))
    slope = lambda p: jnp.sin(7 * p) * 3 + p  # noqa: E731
    start = [jnp.asarray(RNG.normal(size=n), jnp.float32) for n in (6, 3)]

    def run(chain: Any, n: int) -> np.ndarray:
        p: Any = start
        state = chain.init(start)
        for _ in range(n):
            update, state = chain.update([slope(a) for a in p], state, p)
            p = optax.apply_updates(p, update)
        return np.concatenate(p)

    np.testing.assert_allclose(run(ours, steps), run(other, steps), atol=1e-5)
    np.testing.assert_array_equal(run(ours, steps + 3), run(ours, steps))


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


@pytest.mark.usefixtures("little_optimised")
def test_trajectories_use_the_encoding_again_and_do_not_depend_on_their_number():
    shape = 16, (12, 12, 12, 12), 2, 43
    two, four = initial_trajectories(3, 2, *shape), initial_trajectories(3, 4, *shape)
    assert [a.weight.shape for a in two.layers] == [(2, 12, 16), (2, 12, 28), (2, 12, 28), (2, 12, 12), (2, 43, 12)]
    for a, b in zip(two.layers, four.layers, strict=True):
        np.testing.assert_array_equal(a.weight, b.weight[:2])
        np.testing.assert_array_equal(a.bias, not_none(b.bias)[:2])
    assert np.all(not_none(two.layers[-1].bias) == 0)
    assert not np.array_equal(two.layers[0].weight[0], two.layers[0].weight[1])
    code = jnp.asarray(encode(np.array([[0.1, 0.7], [0.1, 0.7]]), frequencies(2.0, 5.0, 2)[:5]), jnp.float32)
    out = np.asarray(evaluate(two, code))
    x = by_hand = np.asarray(code[1, 1])
    for i, layer in enumerate(two.layers):
        x = by_hand if i == 0 else np.concatenate([x, by_hand]) if i <= 2 else x
        x = layer.weight[1] @ x + not_none(layer.bias)[1]
        x = np.maximum(x, 0) if i < 4 else x
    np.testing.assert_allclose(out[1, 1], x, atol=1e-6)


def test_the_paper_starts_ahead_of_the_cameras_median_orientation(handheld):
    _, seen, session = handheld
    low, high = fit_ranges(session.body)
    R = Rotation.from_rotvec(median_orientation(session, 1))
    off = (R * Rotation.from_matrix(seen[1].R_nc).inv()).magnitude()
    from_first = (Rotation.from_matrix(seen[1].R_nc[0]) * Rotation.from_matrix(seen[1].R_nc).inv()).magnitude()
    assert np.median(off) < np.median(from_first)
    qpos = paper_pose(session, 1, 1.5, 0.5 * (low + high))
    np.testing.assert_allclose(pelvis_positions(qpos[None])[0], 1.5 * R.as_matrix()[:, 2], atol=1e-9)
    np.testing.assert_allclose(qpos[6:], (0.5 * (low + high))[6:])


@pytest.mark.usefixtures("little_optimised")
def test_the_solver_begins_at_its_start(handheld):
    """Before the first step the trajectory is nearly constant at the start pose and orientation."""
    _, _, session = handheld
    solution = solve_implicit(session, quick(0))
    start = median_orientation(session, 0)
    off = (Rotation.from_matrix(solution.R_nc[session.frames(0), 0]) * Rotation.from_rotvec(start).inv()).magnitude()
    assert np.rad2deg(off).max() < 8
    assert solution.iterations == 0
    assert not solution.result.converged
    assert solution.loss_trace.shape == (0, 2)


@pytest.mark.long
def test_padding_changes_nothing(monkeypatch):
    motion = "handheld"  # which has all that a standing camera has
    trials = [observe(walk_qpos(TIME_S, seed=i), TIME_S, seed=i, camera_motion=motion).keypoints for i in (3, 4)]
    session = session_of(*trials, motion=motion)
    # One step moves every unknown by the learning rate, so a few show whatever differs before rounding adds up.
    params = quick(12, learning_rate_end=1e-3)
    monkeypatch.setattr(problem, "pad_frames", lambda n, coarse=False: 192 if n <= 192 else 512)
    monkeypatch.setattr(problem, "pad_markers", lambda n: 110)
    monkeypatch.setattr(problem, "pad_trials", lambda n, coarse=False: 5)
    larger = session_of(*trials, motion=motion)
    assert larger.problem.c_2d.shape != session.problem.c_2d.shape
    a, b = solve_implicit(session, params), solve_implicit(larger, params)
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
    data, _ = implicit.initialise(session, quick(1))
    drawn = implicit.draw(jax.random.key(0), data)
    rows, phone = np.asarray(drawn.frames), np.asarray(drawn.phone)
    assert rows.shape == phone.shape == (implicit.CHUNK, 2, 32)
    used = np.flatnonzero(np.asarray(session.problem.weight) > 0)
    assert set(rows[:, 0].ravel()) == {r for r in used if r < 60}
    assert set(rows[:, 1].ravel()) == {r for r in used if r >= 60}
    time_s, quat, count = implicit.phone_samples(session)
    inside = time_s[0, : count[0]]
    assert inside.max() > TIME_S[25]
    assert not np.any((inside > TIME_S[9]) & (inside < TIME_S[25]))
    assert set(phone[:, 0].ravel()) == set(range(count[0]))
    assert phone[:, 1].min() >= time_s.shape[1]
    k2 = seen[1].keypoints
    at = np.argmin(np.abs(k2.phone_time_s - (k2.time_s[0] + time_s[1, 5])))
    np.testing.assert_allclose(np.abs(quat[1, 5] @ k2.phone_quat_wxyz[at]), 1, atol=1e-9)


@pytest.mark.long
def test_a_held_phone_is_recovered(handheld):
    qpos, seen, session = handheld
    solution = solve_implicit(session, quick(1500, start="keypoints"))
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
    q = np.full((len(session.problem.weight), 40), np.nan)
    R = np.array(session.problem.R_nc, np.float64)
    for i in range(2):
        q[session.frames(i)] = qpos[i]
    zero = np.zeros(8), np.zeros((87, 3))
    at_truth = objective_of(session, q, R, *zero)
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
    assert objective_of(session, turned, about @ R, *zero) == pytest.approx(at_truth + 3.0, abs=0.02)
    offset = np.zeros((87, 3))
    offset[4, 1] = 1e-6
    moved = objective_of(session, q, R, np.zeros(8), offset)
    assert moved == pytest.approx(at_truth, abs=1e-4)
    offset[:, 0] = 0.01  # 100 * 87 * 0.01^2, and what the points then are off
    assert objective_of(session, q, R, np.zeros(8), offset) > at_truth + 0.87
    assert (PAPER_COST.weight_3d, PAPER_COST.weight_2d, PAPER_COST.weight_phone) == (1.0, 0.1, 1.0)


def test_the_papers_total_of_markers_in_the_world_is_not_centred():
    q = walk_qpos(TIME_S, seed=5)
    session = make_session([observe_markers(q, TIME_S, noise_m=0.0)], ["a"], ImplicitAdamParams())
    F = len(session.problem.weight)
    at = np.zeros((F, 40))
    at[session.frames(0)] = q
    zero = np.zeros((F, 0, 3, 3)), np.zeros(8), np.zeros((len(session.markers), 3))
    assert objective_of(session, at, *zero) < 0.01
    at[:, 0] += 0.02  # everything 2 cm ahead: 2 cm^2 by the confidence
    weight = np.asarray(session.problem.c_world)[:60, : len(session.markers)] * session.markers.weight_3d
    assert objective_of(session, at, *zero) == pytest.approx(2.0 * weight.sum(axis=1).mean(), rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["markers", "views"])
def test_markers_in_the_world_and_several_cameras_are_fitted(kind):
    q = walk_qpos(TIME_S, seed=6, path="treadmill")
    markers, views = observe_markers(q, TIME_S, noise_m=0.0), observe_views(q, TIME_S, noise=NO_NOISE)
    trial = markers if kind == "markers" else views
    session = make_session([trial], ["a"], ImplicitAdamParams())
    solution = solve_implicit(session, quick(500))
    assert solution.loss_trace[-1, 1] < 0.5 * solution.loss_trace[0, 1]
    off = pelvis_positions(solution.qpos[session.frames(0)]) - pelvis_positions(q)
    assert np.median(np.abs(off)) < 0.08
    assert solution.R_nc.shape[1] == (0 if kind == "markers" else len(views.views))


@pytest.mark.usefixtures("little_optimised")
def test_a_loss_that_is_not_finite_is_told(handheld, few_steps_a_call):
    _, _, session = handheld
    broken = dataclasses.replace(
        session, problem=dataclasses.replace(session.problem, x_cam=session.problem.x_cam * np.nan)
    )
    with pytest.raises(PblError, match="a loss that is not finite, after 5 steps") as error:
        solve_implicit(broken, quick(5))
    assert error.value.code == "FIT_DIVERGED"
