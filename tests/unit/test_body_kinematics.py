"""MJX against C MuJoCo, gradients against finite differences of C MuJoCo, scaling against hand-worked cases."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pbl_pipeline.body import (
    MARKER_SETS,
    SCALE_NAMES,
    Body,
    MarkerSet,
    body_poses,
    capsules,
    load_body,
    marker_positions,
    marker_set,
    mjx_frames,
)

pytestmark = pytest.mark.usefixtures("little_optimised")

#: body -> group, written out so that it does not come from the code under test.
GROUP = {"pelvis": "pelvis", "torso": "overall", "head": "overall"}
for _side, _word in (("r", "right"), ("l", "left")):
    GROUP |= {f"femur_{_side}": f"{_word}_thigh"}
    GROUP |= {f"{b}_{_side}": f"{_word}_leg_and_foot" for b in ("tibia", "talus", "calcn", "toes")}
    GROUP |= {f"{b}_{_side}": f"{_word}_arm" for b in ("humerus", "ulna", "radius", "hand")}


def of(scale: np.ndarray, body_name: str) -> float:
    return float(scale[SCALE_NAMES.index(GROUP[body_name])])


def in_c_mujoco(body: Body, qpos: np.ndarray, scale: np.ndarray) -> Iterator[mujoco.MjData]:
    """Each pose in double precision: scale the model, run mj_kinematics."""
    model = copy.copy(body.mj_model)
    for i in range(1, model.nbody):
        parent = model.body(int(model.body_parentid[i])).name
        if parent != "world":
            model.body_pos[i] *= of(scale, parent)
    data = mujoco.MjData(model)
    for pose in np.atleast_2d(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        yield data


def c_mujoco(body: Body, markers: MarkerSet, qpos: np.ndarray, scale: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(T, J, 3): the markers placed by hand on the bodies as C MuJoCo has them."""
    out = []
    for data in in_c_mujoco(body, qpos, scale):
        points = []
        for name, position in zip(markers.body_names, markers.position_m + offset, strict=True):
            at = data.body(name)
            points.append(at.xpos + at.xmat.reshape(3, 3) @ (of(scale, name) * position))
        out.append(points)
    return np.array(out)


def random_poses(body: Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Within the limits; the pelvis anywhere within 2 m and in any orientation."""
    free = np.array([[-2.0, 2.0]] * 3 + [[-np.pi, np.pi]] * 3)
    limits = body.joint_range_rad.copy()
    limits[:6] = free
    return rng.uniform(limits[:, 0], limits[:, 1], (count, 40))


@pytest.mark.parametrize("name", MARKER_SETS)
def test_matches_c_mujoco_at_100_random_poses(name):
    body, markers = load_body(), marker_set(name)
    rng = np.random.default_rng(1)
    qpos = random_poses(body, 100, rng)
    scale, offset = rng.uniform(0.7, 1.3, 8), rng.normal(0, 0.02, (len(markers), 3))
    ours = np.asarray(marker_positions(body, markers, qpos, scale, offset))
    assert ours.dtype == np.float32
    np.testing.assert_allclose(ours, c_mujoco(body, markers, qpos, scale, offset), atol=1e-5)


@pytest.mark.parametrize("scale", [np.ones(8), np.random.default_rng(3).uniform(0.8, 1.25, 8)], ids=["1", "random"])
def test_bodies_are_where_c_mujoco_has_them(scale):
    body = load_body()
    qpos = random_poses(body, 100, np.random.default_rng(2))
    xpos, xmat = body_poses(body, qpos, scale)
    for t, data in enumerate(in_c_mujoco(body, qpos, scale)):
        np.testing.assert_allclose(xpos[t], data.xpos[1:], atol=1e-5)
        np.testing.assert_allclose(xmat[t], data.xmat[1:].reshape(-1, 3, 3), atol=1e-5)


@pytest.mark.slow
def test_mjx_has_the_markers_where_c_mujoco_has_them():
    body, markers, rng = load_body(), marker_set("bml_movi_87"), np.random.default_rng(2)
    qpos, scale, offset = random_poses(body, 2, rng), rng.uniform(0.8, 1.25, 8), rng.normal(0, 0.02, (87, 3))
    found = marker_positions(body, markers, qpos, scale, offset, forward=mjx_frames)
    np.testing.assert_allclose(found, c_mujoco(body, markers, qpos, scale, offset), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_gradients_match_finite_differences_of_c_mujoco(seed):
    body, markers = load_body(), marker_set("blazepose_33")
    rng = np.random.default_rng(seed)
    values = (random_poses(body, 1, rng)[0], rng.uniform(0.8, 1.2, 8), rng.normal(0, 0.02, (33, 3)))
    weight = rng.normal(size=(33, 3))

    def ours(*v):
        # Curved in the positions, so that a wrong position shows in the gradient too.
        return jnp.sum(jnp.asarray(weight) * jnp.sin(marker_positions(body, markers, *v)))

    def truth(*v) -> float:
        return float(np.sum(weight * np.sin(c_mujoco(body, markers, *v)[0])))

    gradients = jax.grad(ours, argnums=(0, 1, 2))(*(jnp.asarray(v) for v in values))
    step = 1e-6
    for which, gradient in enumerate(gradients):
        expected = np.empty(values[which].size)
        for i in range(expected.size):
            ends = []
            for sign in (1, -1):
                changed = [v.copy() for v in values]
                changed[which].flat[i] += sign * step
                ends.append(truth(*changed))
            expected[i] = (ends[0] - ends[1]) / (2 * step)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(np.ravel(gradient), expected, atol=2e-5 * np.abs(expected).max() + 1e-5)


@pytest.mark.slow
def test_forward_mode_and_second_derivatives():
    """The closed-form derivative can itself be differentiated: its change along a line, against differences."""
    body, markers = load_body(), marker_set("mpi_inf_3dhp_17")
    rng = np.random.default_rng(6)
    qpos, along = random_poses(body, 1, rng)[0], rng.normal(size=40)
    scale, offset = rng.uniform(0.8, 1.2, 8), np.zeros((17, 3))
    weight = rng.normal(size=(17, 3))

    def on_line(s):
        return jnp.sum(weight * marker_positions(body, markers, jnp.asarray(qpos) + s * along, scale, offset))

    def truth(s: float) -> float:
        return float(np.sum(weight * c_mujoco(body, markers, qpos + s * along, scale, offset)[0]))

    step = 1e-3
    first = (truth(step) - truth(-step)) / (2 * step)
    second = (truth(step) - 2 * truth(0.0) + truth(-step)) / step**2

    @jax.jit
    def both(s):
        return jax.jvp(on_line, (s,), (1.0,))[1], jax.jvp(jax.grad(on_line), (s,), (1.0,))[1]

    ours = both(0.0)
    assert abs(second) > 1
    assert float(ours[0]) == pytest.approx(first, rel=1e-3)
    assert float(ours[1]) == pytest.approx(second, rel=1e-3)


@pytest.mark.slow
def test_gradient_is_finite_at_zero():
    body, markers = load_body(), marker_set("blazepose_33")

    def total(q, s, o):
        return jnp.sum(marker_positions(body, markers, q, s, o) ** 2)

    for gradient in jax.grad(total, argnums=(0, 1, 2))(jnp.zeros(40), jnp.ones(8), jnp.zeros((33, 3))):
        assert np.all(np.isfinite(gradient))


def test_leading_dimensions_jit_and_vmap_agree():
    body, markers = load_body(), marker_set("mpi_inf_3dhp_17")
    rng = np.random.default_rng(3)
    qpos = random_poses(body, 100, rng)
    scale, offset = rng.uniform(0.8, 1.2, 8), rng.normal(0, 0.01, (17, 3))

    def at(q, s, o):
        return marker_positions(body, markers, q, s, o)

    flat = np.asarray(at(qpos, scale, offset))
    assert flat.shape == (100, 17, 3)
    one = at(qpos[7], scale, offset)
    assert one.shape == (17, 3)
    np.testing.assert_allclose(one, flat[7], atol=1e-6)
    grid = at(qpos.reshape(4, 25, 40), scale, offset)
    assert grid.shape == (4, 25, 17, 3)
    np.testing.assert_allclose(np.reshape(grid, (100, 17, 3)), flat, atol=1e-6)
    # Several bodies at once: one scale and one set of offsets each.
    scales, offsets = np.stack([scale, np.ones(8)]), np.stack([offset, 0 * offset])
    both = jax.jit(jax.vmap(at, in_axes=(None, 0, 0)))(qpos, scales, offsets)
    np.testing.assert_allclose(both[0], flat, atol=1e-5)
    np.testing.assert_allclose(both[1], at(qpos, np.ones(8), 0 * offset), atol=1e-5)


def neutral(scale: dict[str, float], offset: dict[str, list[float]] | None = None) -> dict[str, np.ndarray]:
    body, markers = load_body(), marker_set("blazepose_33")
    factors, offsets = np.ones(8), np.zeros((33, 3))
    for name, value in scale.items():
        factors[SCALE_NAMES.index(name)] = value
    for name, value in (offset or {}).items():
        offsets[markers.names.index(name)] = value
    x = np.asarray(marker_positions(body, markers, np.zeros(40), factors, offsets))
    return dict(zip(markers.names, x, strict=True))


def test_a_longer_thigh_lowers_the_knee_by_its_share():
    before, after = neutral({}), neutral({"left_thigh": 1.1})
    # The tibia hangs at (-0.00167, -0.36555, 0) of the femur: forward and up of the world.
    shift = np.array([-0.000167, 0, -0.036555])
    for name in ("left_knee", "left_ankle", "left_heel", "left_foot_index"):
        np.testing.assert_allclose(after[name] - before[name], shift, atol=1e-6)
    for name in set(before) - {"left_knee", "left_ankle", "left_heel", "left_foot_index"}:
        np.testing.assert_allclose(after[name], before[name], atol=1e-6)


def test_overall_scales_torso_and_head_only():
    before, after = neutral({}), neutral({"overall": 1.2})
    np.testing.assert_allclose(after["right_hip"], before["right_hip"], atol=1e-6)
    np.testing.assert_allclose(after["right_heel"], before["right_heel"], atol=1e-6)
    # Shoulder at (0.0034, 0.40024, 0.18315) of the torso; the arm hangs from it with its own length.
    shift = 0.2 * np.array([0.0034, -0.18315, 0.40024])
    for name in ("right_shoulder", "right_elbow", "right_wrist"):
        np.testing.assert_allclose(after[name] - before[name], shift, atol=1e-6)
    # Head at 0.54146 above the torso's origin, the nose 0.145 before and 0.05 above it.
    np.testing.assert_allclose(after["nose"] - before["nose"], 0.2 * np.array([0.145, 0, 0.59146]), atol=1e-6)


def test_the_pelvis_origin_does_not_move_with_any_scale():
    body = load_body()
    xpos, _ = body_poses(body, np.zeros(40), np.full(8, 1.3))
    np.testing.assert_allclose(xpos[0], [0, 0, 0.975], atol=1e-6)


def test_offsets_are_scaled_with_their_body():
    base = neutral({"right_leg_and_foot": 1.5})
    moved = neutral({"right_leg_and_foot": 1.5}, {"right_heel": [0.01, 0.02, 0.03]})
    # Body x, y, z are x, z and -y of the world in the neutral pose.
    np.testing.assert_allclose(moved["right_heel"] - base["right_heel"], [0.015, -0.045, 0.03], atol=1e-6)
    np.testing.assert_allclose(moved["right_ankle"], base["right_ankle"], atol=1e-7)


def test_capsules_follow_the_body():
    body = load_body()
    rng = np.random.default_rng(5)
    qpos, scale = random_poses(body, 3, rng), rng.uniform(0.8, 1.2, 8)
    qpos[1] = np.nan
    shapes = capsules(body, qpos, scale)
    count = len(shapes.names)
    assert shapes.start.shape == shapes.end.shape == (3, count, 3)
    assert len(set(shapes.names)) == count
    assert np.all(np.isnan(shapes.start[1]))
    assert np.all(np.isfinite(shapes.start[[0, 2]]))
    plain = capsules(body, np.zeros((1, 40)), np.ones(8))
    for i, name in enumerate(shapes.body_names):
        assert shapes.radius_m[i] == pytest.approx(of(scale, name) * plain.radius_m[i])
        length = np.linalg.norm(shapes.end[0, i] - shapes.start[0, i])
        assert length == pytest.approx(of(scale, name) * np.linalg.norm(plain.end[0, i] - plain.start[0, i]))
    # The lower thigh ends at the knee, in the pose as in the model.
    knee = np.asarray(body_poses(body, qpos[2], scale)[0])[body.body_names.index("tibia_r")]
    end = shapes.end[2, shapes.names.index("lower_thigh_r")]
    assert np.linalg.norm(end - knee) < 0.02


def test_an_ellipsoid_keeps_its_outline_as_capsules():
    body = load_body()
    shapes = capsules(body, np.zeros((1, 40)), np.ones(8))
    chest = [i for i, n in enumerate(shapes.names) if n.startswith("chest")]
    ends = np.concatenate([shapes.start[0, chest], shapes.end[0, chest]])
    radius = shapes.radius_m[chest].max()
    model = body.mj_model
    half = model.geom("chest").size  # x forward, y up, z right of the torso = x, z, y of the world
    assert np.ptp(ends[:, 0]) / 2 + radius == pytest.approx(half[0], rel=0.02)
    assert np.ptp(ends[:, 1]) / 2 + radius == pytest.approx(half[2], rel=0.02)
    assert np.ptp(ends[:, 2]) / 2 + radius == pytest.approx(half[1], rel=0.08)
