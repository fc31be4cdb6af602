"""Worlds, units and times of markers and rigs against the body that moves in them."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import MARKER_SETS, load_body, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, check_trial, read_markers
from pbl_pipeline.fit.checks import _vertical
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.fit.world_checks import in_upright_world
from pbl_pipeline.gait import load_events
from pbl_pipeline.keypoints import MultiView, WorldMarkers
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.video import CameraPose
from research.walker.views import observe_markers, observe_views
from tests.command import pbl

NAME = "bml_movi_87"
PARAMS = METHODS.find().params
X_UP, Y_UP = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
#: World of the walk to another one: rotations that take z to another axis.
WORLDS = {"+y": Y_UP, "-y": Y_UP.T, "-z": np.diag([1.0, -1, -1]), "+x": X_UP, "-x": X_UP.T}


@functools.cache
def walk(seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(0, seconds, 1 / 30)
    return plain_walk(time, stride_s=1.1, speed_m_per_s=1.2, start_m=(6.0, -2.2), camera_height_m=0), time


def markers(name: str = NAME, qpos: np.ndarray | None = None) -> WorldMarkers:
    walked, time = walk()
    pose = walked if qpos is None else qpos
    return observe_markers(pose, time, marker_set=name, noise_m=0.005, drop_share=0.05)


@functools.cache
def rig() -> MultiView:
    qpos, time = walk()
    return observe_views(qpos, time, n_views=3, marker_set="halpe_26", seed=1)


def folded(knee_deg: float, hip_deg: float) -> np.ndarray:
    """A person who stays with bent knees and hips and an upright trunk, facing +y."""
    qpos, joints = np.tile(walk()[0][:1], (len(walk()[1]), 1)), list(load_body().joint_names)
    for name, deg in (("knee_angle", -knee_deg), ("hip_flexion", hip_deg)):
        for side in "rl":
            qpos[:, joints.index(f"{name}_{side}")] = np.radians(deg)
    return qpos


def moved(trial: WorldMarkers, turn: np.ndarray) -> WorldMarkers:
    return dataclasses.replace(trial, xyz_world_m=trial.xyz_world_m @ turn.T)


def refused(trial: WorldMarkers | MultiView, code: str = "FIT_INPUT") -> str:
    with pytest.raises(PblError) as error:
        check_trial(trial, "walk")
    assert error.value.code == code
    return error.value.found


@pytest.mark.parametrize("name", MARKER_SETS)
@pytest.mark.parametrize("axis", WORLDS)
def test_a_world_with_another_vertical_is_turned(axis: str, name: str):
    right, table = markers(name), marker_set(name)
    assert in_upright_world(right, "walk", table).axis == ""
    found = in_upright_world(moved(right, WORLDS[axis]), "walk", table)
    assert found.axis == axis
    up = found.trial.xyz_world_m
    np.testing.assert_allclose(up[..., 2], right.xyz_world_m[..., 2], atol=1e-9)
    assert found.off_deg > 80


def test_the_fit_gets_the_turned_world_and_reports_it():
    good, wrong = markers(), moved(markers(), WORLDS["-z"])
    session = make_session([good, wrong], ["good", "wrong"], PARAMS)
    z = [np.where(a.c_world > 0, a.x_world[..., 2], 0) for a in session.arrays]
    np.testing.assert_allclose(z[0], z[1], atol=1e-9)
    (check,) = _vertical(session)
    assert (check.check, check.outcome) == ("vertical_from_body", "WARN")
    assert check.advice.startswith("trial wrong: the body stands along -z of the world as read")
    assert _vertical(make_session([good], ["good"], PARAMS)) == []


@pytest.mark.parametrize(("knee", "hip", "lean"), [(90, 90, 0), (130, 110, 30), (0, 60, 60)])
@pytest.mark.parametrize("name", ["bml_movi_87", "blazepose_33", "halpe_26", "opencap_35"])
def test_people_who_sit_squat_and_stoop_are_upright(name: str, knee: float, hip: float, lean: float):
    lean_forward = Rotation.from_rotvec([-np.radians(lean), 0, 0]).as_matrix()
    trial = moved(markers(name, folded(knee, hip)), lean_forward)
    assert in_upright_world(trial, "chair", marker_set(name)).axis == ""


def test_a_vertical_between_axes_is_refused():
    turn = Rotation.from_rotvec(np.radians(70) * np.array([1, 1, 0]) / np.sqrt(2)).as_matrix()
    assert "along no axis" in refused(moved(markers(), turn))


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1000, "millimetres read as metres"),
        (100, "centimetres read as metres"),
        (10, "millimetres read as centimetres"),
        (39.37, "inches read as metres"),
        (3.281, "feet read as metres"),
        (0.1, "centimetres read as millimetres"),
        (1 / 25.4, "inches read as millimetres"),
        (1 / 2.54, "inches read as centimetres"),
    ],
)
def test_bodies_of_another_size_are_refused_with_the_unit(factor: float, said: str):
    trial = markers()
    assert said in refused(dataclasses.replace(trial, xyz_world_m=factor * trial.xyz_world_m))


@pytest.mark.parametrize("factor", [0.55, 1.25])
def test_children_and_tall_people_are_not(factor: float):
    trial = markers()
    check_trial(dataclasses.replace(trial, xyz_world_m=factor * trial.xyz_world_m), "walk")


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (lambda t: 1000 * t, "milliseconds"),
        (lambda t: np.arange(len(t), dtype=float), "frame numbers"),
        (lambda t: t / 10, "strides of 0.11 s"),
        (lambda t: t / 1000, "another unit"),
    ],
)
def test_times_in_another_unit_are_refused(times, said: str):
    trial = markers()
    assert said in refused(dataclasses.replace(trial, time_s=times(trial.time_s)))


def rig_with(change) -> MultiView:
    """The rig with x_camera = R x_world + t changed."""
    poses = []
    for pose in rig().poses:
        R, t = change(pose.R_nc.T, -pose.R_nc.T @ pose.p_nc)
        poses.append(CameraPose(R.T, -R.T @ t))
    return dataclasses.replace(rig(), poses=tuple(poses))


@pytest.mark.parametrize("axis", WORLDS)
def test_a_rig_with_another_vertical_is_turned(axis: str):
    check_trial(rig(), "walk")
    wrong = rig_with(lambda R, t: (R @ WORLDS[axis].T, t))
    session = make_session([wrong], ["walk"], PARAMS)
    assert [t.axis for t in session.turned] == [axis]
    turned = session.trials[0]
    assert isinstance(turned, MultiView)
    at = np.array([p.p_nc for p in turned.poses])
    np.testing.assert_allclose(at[:, 2], [p.p_nc[2] for p in rig().poses], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda R, t: (R, 1000 * t), "translations in millimetres:"),
        (lambda R, t: (R, 100 * t), "translations in centimetres:"),
        (lambda R, t: (R, 39.37 * t), "translations in inches:"),
        (lambda R, t: (R.T, -R.T @ t), "poses the other way round (camera to world):"),
        (lambda R, t: (np.diag([1, -1, -1]) @ R, np.diag([1, -1, -1]) @ t), "camera axes with y up"),
        (lambda R, t: (R.T, -1000 * R.T @ t), "the other way round (camera to world), translations in millimetres:"),
    ],
)
def test_the_refusal_names_what_is_wrong_with_a_calibration(change, said: str):
    assert said in refused(rig_with(change), "VIEWS_DISAGREE")


def test_a_rig_without_metres_whose_rays_meet_is_refused():
    assert "centimetres read as millimetres" in refused(rig_with(lambda R, t: (R, t / 10)))


def trc(path: Path, trial: WorldMarkers, *, unit="m", rate=30.0, time=None, names=None, up="y", scale=1.0) -> Path:
    xyz = scale * trial.xyz_world_m
    xyz = np.stack([xyz[..., 0], xyz[..., 2], -xyz[..., 1]], axis=-1) if up == "y" else xyz
    time, names = trial.time_s if time is None else time, names or trial.names
    n = len(names)
    head = f"PathFileType\t4\t(X/Y/Z)\tw.trc\nDataRate\tNumFrames\tNumMarkers\tUnits\n{rate}\t{len(xyz)}\t{n}\t{unit}\n"
    head += "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\n\t\t" + "\t".join(["X\tY\tZ"] * n) + "\n\n"
    rows = ("\t".join(["" if np.isnan(v) else f"{v:.6g}" for v in frame.ravel()]) for frame in xyz)
    lines = [f"{i}\t{s:.6f}\t{row}" for i, (s, row) in enumerate(zip(time, rows, strict=True), 1)]
    path.write_text(head + "\n".join(lines) + "\n")
    return path


def test_a_trc_with_z_up_is_turned_back(tmp_path: Path):
    trial, table = markers(), marker_set(NAME)
    read = read_markers(trc(tmp_path / "w.trc", trial, up="z"), table).trial
    found = in_upright_world(read, "w", table)
    assert found.axis == "-y"
    np.testing.assert_allclose(found.trial.xyz_world_m, trial.xyz_world_m, atol=1e-5)


@pytest.mark.parametrize("unit", ["meters", "Meter", "metres", "MM", "millimeters", "cm"])
def test_units_of_a_trc(tmp_path: Path, unit: str):
    scale = 1000 if unit.lower().startswith(("mm", "milli")) else 100 if unit == "cm" else 1
    read = read_markers(trc(tmp_path / "w.trc", markers(), unit=unit, scale=scale), marker_set(NAME)).trial
    check_trial(read, "w")


@pytest.mark.parametrize(
    ("factor", "said"), [(1000, "milliseconds"), (30, "frame numbers"), (0.3, "frames 0.01 s apart")]
)
def test_a_rate_that_contradicts_the_times_is_refused(tmp_path: Path, factor: float, said: str):
    trial = markers()
    with pytest.raises(PblError, match="FILE_FORMAT") as error:
        read_markers(trc(tmp_path / "w.trc", trial, time=factor * trial.time_s), marker_set(NAME))
    assert said in error.value.found
    rounded = np.round(trial.time_s, 3)  # as some programs write them
    read_markers(trc(tmp_path / "w.trc", trial, time=rounded), marker_set(NAME))


@pytest.mark.parametrize("name", ["opencap_35", "halpe_26"])
def test_names_as_their_programs_write_them(tmp_path: Path, name: str):
    table, trial = marker_set(name), markers(name)
    written = {own: other for other, own in table.also.items()}
    assert set(written) == set(table.names)
    names = [written[n] for n in table.names]
    if name == "opencap_35":
        assert {"r.ASIS_study", "L.PSIS_study", "L_5meta_study", "RHJC_study", "LHJC_study", "C7_study"} < set(names)
    else:
        assert {"Nose", "Hip", "LBigToe", "RHeel", "RSmallToe"} < set(names)
    found = read_markers(trc(tmp_path / "w.trc", trial, names=names), table)
    assert (found.absent, found.unused) == ((), ())
    np.testing.assert_allclose(found.trial.xyz_world_m, trial.xyz_world_m, atol=1e-5)
    # A file that has both has its own.
    both = read_markers(trc(tmp_path / "b.trc", trial, names=[table.names[0], names[0], *names[2:]]), table)
    assert both.unused == (names[0],)


def test_a_disagreement_that_nothing_explains_is_not_its_own_cause():
    """A search for the first cause of an error would never end, as a worker's job did."""
    poses = list(rig().poses)
    poses[0] = CameraPose(poses[0].R_nc, poses[0].p_nc + np.array([0.4, 0.7, 1.1]))
    with pytest.raises(PblError, match="VIEWS_DISAGREE") as error:
        check_trial(dataclasses.replace(rig(), poses=tuple(poses)), "walk")
    assert error.value.__cause__ is not error.value


def test_the_world_of_a_trial_is_computed_once(monkeypatch: pytest.MonkeyPatch):
    called = []

    def counted(trial, name, table):
        called.append(name)
        return in_upright_world(trial, name, table)

    monkeypatch.setattr("pbl_pipeline.fit.session.in_upright_world", counted)
    make_session([markers(), moved(markers(), WORLDS["-z"])], ["a", "b"], PARAMS)
    assert called == ["a", "b"]


def test_zeros_of_a_trc_are_named_as_missing(tmp_path: Path):
    trial = markers()
    xyz = trial.xyz_world_m.copy()
    xyz[:7, 3] = 0
    path = trc(tmp_path / "w.trc", dataclasses.replace(trial, xyz_world_m=xyz))
    read = read_markers(path, marker_set(NAME)).trial
    assert not read.confidence[:7, 3].any()
    (check,) = in_upright_world(read, "w", marker_set(NAME)).trial.origin.checks("w")
    assert check.advice.startswith(f"w: points of three zeros count as missing (7 samples): {trial.names[3]}. ")


@pytest.mark.parametrize("axis", ["+y", "-z"])
def test_events_of_markers_in_another_world(tmp_path: Path, axis: str):
    walked, time = walk(8.0)
    trial = observe_markers(walked, time, marker_set=NAME, noise_m=0.002, drop_share=0)
    rows = []
    for i, seen in enumerate((trial, moved(trial, WORLDS[axis]))):
        seen.save(tmp_path / f"{i}.npz")
        done = pbl("events", tmp_path / f"{i}.npz", "--out", tmp_path / f"{i}.csv")
        assert (f"stands along {axis}" in done.out) == bool(i)
        rows.append([e.time_s for e in load_events(tmp_path / f"{i}.csv")])
    assert len(rows[0]) > 15
    np.testing.assert_allclose(rows[0], rows[1], atol=0.002)
    dataclasses.replace(trial, xyz_world_m=1000 * trial.xyz_world_m).save(tmp_path / "mm.npz")
    refusal = pbl("events", tmp_path / "mm.npz", "--out", tmp_path / "mm.csv").err
    assert "millimetres read as metres" in " ".join(refusal.split())
