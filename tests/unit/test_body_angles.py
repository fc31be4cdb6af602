"""The body's joint values as angles: degrees, the knee positive in flexion."""

from __future__ import annotations

import numpy as np
import pytest

from pbl_pipeline.body import angle_of, joint_angles, joint_of, load_body


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
