"""What is said of a fit whose keypoints have no 3D."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import load_body
from pbl_pipeline.fit.checks import FACING_FAIL_DEG, _depth
from pbl_pipeline.fit.initial_pose import pelvis_path
from pbl_pipeline.keypoints import check_keypoints
from tests.inputs import keypoints
from tests.walking_fit import LEVEL_CAMERA_QUAT_WXYZ, walking_fit, with_level_pelvis

BODY = load_body()
FIT = with_level_pelvis(walking_fit(BODY.joint_names, BODY.sha256, name="walk", n_frames=60))


def looking(angle_deg: float) -> Any:
    """The walk, filmed by a level camera at this angle to where the pelvis faces."""
    forward = pelvis_path(BODY, FIT.qpos)[1][:, :, 0].mean(axis=0)
    heading = np.arctan2(forward[1], forward[0]) + np.radians(angle_deg)
    turn = Rotation.from_euler("z", heading) * Rotation.from_quat(LEVEL_CAMERA_QUAT_WXYZ, scalar_first=True)
    quat = turn.as_quat(scalar_first=True)
    return dataclasses.replace(FIT, phone_quat_wxyz=np.tile(quat, (len(FIT.time_s), 1)))


def session(*trials: Any) -> Any:
    return SimpleNamespace(trials=trials, body=BODY)


@pytest.mark.parametrize(("angle", "outcome"), [(0, "FAIL"), (180, "FAIL"), (20, "FAIL"), (45, "WARN"), (90, "WARN")])
def test_one_camera_without_depth(angle: float, outcome: str):
    (check,) = _depth(session(keypoints()), [looking(angle)])
    assert check.outcome == outcome
    assert check.value == pytest.approx(min(angle, 180 - angle), abs=3.0)
    assert check.threshold == FACING_FAIL_DEG
    assert "from the side" in check.advice


def test_the_worst_of_several_trials_counts():
    (check,) = _depth(session(keypoints(), keypoints()), [looking(90), looking(10)])
    assert check.outcome == "FAIL"


def test_a_body_that_turns_round_within_a_moment_fails():
    qpos = FIT.qpos.copy()
    qpos[40:, BODY.joint_names.index("pelvis_rotation")] += np.radians(130)
    turn, _ = _depth(session(keypoints()), [dataclasses.replace(looking(90), qpos=qpos)])
    assert (turn.check, turn.outcome) == ("pelvis_turn_without_3d_deg", "FAIL")
    assert turn.value == pytest.approx(130, abs=10)
    assert "which way a person faces" in turn.advice


def test_with_depth_nothing_is_said():
    seen = keypoints(xyz_cam_m=np.ones((5, 3, 3)))
    assert _depth(session(seen), [looking(0)]) == []
    (check,) = _depth(session(seen, keypoints()), [looking(0), looking(90)])
    assert check.outcome == "WARN"


def test_checks_of_keypoints_do_without_depth():
    names = ("left_hip", "right_hip", "left_ankle")
    checks = check_keypoints(keypoints(names=names, image_size_px=(100, 100)))
    assert {c.check for c in checks} >= {"frames_seen_s"}
