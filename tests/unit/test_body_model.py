"""The model against the published figures and against how a body moves."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline import body as package
from pbl_pipeline.body import angle_of, body_poses, capsules, joint_angles, joint_of, load_body

DATA = Path(package.__file__).parent / "data"

JOINTS = (
    "pelvis_tx pelvis_tz pelvis_ty pelvis_tilt pelvis_list pelvis_rotation "
    "hip_flexion_r hip_adduction_r hip_rotation_r knee_angle_r ankle_angle_r subtalar_angle_r mtp_angle_r "
    "hip_flexion_l hip_adduction_l hip_rotation_l knee_angle_l ankle_angle_l subtalar_angle_l mtp_angle_l "
    "lumbar_extension lumbar_bending lumbar_rotation neck_extension neck_bending neck_rotation "
    "arm_flex_r arm_add_r arm_rot_r elbow_flex_r pro_sup_r wrist_flex_r wrist_dev_r "
    "arm_flex_l arm_add_l arm_rot_l elbow_flex_l pro_sup_l wrist_flex_l wrist_dev_l"
)


def pose(**degrees: float) -> np.ndarray:
    """qpos with the named joints in degrees (slides in metres)."""
    body = load_body()
    qpos = np.zeros(40)
    for name, value in degrees.items():
        qpos[body.joint_names.index(name)] = (
            value if name.startswith("pelvis_t") and name != "pelvis_tilt" else (np.deg2rad(value))
        )
    return qpos


def origins(qpos: np.ndarray, names: list[str]) -> np.ndarray:
    """World positions of the origins of the named bodies, unscaled."""
    body = load_body()
    xpos, _ = body_poses(body, qpos, np.ones(8))
    return np.asarray(xpos)[[body.body_names.index(n) for n in names]]


def test_joints_bodies_and_mass():
    body = load_body()
    assert " ".join(body.joint_names) == JOINTS
    assert len(body.body_names) == 21
    assert body.mj_model.nq == body.mj_model.nv == 40
    # Summed by hand from the figures.
    assert body.mj_model.body_mass.sum() == pytest.approx(89.2863, abs=1e-4)
    assert np.all(body.mj_model.geom_contype == 0)
    assert np.all(body.mj_model.geom_conaffinity == 0)


def test_limits():
    body = load_body()
    limits = dict(zip(body.joint_names, np.rad2deg(body.joint_range_rad), strict=True))
    assert limits["knee_angle_r"] == pytest.approx([-160, 10])
    assert limits["hip_flexion_l"] == pytest.approx([-45.1, 120])
    for name in body.joint_names[:6]:
        assert limits[name].tolist() == [-np.inf, np.inf]
    assert np.all(np.isfinite(body.joint_range_rad[6:]))


def test_identity():
    body = load_body()
    assert body.name == "pbl_body_40"
    assert body.version == "1"
    assert body.sha256 == hashlib.sha256((DATA / "pbl_body_40.xml").read_bytes()).hexdigest()
    assert load_body() is body


def test_stands_upright_and_has_a_plausible_height():
    body = load_body()
    shapes = capsules(body, np.zeros((1, 40)), np.ones(8))
    top = np.max(np.maximum(shapes.start[0, :, 2], shapes.end[0, :, 2]) + shapes.radius_m)
    bottom = np.min(np.minimum(shapes.start[0, :, 2], shapes.end[0, :, 2]) - shapes.radius_m)
    assert 1.70 < top - bottom < 1.90
    # Pelvis height 0.975 m is that of a body standing on z = 0.
    assert abs(bottom) < 0.03
    head, toes, heel = origins(np.zeros(40), ["head", "toes_r", "calcn_r"])
    assert head[2] > 1.5
    # Looks along world x: the toes are in front of the heel.
    assert toes[0] - heel[0] > 0.15


def test_pelvis_moves_in_the_world():
    start = origins(np.zeros(40), ["pelvis"])[0]
    np.testing.assert_allclose(start, [0, 0, 0.975], atol=1e-6)
    # x forward, y up, z right of the body are x, z and -y of the world.
    moved = origins(pose(pelvis_tx=0.1, pelvis_ty=0.2, pelvis_tz=0.3), ["pelvis"])[0]
    np.testing.assert_allclose(moved - start, [0.1, -0.3, 0.2], atol=1e-6)


def test_pelvis_rotation_turns_left():
    toes, heel = origins(pose(pelvis_rotation=90), ["toes_r", "calcn_r"])
    assert (toes - heel)[1] > 0.15


@pytest.mark.parametrize("side", ["r", "l"])
@pytest.mark.parametrize(
    ("joint", "degrees", "moving", "direction"),
    [
        # direction in the world: x forward, z up, and "medial" towards the other side
        ("hip_flexion", 30, "tibia", "forward"),
        ("hip_adduction", 20, "calcn", "medial"),
        ("hip_rotation", 30, "toes", "medial"),
        ("knee_angle", -60, "talus", "backward"),
        ("ankle_angle", 20, "toes", "up"),
        ("arm_flex", 45, "ulna", "forward"),
        ("arm_add", -45, "ulna", "lateral"),
        ("elbow_flex", 60, "hand", "forward"),
    ],
)
def test_equal_sign_is_equal_movement_on_both_sides(side, joint, degrees, moving, direction):
    name = f"{moving}_{side}"
    before = origins(np.zeros(40), [name])[0]
    moved = origins(pose(**{f"{joint}_{side}": degrees}), [name])[0] - before
    medial = np.array([0, 1.0, 0]) if side == "r" else np.array([0, -1.0, 0])
    towards = {
        "forward": np.array([1.0, 0, 0]),
        "backward": np.array([-1.0, 0, 0]),
        "up": np.array([0, 0, 1.0]),
        "medial": medial,
        "lateral": -medial,
    }[direction]
    assert moved @ towards > 0.03


@pytest.mark.parametrize(
    ("joint", "towards"),
    [
        ("lumbar_extension", [-1, 0, 0]),  # leans back
        ("lumbar_bending", [0, -1, 0]),  # to the right
    ],
)
def test_trunk_signs(joint, towards):
    moved = origins(pose(**{joint: 20}), ["head"])[0] - origins(np.zeros(40), ["head"])[0]
    assert moved @ np.array(towards) > 0.1


# --- The body's joint values as angles: degrees, the knee positive in flexion.


def test_the_knee_alone_is_turned_and_back_again():
    names = [n for n in load_body().joint_names if not n.startswith("pelvis_t")]
    turned = {n: angle_of(n) for n in names}
    assert {n for n, (_, sign) in turned.items() if sign < 0} == {"knee_angle_r", "knee_angle_l"}
    assert turned["knee_angle_l"] == ("knee_flexion_l", -1.0)
    assert all(joint_of(angle) == (n, sign) for n, (angle, sign) in turned.items())
    assert joint_of("knee_flexion") == ("knee_angle", -1.0)


def test_angles_are_degrees_of_the_joints_that_turn():
    body = load_body()
    qpos = np.zeros((3, len(body.joint_names)))
    qpos[:, body.joint_names.index("knee_angle_r")] = -np.radians([0.0, 30.0, np.nan])
    qpos[:, body.joint_names.index("hip_flexion_l")] = np.radians(-10.0)
    angles = joint_angles(body.joint_names, qpos)
    assert len(angles) == len(body.joint_names) - 3
    assert not {"pelvis_tx", "knee_angle_r"} & angles.keys()
    assert angles["knee_flexion_r"] == pytest.approx([0.0, 30.0, np.nan], nan_ok=True)
    assert angles["hip_flexion_l"] == pytest.approx([-10.0] * 3)
