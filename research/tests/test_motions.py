"""Recorded motions of other laboratories on our body: conventions, units and signs, and the refusal of wrong ones."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.body import joint_angles, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.synthetic import pelvis_positions, plain_walk, sole_points
from research.corpus.motions import read_index, read_motion, read_motions, stride_s
from research.walker.turns import turned

BODY = load_body()
COLUMN = {n: i for i, n in enumerate(BODY.joint_names)}
FIELDS = ("path", "repo", "commit", "licence", "what", "person", "activity", "model", "rate_hz", "units", "knee_sign")


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray]:
    """Our own walker as another laboratory would have recorded it: (T,) s, (T, 40)."""
    time = np.arange(0, 3, 0.01)
    return time, plain_walk(time, heading_rad=0.0)


def _folder(path: Path, time: np.ndarray, qpos: np.ndarray, *, knee: float = -1.0, scale: float = 1.0, **row) -> Path:
    """A folder with one OpenSim motion of a knee that is positive (1) or negative (-1) in flexion."""
    joints = [n for n in BODY.joint_names if n not in ("pelvis_tx", "pelvis_ty", "pelvis_tz")]
    columns = {n: scale * qpos[:, COLUMN[n]] * (-1 if n.startswith("knee") and knee > 0 else 1) for n in joints}
    rest = BODY.mj_model.body("pelvis").pos[2]
    columns |= {f"pelvis_t{a}": qpos[:, COLUMN[f"pelvis_t{a}"]] + (rest + 1.2 if a == "y" else 0) for a in "xyz"}
    lines = ["Coordinates", f"inDegrees={'yes' if scale != 1 else 'no'}", "endheader", "\t".join(["time", *columns])]
    values = np.column_stack([time, *columns.values()])
    lines += ["\t".join(f"{v:.6f}" for v in row) for row in values]
    (path / "walk.mot.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    entry = dict.fromkeys(FIELDS, "") | {
        "path": "walk.mot.gz",
        "what": "IK",
        "person": "one",
        "activity": "walking",
        "rate_hz": "100",
        "units": "deg" if scale != 1 else "rad",
        "knee_sign": "+flex" if knee > 0 else "-flex",
    }
    with (path / "index.csv").open("w", newline="") as file:
        csv.writer(file).writerows([FIELDS, (entry | row).values()])
    return path


@pytest.mark.parametrize(("knee", "scale"), [(-1.0, 1.0), (1.0, 180 / np.pi)])
def test_a_motion_comes_back_whatever_unit_and_knee_sign_are_stated(tmp_path, walk, knee, scale):
    time, qpos = walk
    (motion,) = read_motions(_folder(tmp_path, time, qpos, knee=knee, scale=scale))
    turning = [i for n, i in COLUMN.items() if n not in ("pelvis_tx", "pelvis_ty", "pelvis_tz")]
    moves = np.ptp(qpos, axis=0) > 1e-3
    assert np.abs(motion.qpos[:, turning] - qpos[:, turning])[:, moves[turning]].max() < 1e-5
    assert (motion.person, motion.activity, motion.cycle) == ("one", "walk", False)
    assert motion.rate_hz == pytest.approx(100)
    assert motion.heading_rad == pytest.approx(0, abs=0.02)
    # On the floor, and as far as the walk went.
    lowest = np.min([s[:, :, 2].min(axis=1) for s in sole_points(motion.qpos).values()], axis=0)
    assert np.abs(lowest).max() < 0.012
    gone = np.linalg.norm(np.ptp(pelvis_positions(motion.qpos)[:, :2], axis=0))
    assert gone == pytest.approx(1.2 * 2.99, rel=0.05)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"knee_sign": "+flex"}, "REFERENCE_INPUT"),
        ({"knee_sign": ""}, "REFERENCE_INPUT"),
        ({"units": "deg"}, "ANGLE_UNITS"),
        ({"units": ""}, "none read"),
    ],
)
def test_a_file_that_contradicts_its_row_is_refused(tmp_path, walk, change, code):
    folder = _folder(tmp_path, *walk, **change)
    if code == "none read":
        assert read_motions(folder) == []
        return
    with pytest.raises(PblError, match=rf"^{code}: "):
        read_motions(folder)


@pytest.mark.parametrize(
    ("joint", "deg", "code"),
    [("pelvis_tilt", 25.0, "REFERENCE_INPUT"), ("ankle_angle", 25.0, "REFERENCE_INPUT"), ("all", 57.3, "ANGLE_UNITS")],
)
def test_a_pelvis_or_foot_that_no_walker_has_is_refused(tmp_path, walk, joint, deg, code):
    time, qpos = walk
    qpos = qpos.copy()
    if joint == "all":
        qpos *= deg  # degrees that are called radians
    else:
        qpos[:, [i for n, i in COLUMN.items() if n.startswith(joint)]] += np.radians(deg)
    with pytest.raises(PblError, match=rf"^{code}: "):
        read_motions(_folder(tmp_path, time, qpos))


def test_a_locked_joint_is_not_known(tmp_path, walk):
    time, qpos = walk
    qpos = qpos.copy()
    qpos[:, COLUMN["lumbar_extension"]] = 0.0
    (motion,) = read_motions(_folder(tmp_path, time, qpos))
    assert not motion.known[COLUMN["lumbar_extension"]]
    assert motion.known[COLUMN["hip_flexion_l"]]


def test_a_turned_motion_is_the_same_elsewhere(walk):
    _, qpos = walk
    around = turned(qpos, 0.7)
    x, y = pelvis_positions(qpos)[:, :2].T
    expected = np.column_stack([np.cos(0.7) * x - np.sin(0.7) * y, np.sin(0.7) * x + np.cos(0.7) * y])
    assert np.abs(pelvis_positions(around)[:, :2] - expected).max() < 1e-9
    before, after = sole_points(qpos)["r"], sole_points(around)["r"]
    assert np.abs(before[:, :, 2] - after[:, :, 2]).max() < 1e-9
    assert np.abs(turned(around, -0.7) - qpos).max() < 1e-9


def test_a_stride_is_found_in_a_knee():
    time = np.arange(0, 5, 0.01)
    assert stride_s(time, plain_walk(time, stride_s=1.07)[:, COLUMN["knee_angle_r"]]) == pytest.approx(1.07, abs=0.011)


# ---- the real recordings


@pytest.fixture(scope="module")
def recordings(shared_data):
    folder = shared_data / "real" / "motions"
    if not folder.is_dir():
        pytest.skip("the recorded motions (../shared/data/real/motions) are absent")
    return {m.name: m for m in read_motions(folder)}


@pytest.mark.parametrize(
    ("name", "person", "activity", "seconds", "hip", "knee", "joints"),
    [
        # OpenSim in radians, knee negative in flexion; in degrees, knee positive.
        ("levelground_ccw_fast_01_01_ik.mot", "Camargo2021 one AB subject", "walk", 15.3, 6.6, 22.5, 18),
        ("Squats.mot", "CMBBE2024 demo subject (1.79 m 80 kg)", "squat", 15.6, 29.2, 34.3, 31),
        # SIMM names of a child in crouch; Plug-in Gait less 12 deg at the hip; ISB in radians; cycles of one leg.
        ("KS_Gait_average_r.mot", "CP child subject1 (Falisse 2020)", "walk", 1.0, 17.7, 50.7, 17),
        ("PiG_Motion-FlatFoot-Hole_angles.csv", "BTK PiG person A", "walk", 3.2, 6.4 - 12, 13.1, 18),
        ("sit-stand_participant_01.csv.10", "LBMC participant_01", "sit_to_stand", 9.0, 44.1, 54.3, 6),
        ("ExperimentalData_Qs_11trials.csv:1", "Falisse2019 subject1 (adult)", "walk", 1.0, 9.9, 29.8, 19),
    ],
)
def test_real_recordings_of_each_convention(recordings, name, person, activity, seconds, hip, knee, joints):
    motion = recordings[name]
    angles = joint_angles(BODY.joint_names, motion.qpos)
    assert (motion.person, motion.activity, int(motion.known.sum())) == (person, activity, joints)
    assert motion.time_s[-1] == pytest.approx(seconds, abs=0.1)
    assert angles["hip_flexion_r"].mean() == pytest.approx(hip, abs=0.5)
    assert angles["knee_flexion_r"].mean() == pytest.approx(knee, abs=0.5)


def test_real_persons_can_be_set_apart(recordings):
    persons = {m.person for m in recordings.values()}
    assert len(persons) == 17
    # The fastest sprint is in two repositories under two names.
    assert {m.person for n, m in recordings.items() if n.startswith(("run0", "JA1"))} == {"sprinter JA1"}
    assert len({m.person for m in recordings.values() if m.activity == "walk"}) == 10
    assert not any(m.quality.startswith("low") for m in recordings.values())


def test_real_files_with_another_sign_or_unit_are_refused(shared_data):
    folder = shared_data / "real" / "motions"
    rows = {Path(r["path"]).name: r for r in read_index(folder)}
    walk, squat, isb = rows["FunctionalWalk_angles.csv.gz"], rows["DLS01_ik.mot.gz"], rows["gait_participant_01.csv.gz"]
    for row, change, code in (
        (squat, {"units": "deg"}, "ANGLE_UNITS"),
        (squat, {"knee_sign": "-flex"}, "REFERENCE_INPUT"),
        (isb, {"units": "deg"}, "ANGLE_UNITS"),
        (isb, {"knee_sign": "+flex"}, "REFERENCE_INPUT"),
        (walk, {"units": "rad"}, "ANGLE_UNITS"),
    ):
        with pytest.raises(PblError, match=rf"^{code}: "):
            read_motion(folder, row | change)
