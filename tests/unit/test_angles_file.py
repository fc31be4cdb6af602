"""`<name>.angles.csv`, read back as a stranger would."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit.angles_file import angles_table, write_angles_csv
from tests.walking_fit import walking_fit


@pytest.fixture(scope="module")
def walk():
    body = load_body()
    return walking_fit(body.joint_names, body.sha256, n_frames=40, seen=(5, 40))


def _read(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    with path.open(newline="", encoding="utf-8") as f:
        rows = csv.DictReader(f)
        return list(rows.fieldnames or ()), list(rows)


@pytest.fixture(scope="module")
def written(walk, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of the walk's file."""
    return _read(write_angles_csv(walk, tmp_path_factory.mktemp("angles") / "walk.angles.csv"))


def test_columns_are_time_and_the_joints_in_their_order(walk, written) -> None:
    columns, rows = written
    assert len(rows) == 40
    assert columns[0] == "time_s"
    assert [c for c in columns[1:] if not c.startswith("knee_flexion")] == list(walk.joint_names)
    for side in "rl":
        assert columns[columns.index(f"knee_angle_{side}") + 1] == f"knee_flexion_{side}"


def test_values_are_degrees_and_metres(walk, written) -> None:
    row, column = written[1][20], {n: i for i, n in enumerate(walk.joint_names)}
    assert float(row["time_s"]) == pytest.approx(20 / 30, abs=1e-6)
    assert float(row["pelvis_tx"]) == pytest.approx(walk.qpos[20, column["pelvis_tx"]], abs=1e-5)  # m, not degrees
    for joint in ("pelvis_rotation", "elbow_flex_l", "hip_flexion_r"):
        assert float(row[joint]) == pytest.approx(57.29578 * walk.qpos[20, column[joint]], abs=1e-4)
    assert float(row["pelvis_rotation"]) == pytest.approx(90.0, abs=6)  # she goes along world y


def test_knee_flexion_is_positive_and_opposite_to_the_knee_angle(written) -> None:
    flexion, angle = (np.array([float(r[n]) for r in written[1][5:]]) for n in ("knee_flexion_r", "knee_angle_r"))
    np.testing.assert_allclose(flexion, -angle)
    # One whole cycle of 33 frames: swing bends the knee as far as in a textbook, about 60 deg.
    assert flexion.max() == pytest.approx(60, abs=4)


def test_unknown_frames_are_empty_cells(written) -> None:
    _, rows = written
    assert all(v == "" for k, v in rows[0].items() if k != "time_s")
    assert rows[0]["time_s"] == "0.000000"
    assert all(v != "" for v in rows[5].values())


def test_a_straight_knee_is_not_minus_zero(walk, tmp_path: Path) -> None:
    straight = dataclasses.replace(walk, qpos=np.zeros_like(walk.qpos))
    _, rows = _read(write_angles_csv(straight, tmp_path / "walk.angles.csv"))
    assert rows[3]["knee_flexion_r"] == "0.000000"


def test_damaged_fit_is_refused(walk) -> None:
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        angles_table(dataclasses.replace(walk, qpos=walk.qpos[:, :39]))
