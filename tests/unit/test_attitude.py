"""The phone's orientation: in the keypoints, and as the log of `--attitude`, against cases worked by hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import load_attitude
from tests import refused
from tests.inputs import LEVEL, PHONE_T, UPRIGHT, about, changed, csv_log, keypoints

# --- the phone's orientation in the keypoints -------------------------------------------------------------------


def test_phone_quaternions_become_unit_and_do_not_jump(tmp_path):
    raw = np.array([LEVEL, -3 * LEVEL, 0.2 * LEVEL], np.float32)
    phone = keypoints(phone_time_s=PHONE_T, phone_quat_wxyz=raw)
    assert phone.phone_quat_wxyz is not None
    np.testing.assert_allclose(phone.phone_quat_wxyz, np.tile(LEVEL, (3, 1)), atol=1e-7)
    assert raw[1, 0] == np.float32(-1.5)  # the caller's array is his own
    phone.save(tmp_path / "k.npz")
    again = Keypoints.load(tmp_path / "k.npz")
    assert again.phone_quat_wxyz is not None
    np.testing.assert_allclose(again.phone_quat_wxyz, phone.phone_quat_wxyz)
    np.testing.assert_array_equal(again.phone_time_s, PHONE_T)


BAD_PHONES = {
    "no quaternions": (PHONE_T, None),
    "no times": (None, np.tile(LEVEL, (3, 1))),
    "other lengths": (PHONE_T[:2], np.tile(LEVEL, (3, 1))),
    "three numbers": (PHONE_T, np.ones((3, 3))),
    "flat": (PHONE_T, np.ones(12)),
    "one sample": (PHONE_T[:1], LEVEL[None]),
    "none": (np.zeros(0), np.zeros((0, 4))),
    "repeats": (np.array([0, 0.1, 0.1]), np.tile(LEVEL, (3, 1))),
    "backwards": (PHONE_T[::-1], np.tile(LEVEL, (3, 1))),
    "time NaN": (np.array([0, np.nan, 0.1]), np.tile(LEVEL, (3, 1))),
    "time inf": (np.array([0, 0.1, np.inf]), np.tile(LEVEL, (3, 1))),
    "NaN": (PHONE_T, changed(np.tile(LEVEL, (3, 1)), np.nan)),
    "inf": (PHONE_T, changed(np.tile(LEVEL, (3, 1)), np.inf)),
    "zero": (PHONE_T, np.array([LEVEL, [0, 0, 0, 0], LEVEL])),
    "near zero": (PHONE_T, np.array([LEVEL, 1e-5 * LEVEL, LEVEL])),
    "text": (PHONE_T, np.full((3, 4), "x")),
}


@pytest.mark.parametrize("what", BAD_PHONES)
def test_phone_arrays_that_cannot_be(tmp_path, what):
    time_s, quat = BAD_PHONES[what]
    refused("PHONE_LOG", keypoints, phone_time_s=time_s, phone_quat_wxyz=quat)
    # The same in a file.
    keypoints().save(tmp_path / "k.npz")
    with np.load(tmp_path / "k.npz") as f:
        fields = {k: f[k] for k in f.files}
    fields |= {k: v for k, v in (("phone_time_s", time_s), ("phone_quat_wxyz", quat)) if v is not None}
    np.savez(tmp_path / "bad.npz", **fields)
    refused("PHONE_LOG", Keypoints.load, tmp_path / "bad.npz")


# --- the log of --attitude --------------------------------------------------------------------------------------


def axes(path: Path) -> np.ndarray:
    """Columns: where the camera's right, down and forward point in the world."""
    return Rotation.from_quat(load_attitude(path).quat_wxyz[0], scalar_first=True).as_matrix()


EAST, NORTH, UP = np.eye(3)
COS, SIN = np.cos(np.radians(20)), np.sin(np.radians(20))


@pytest.mark.parametrize(
    ("quat", "right", "down", "forward"),
    [
        (UPRIGHT, EAST, -UP, NORTH),
        # Its top tipped forward by 20 degrees: 70 degrees from lying flat.
        (about(0, 70), EAST, -COS * UP - SIN * NORTH, COS * NORTH - SIN * UP),
        # Flat on the table, screen up: the camera looks straight down, the picture's bottom is the phone's.
        ([1, 0, 0, 0], EAST, -NORTH, -UP),
    ],
    ids=["horizon", "20 deg down", "flat"],
)
def test_a_phone_in_portrait(tmp_path, quat, right, down, forward):
    path = csv_log(tmp_path / "a.csv", quat, {"frame": "device"})
    np.testing.assert_allclose(axes(path), np.column_stack([right, down, forward]), atol=1e-9)


@pytest.mark.parametrize(("rotation_deg", "top"), [(90, EAST), (270, -EAST), (180, -UP), (0, UP)])
def test_a_phone_turned_with_its_picture_upright(tmp_path, rotation_deg, top):
    """The phone's axes in the world, built from where its top points: the camera still looks north, level."""
    R_nd = np.column_stack([np.cross(top, -NORTH), top, -NORTH])
    quat = Rotation.from_matrix(R_nd).as_quat(scalar_first=True).tolist()
    path = csv_log(tmp_path / "a.csv", quat, {"frame": "device", "rotation_deg": rotation_deg})
    np.testing.assert_allclose(axes(path), np.column_stack([EAST, -UP, NORTH]), atol=1e-9)
    if rotation_deg:
        forgotten = csv_log(tmp_path / "b.csv", quat, {"frame": "device"})
        assert "rotation_deg" in refused("PHONE_LOG", load_attitude, forgotten).next_step


def test_a_log_in_the_cameras_frame_is_taken_as_it_is(tmp_path):
    # Level, along world x: the camera's right is -y, its down -z (docs/files.md).
    path = csv_log(tmp_path / "a.csv", [2 * q for q in LEVEL], begin_s=10.0)
    np.testing.assert_allclose(axes(path), np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), atol=1e-9)
    log = load_attitude(path)
    np.testing.assert_allclose(log.time_s, [10, 10.02, 10.04])
    np.testing.assert_allclose(np.linalg.norm(log.quat_wxyz, axis=1), 1)


@pytest.mark.parametrize("quat", [about(0, -90), [0.5, -0.5, -0.5, -0.5]], ids=["inverted", "on its side"])
def test_a_picture_that_would_not_stand_is_refused(tmp_path, quat):
    path = csv_log(tmp_path / "a.csv", quat, {"frame": "device"})
    assert "against gravity" in refused("PHONE_LOG", load_attitude, path).found


HEADER = "time_s,qw,qx,qy,qz"


@pytest.mark.parametrize(
    "text",
    [
        "",
        HEADER,
        f"{HEADER}\n0,1,0,0,0\n",
        f"{HEADER}\n0,1,0,0,0\n0,1,0,0,0\n",
        f"{HEADER}\n1,1,0,0,0\n0,1,0,0,0\n",
        f"{HEADER}\n0,1,0,0,0\n1,0,0,0,0\n",
        f"{HEADER}\n0,1,0,0,0\n1,nan,0,0,0\n",
        f"{HEADER}\n0,1,0,0,0\n1,1,0,0\n",
        f"{HEADER}\n0,1,0,0,0\n1,one,0,0,0\n",
        "time,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n",
        f"{HEADER},frame\n0,1,0,0,0,device\n1,1,0,0,0,camera\n",
        f"{HEADER},frame\n0,1,0,0,0,world\n1,1,0,0,0,world\n",
        f"{HEADER},frame,rotation_deg\n0,1,0,0,0,device,45\n1,1,0,0,0,device,45\n",
        f"{HEADER},rotation_deg\n0,1,0,0,0,90\n1,1,0,0,0,90\n",
        "[1]",
        "{",
        '{"time_s": [0, 1]}',
        '{"time_s": [0, 1], "qw": [1, 1], "qx": [0, 0], "qy": [0, 0], "qz": [0]}',
        '{"time_s": [0, 1], "qw": "one", "qx": [0, 0], "qy": [0, 0], "qz": [0, 0]}',
    ],
)
def test_logs_that_cannot_be(tmp_path, text):
    (tmp_path / "log").write_text(text)
    refused("PHONE_LOG", load_attitude, tmp_path / "log")


def test_logs_that_are_no_text_or_not_there(tmp_path):
    (tmp_path / "log").write_bytes(b"\xff\xfe\x00\x81")
    refused("PHONE_LOG", load_attitude, tmp_path / "log")
    refused("FILE_MISSING", load_attitude, tmp_path / "none")
