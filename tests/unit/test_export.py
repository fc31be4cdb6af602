"""Exports read back by other readers, and against truths that no exporter knows."""

import contextlib
import csv
import dataclasses
import io
import json
import re
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import pbl_pipeline.body
from pbl_pipeline.body import Y_UP_TO_Z_UP, load_body, load_marker_set
from pbl_pipeline.csv_cells import frame_to_csv, quoted, unquoted, unquoted_frame
from pbl_pipeline.errors import PblError
from pbl_pipeline.export import FORMATS, ExportOptions, write_export
from pbl_pipeline.export.columns import Column, Table, Texts, lines, number_cells, text_cells, write_csv
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitMetrics, angle_series, gait_metrics, read_lab_trial, trial_poses
from pbl_pipeline.gait.c3d_file import C3dFile
from pbl_pipeline.keypoints import Keypoints, WorldMarkers
from pbl_pipeline.names import check_label
from pbl_pipeline.qc import FAIL, Check
from pbl_pipeline.validation import reference_of_mot
from pbl_pipeline.video import PhoneLog, Sensor
from pbl_pipeline.visit import Held, Recording, Visit, save_visit
from tests import not_none, source
from tests.command import pbl
from tests.exported import keypoints_of, marked_fit, with_markers
from tests.unit.visits import solution_of
from tests.walking_fit import foot_events, walking_fit

pytestmark = pytest.mark.usefixtures("little_optimised")

#: Forces need a mass and kinetics: tests/unit/test_export_forces.py.
ALL = [f for f in FORMATS if f != "forces"]
SCALAR = ("scope", "trial", "measure", "statistic")


@pytest.fixture(scope="module")
def fit() -> TrialFit:
    """Six seconds; the person comes into view after ten frames and leaves five before the end."""
    return marked_fit(n_frames=180, seen=(10, 175))


@pytest.fixture(scope="module")
def keypoints(fit: TrialFit) -> Keypoints:
    seen = keypoints_of(fit)
    seen.xy_px[4, 3], seen.confidence[4, 3] = np.nan, 0.0
    return seen


@pytest.fixture(scope="module")
def metrics(fit: TrialFit) -> GaitMetrics:
    return gait_metrics([fit])


@pytest.fixture(scope="module")
def trial(fit: TrialFit, keypoints: Keypoints, metrics: GaitMetrics) -> Recording:
    return Recording.of("walk", fit, keypoints).with_measured(metrics.trials[0])


@pytest.fixture(scope="module")
def out(trial: Recording, metrics: GaitMetrics, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One export of everything."""
    folder = tmp_path_factory.mktemp("export") / "visit"
    write_export(Visit((trial,), measures=metrics), ALL, folder)
    return folder


def written(trial: Recording, folder: Path, *formats: str, **options: Any) -> Path:
    """A trial alone, in some formats; its folder."""
    write_export(Visit((trial,)), formats, folder, ExportOptions(**options))
    return folder / trial.name


def c3d_of(path: Path) -> Any:
    """A C3D file as ezc3d reads it."""
    return pytest.importorskip("ezc3d").c3d(str(path))


# ----------------------------------------------------------------------------------------------------- markers, angles
def test_our_own_reader_finds_the_markers_in_the_trc(out, fit):
    seen = WorldMarkers.from_trc(out / "walk" / "walk.trc", fit.marker_set)
    np.testing.assert_allclose(seen.time_s, fit.time_s[10:175], atol=1e-6)
    own = [seen.names.index(n) for n in fit.marker_names]
    np.testing.assert_allclose(seen.xyz_world_m[:, own], fit.markers_world_m[10:175], atol=1e-6)
    # Three points on each of 21 bodies: the origins and 10 cm along x and y.
    assert len(seen.names) == len(fit.marker_names) + 3 * 21
    o, x, y = (seen.xyz_world_m[:, seen.names.index(f"tibia_l_{a}")] for a in "oxy")
    poses = trial_poses(fit)
    np.testing.assert_allclose(o, poses.position_m[10:175, poses.index("tibia_l")], atol=1e-5)
    np.testing.assert_allclose(x - o, 0.1 * poses.rotation[10:175, poses.index("tibia_l"), :, 0], atol=1e-5)
    np.testing.assert_allclose(y - o, 0.1 * poses.rotation[10:175, poses.index("tibia_l"), :, 1], atol=1e-5)


def test_the_trc_is_in_opensims_ground_and_in_millimetres(fit, tmp_path):
    path = written(Recording.of("walk", fit), tmp_path / "a", "trc", body_points=False) / "walk.trc"
    lines = path.read_text().splitlines()
    assert lines[2].split("\t") == ["30", "30", "165", "33", "mm", "30", "1", "165"]
    first = [float(v) for v in lines[6].split("\t")]
    x, y, z = fit.markers_world_m[10, 0]
    assert first[:2] == [1.0, pytest.approx(10 / 30, abs=1e-6)]
    assert first[2:5] == pytest.approx([1e3 * x, 1e3 * z, -1e3 * y], abs=1e-3)  # y up, z to the right
    assert all(len(line.split("\t")) == 2 + 3 * 33 for line in lines[6:])


def test_the_rate_of_stamps_that_a_webm_rounded(fit, tmp_path):
    rounded = dataclasses.replace(fit, time_s=np.round(fit.time_s, 3))
    path = written(Recording.of("walk", rounded), tmp_path / "a", "trc", body_points=False) / "walk.trc"
    rate = float(path.read_text().splitlines()[2].split("\t")[0])
    assert rate == pytest.approx(30, abs=0.01)  # the median interval is 33 ms: 30.303


def test_frames_without_a_pose_are_left_out_and_a_missing_marker_is_an_empty_cell(fit, tmp_path):
    qpos = fit.qpos.copy()
    qpos[50:53] = np.nan
    gap = with_markers(dataclasses.replace(fit, qpos=qpos))
    gap.markers_world_m[60, [4, 32]] = np.nan
    folder = written(Recording.of("walk", gap), tmp_path / "a", "trc", "mot", body_points=False)
    seen = WorldMarkers.from_trc(folder / "walk.trc", gap.marker_set)
    kept = np.delete(np.arange(10, 175), np.arange(40, 43))
    np.testing.assert_allclose(seen.time_s, fit.time_s[kept], atol=1e-6)
    np.testing.assert_array_equal(np.isnan(seen.xyz_world_m), np.isnan(gap.markers_world_m[kept]))
    line = (folder / "walk.trc").read_text().splitlines()[6 + 47]
    assert line.startswith(f"48\t{60 / 30:.6f}\t")
    assert line.endswith("\t\t\t\t")  # three cells, and one more tab: OpenSim loses an empty cell at the end
    angles = reference_of_mot(folder / "walk.mot")
    assert len(angles.time_s) == 162
    assert all(np.isfinite(v).all() for v in angles.angles_deg.values())


def test_the_reader_of_references_finds_the_angles_and_the_pelvis_in_the_mot(out, fit):
    found = reference_of_mot(out / "walk" / "walk.mot")
    poses = trial_poses(fit)
    np.testing.assert_allclose(not_none(found.pelvis_m), poses.position_m[10:175, poses.index("pelvis")], atol=1e-5)
    assert len(found.angles_deg) == 37
    for name in ("hip_flexion_r", "pelvis_list", "pro_sup_l", "mtp_angle_r"):
        own = np.degrees(fit.qpos[10:175, fit.joint_names.index(name)])
        np.testing.assert_allclose(found.angles_deg[name], own, atol=1e-5)
    knee = -np.degrees(fit.qpos[10:175, fit.joint_names.index("knee_angle_l")])
    np.testing.assert_allclose(found.angles_deg["knee_flexion_l"], knee, atol=1e-5)


# ------------------------------------------------------------------------------------------------------------- numbers
@pytest.mark.parametrize("decimals", [0, 1, 4, 6])
def test_numbers_are_written_as_python_writes_them(decimals):
    rng = np.random.default_rng(decimals)
    values = np.concatenate([rng.normal(0, 10.0**k, 200) for k in (-7, -3, 0, 3, 7)]).reshape(-1, 4)
    own = lines([number_cells(values, decimals)], "\t").decode()
    theirs = "".join("\t".join(f"{v:.{decimals}f}" for v in row) + "\n" for row in values.tolist())
    pairs = list(zip(own.split(), theirs.split(), strict=True))
    # Except for the sign of a zero, which we do not write.
    assert [(a, b) for a, b in pairs if a != b and not (float(a) == float(b) == 0 and not a.startswith("-"))] == []


def test_numbers_that_are_missing_or_large():
    values = np.array([[np.nan, -0.0, 1e17], [5.0, np.inf, -1e18]])
    assert lines([number_cells(values, 2)], ",") == b",0.00,100000000000000000.00\n5.00,,-1000000000000000000.00\n"
    assert lines([number_cells(np.array([np.nan, -0.004]), 2), text_cells([b"a", b"longer"])], ",") == (
        b",a\n0.00,longer\n"
    )


# ---------------------------------------------------------------------------------------------------------------- osim
def opensim_kinematics(osim: Path, mot: Path) -> tuple[list[str], np.ndarray]:
    """Markers (T, J, 3) by a reading of the model's XML that knows OpenSim's definition of a CustomJoint only: in the
    parent's offset frame, the translations, then the three rotations one in the frame of the other."""
    lines = mot.read_text().splitlines()
    head = lines.index("endheader") + 1
    assert all(lines)  # pyomeca reads no empty line
    table = dict(
        zip(lines[head].split("\t"), np.array([r.split("\t") for r in lines[head + 1 :]], float).T, strict=True)
    )
    model = ET.parse(osim).getroot()[0]

    def vector(element: ET.Element, name: str) -> np.ndarray:
        return np.array([float(v) for v in str(element.findtext(name)).split()])

    n = len(table["time"])
    position, rotation = {"/ground": np.zeros((n, 3))}, {"/ground": Rotation.identity(n)}
    for joint in model.findall("JointSet/objects/CustomJoint"):
        frame = not_none(joint.find("frames/PhysicalOffsetFrame"))
        assert frame.get("name") == joint.findtext("socket_parent_frame")
        parent, child = str(frame.findtext("socket_parent")), str(joint.findtext("socket_child_frame"))
        base = rotation[parent] * Rotation.from_euler("XYZ", vector(frame, "orientation"))
        place = position[parent] + rotation[parent].apply(vector(frame, "translation"))
        turn, shift = Rotation.identity(n), np.zeros((n, 3))
        for axis in joint.findall("SpatialTransform/TransformAxis"):
            coordinate = axis.findtext("coordinates")
            value = table[coordinate] if coordinate else np.zeros(n)
            if str(axis.get("name")).startswith("rotation"):
                turn = turn * Rotation.from_rotvec(np.radians(value)[:, None] * vector(axis, "axis"))
            else:
                shift += value[:, None] * vector(axis, "axis")
        position[child], rotation[child] = place + base.apply(shift), base * turn
    markers = model.findall("MarkerSet/objects/Marker")
    frames = [str(m.findtext("socket_parent_frame")) for m in markers]
    xyz = [position[f] + rotation[f].apply(vector(m, "location")) for m, f in zip(markers, frames, strict=True)]
    return [str(m.get("name")) for m in markers], np.stack(xyz, axis=1)


@pytest.mark.parametrize("markers", ["blazepose_33", "bml_movi_87"])
def test_model_and_motion_give_the_fitted_markers(markers, tmp_path):
    fit = marked_fit(markers, n_frames=60, seed=3)
    folder = written(Recording.of("walk", fit), tmp_path / "a", "osim", "mot")
    names, xyz = opensim_kinematics(folder / "walk.osim", folder / "walk.mot")
    assert names[: len(fit.marker_names)] == list(fit.marker_names)
    np.testing.assert_allclose(xyz[:, : len(fit.marker_names)] @ Y_UP_TO_Z_UP.T, fit.markers_world_m, atol=1e-5)


def test_masses_move_and_swing_as_scaled_bodies_of_the_same_mass(tmp_path):
    fit = dataclasses.replace(marked_fit(n_frames=3), scale=np.full(8, 1.2))
    path = written(Recording.of("walk", with_markers(fit)), tmp_path / "a", "osim") / "walk.osim"
    bodies = {b.get("name"): b for b in ET.parse(path).getroot().iter("Body")}
    assert len(bodies) == 21
    femur = bodies["femur_l"]  # MJCF: 10.7199 kg, 0 -0.15451 0, 0.139448 0.0343037 0.139448
    assert float(str(femur.findtext("mass"))) == pytest.approx(10.7199)
    assert [float(v) for v in str(femur.findtext("mass_center")).split()] == pytest.approx([0, -0.15451 * 1.2, 0])
    inertia = [float(v) for v in str(femur.findtext("inertia")).split()]
    assert inertia == pytest.approx([0.139448 * 1.44, 0.0343037 * 1.44, 0.139448 * 1.44, 0, 0, 0])


def test_every_joint_is_one_with_opensims_name_and_the_mjcfs_limits(out):
    model = ET.parse(out / "walk" / "walk.osim").getroot()[0]
    joints = {j.get("name"): j for j in model.iter("CustomJoint")}
    assert {"ground_pelvis", "hip_r", "knee_l", "subtalar_r", "back", "neck", "radius_hand_l"} <= set(joints)
    assert [c.get("name") for c in joints["hip_l"].iter("Coordinate")] == [
        "hip_flexion_l",
        "hip_adduction_l",
        "hip_rotation_l",
    ]
    knee = next(joints["knee_r"].iter("Coordinate"))
    assert [float(v) for v in str(knee.findtext("range")).split()] == pytest.approx(np.radians([-160, 10]))
    assert sum(1 for _ in model.iter("Coordinate")) == 40
    for joint in joints.values():  # no two axes in line, else OpenSim refuses the joint
        axes = [np.array(str(a.findtext("axis")).split(), float) for a in joint.iter("TransformAxis")][:3]
        assert abs(np.linalg.det(axes)) > 0.5


# --------------------------------------------------------------------------------------------------------------- floor
@pytest.fixture(scope="module")
def walk() -> TrialFit:
    """A walk on a level floor that a camera 1.15 m above it films: heights of the fit count from the camera."""
    body = load_body()
    names = pbl_pipeline.body.marker_set("blazepose_33").names
    return with_markers(walking_fit(body.joint_names, body.sha256, marker_names=names, n_frames=120))


def _heights(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Height (m) of the pelvis in the MOT, and of the lowest of the calcanei and the toes' joints in the TRC."""
    pelvis = not_none(reference_of_mot(folder / "walk.mot").pelvis_m)
    seen = WorldMarkers.from_trc(folder / "walk.trc", "blazepose_33")
    feet = [seen.names.index(f"{b}_{s}_o") for b in ("calcn", "toes") for s in "lr"]
    return pelvis[:, 2], seen.xyz_world_m[:, feet, 2].min(axis=1)


def test_the_floor_is_at_0_where_it_was_found(walk, tmp_path):
    qpos = walk.qpos.copy()
    # A vertical that is off: the floor seems to rise by 8 cm over 4.8 m.
    qpos[:, walk.joint_names.index("pelvis_ty")] += 0.02 * walk.time_s
    fit = with_markers(dataclasses.replace(walk, qpos=qpos))
    folder = written(Recording.of("walk", fit), tmp_path / "a", "trc", "mot", "osim")
    pelvis, lowest = _heights(folder)
    assert pelvis.mean() == pytest.approx(0.95, abs=0.03)
    assert np.quantile(np.abs(lowest), 0.95) < 0.03
    knee = walk.qpos[:, walk.joint_names.index("knee_angle_r")]
    found = np.abs(reference_of_mot(folder / "walk.mot").angles_deg["knee_flexion_r"])
    np.testing.assert_allclose(found, np.degrees(np.abs(knee)), atol=1e-4)
    names, xyz = opensim_kinematics(folder / "walk.osim", folder / "walk.mot")
    seen = WorldMarkers.from_trc(folder / "walk.trc", "blazepose_33")
    own = [names.index(n) for n in seen.names]
    np.testing.assert_allclose(xyz[:, own] @ Y_UP_TO_Z_UP.T, seen.xyz_world_m, atol=1e-5)
    ground = "height 0 is the floor under the person, from the lowest sole"
    assert f"ground={ground}" in (folder / "walk.mot").read_text()
    assert f"ground: {ground}" in (folder / "walk.osim").read_text()
    assert json.loads((tmp_path / "a" / "export.json").read_text())["trials"]["walk"]["ground"] == ground


def test_the_floor_is_followed_to_the_ends_of_a_recording(walk, tmp_path):
    qpos, time = walk.qpos.copy(), walk.time_s
    # As in the demonstration, the floor seems to rise where the person comes and to sink where the person goes.
    qpos[:, walk.joint_names.index("pelvis_ty")] -= 0.11 * np.abs(time - time.mean())
    fit = with_markers(dataclasses.replace(walk, qpos=qpos))
    pelvis, _ = _heights(written(Recording.of("walk", fit), tmp_path / "a", "trc", "mot"))
    step = 17  # frames
    assert [pelvis[:step].mean(), pelvis[-step:].mean()] == pytest.approx([0.96, 0.96], abs=0.005)


def test_the_floor_of_a_c3d_is_at_0(walk, tmp_path):
    file = c3d_of(written(Recording.of("walk", walk), tmp_path / "a", "c3d") / "walk.c3d")
    heels = [walk.marker_names.index(f"{s}_heel") for s in ("left", "right")]
    assert np.abs(file["data"]["points"][2, heels].min(axis=0)).mean() < 60  # mm: the marker is above the sole
    assert file["parameters"]["PBL"]["GROUND"]["value"][0].startswith("height 0 is the floor")


@pytest.mark.parametrize("what", ["stairs", "jumps", "laboratory"])
def test_what_0_is_where_no_floor_was_found(walk, what, tmp_path):
    qpos, up = walk.qpos.copy(), walk.joint_names.index("pelvis_ty")
    if what == "stairs":
        qpos[:, up] += 0.3 * walk.time_s
    if what == "jumps":
        qpos[:, up] += 0.2 * np.abs(np.sin(6 * walk.time_s))
    source = "measured: calibration" if what == "laboratory" else walk.orientation_source
    fit = with_markers(dataclasses.replace(walk, qpos=qpos, orientation_source=source))
    folder = written(Recording.of("walk", fit), tmp_path / "a", "trc", "mot")
    poses = trial_poses(fit)
    pelvis, _ = _heights(folder)
    np.testing.assert_allclose(pelvis, poses.position_m[:, poses.index("pelvis"), 2], atol=1e-5)
    said = "laboratory's" if what == "laboratory" else "no floor was found"
    assert said in next(line for line in (folder / "walk.mot").read_text().splitlines() if line.startswith("ground="))


# ----------------------------------------------------------------------------------------------------------------- c3d
def test_ezc3d_reads_points_poses_and_events(out, fit, metrics):
    file = c3d_of(out / "walk" / "walk.c3d")
    points, parameters = file["data"]["points"], file["parameters"]
    assert parameters["POINT"]["LABELS"]["value"] == list(fit.marker_names)
    assert parameters["POINT"]["UNITS"]["value"] == ["mm"]
    assert parameters["POINT"]["RATE"]["value"][0] == pytest.approx(30)
    np.testing.assert_allclose(points[:3].transpose(2, 1, 0), 1e3 * fit.markers_world_m, atol=2e-3)  # z up, as ours
    poses, found = trial_poses(fit), file["data"]["rotations"]
    assert parameters["ROTATION"]["LABELS"]["value"][:2] == ["pelvis_4X4", "femur_r_4X4"]
    assert parameters["ROTATION"]["USED"]["value"][0] == 21
    np.testing.assert_allclose(found[:3, :3].transpose(3, 2, 0, 1), poses.rotation, atol=1e-6)
    np.testing.assert_allclose(found[:3, 3].transpose(2, 1, 0), 1e3 * poses.position_m, atol=2e-3)
    seen = np.isfinite(fit.qpos[:, 0])
    np.testing.assert_allclose(found[3, :, 0][:, seen], np.tile([[0.0], [0], [0], [1]], seen.sum()))
    events = metrics.trials[0].events.events
    assert len(events) > 8
    group = parameters["EVENT"]
    assert group["USED"]["value"][0] == len(events)
    np.testing.assert_allclose(group["TIMES"]["value"][1], [e.time_s for e in events], atol=1e-5)
    assert group["CONTEXTS"]["value"] == [e.side.capitalize() for e in events]
    assert group["LABELS"]["value"] == ["Foot Strike" if e.event == "foot_down" else "Foot Off" for e in events]
    assert list(group["ICON_IDS"]["value"]) == [1 if e.event == "foot_down" else 2 for e in events]
    assert parameters["PBL"]["TIMES"]["value"] == ["as filmed"]


def test_py_c3d_reads_the_same(out, fit, metrics):
    import c3d

    with (out / "walk" / "walk.c3d").open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it does not know the poses that follow the points
        reader: Any = c3d.Reader(file)
        frames = [points for _, points, _ in reader.read_frames()]
        labels = [str(name).strip() for name in reader.point_labels]
        contexts, kinds = (np.ravel(reader.get(f"EVENT:{k}").string_array) for k in ("CONTEXTS", "LABELS"))
        times = reader.get("EVENT:TIMES").float_array
    assert labels == list(fit.marker_names)
    assert reader.first_frame == 1
    own = metrics.trials[0].events.events
    assert [str(c).strip().lower() for c in contexts] == [e.side for e in own]
    assert [{"Foot Strike": "foot_down", "Foot Off": "foot_up"}[str(k).strip()] for k in kinds] == [
        e.event for e in own
    ]
    np.testing.assert_allclose(times @ [60, 1], [e.time_s for e in own], atol=1e-5)
    xyz = np.array([f[:, :3] for f in frames])
    np.testing.assert_allclose(xyz[10:175], 1e3 * fit.markers_world_m[10:175], atol=2e-3)
    assert np.all(np.array([f[:, 3] for f in frames])[:10] < 0)  # not seen: invalid


def with_events(trial: Recording, metrics: GaitMetrics, n: int) -> Recording:
    """The trial with so many events, two a second."""
    one = metrics.trials[0]
    first = one.events.events[0]
    many = tuple(dataclasses.replace(first, time_s=i / 2, side=("left", "right")[i % 2]) for i in range(n))
    return trial.with_measured(dataclasses.replace(one, events=dataclasses.replace(one.events, events=many)))


@pytest.mark.parametrize(("n", "name"), [(255, ""), (256, ""), (0, ""), (0, "x" * 64)])
def test_readers_find_all_events_up_to_the_limit_of_a_c3d(trial, metrics, fit, tmp_path, n, name):
    import c3d

    most = (120_000 - len(fit.marker_names) * max(map(len, fit.marker_names))) // (43 + len(name))
    n = n or most
    path = written(with_events(trial, metrics, n), tmp_path / "a", "c3d", name=name) / "walk.c3d"
    file, endings = c3d_of(path), ["", *range(2, -(-n // 255) + 1)]
    group, seconds = file["parameters"]["EVENT"], np.arange(n) / 2
    assert group["USED"]["value"][0] == n
    assert [t for e in endings for t in group[f"LABELS{e}"]["value"]] == ["Foot Strike"] * n
    assert [t for e in endings for t in group[f"CONTEXTS{e}"]["value"]] == (["Left", "Right"] * n)[:n]
    times = np.concatenate([group[f"TIMES{e}"]["value"] for e in endings], axis=1)
    np.testing.assert_allclose([60, 1] @ times, seconds, atol=1e-4)
    with path.open("rb") as opened, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        reader: Any = c3d.Reader(opened)
        times = np.concatenate([reader.get(f"EVENT:TIMES{e}").float_array for e in endings])
        xyz = np.array([points[:, :3] for _, points, _ in reader.read_frames()])
    np.testing.assert_allclose(times @ [60, 1], seconds, atol=1e-4)
    np.testing.assert_allclose(file["data"]["points"][:3].transpose(2, 1, 0)[10:175], xyz[10:175], atol=1e-3)
    if n == most:
        over = with_events(trial, metrics, n + 1)
        assert f"at most {n}" in refused("EXPORT_INPUT", over, tmp_path / "b", "c3d", name=name)


def test_many_long_names_of_markers_in_a_c3d(fit, tmp_path):
    import c3d

    names = tuple(f"{i:0127d}" for i in range(900))
    many = dataclasses.replace(fit, marker_names=names, markers_world_m=np.resize(fit.markers_world_m, (180, 900, 3)))
    path = written(Recording.of("w", many), tmp_path / "a", "c3d") / "w.c3d"
    group = c3d_of(path)["parameters"]["POINT"]
    assert (*group["LABELS"]["value"], *group["LABELS2"]["value"]) == names[:510]
    with path.open("rb") as opened, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        reader: Any = c3d.Reader(opened)
        assert sum(1 for _ in reader.read_frames()) == 180
        assert [str(s) for s in np.ravel(reader.get("POINT:LABELS4").string_array)] == list(names[765:])
    for wrong in (names * 2, ("x" * 128, *fit.marker_names[1:])):
        points = np.zeros((180, len(wrong), 3))
        long = dataclasses.replace(fit, marker_names=wrong, markers_world_m=points)
        assert "127" in refused("EXPORT_INPUT", Recording.of("w", long), tmp_path / "b", "c3d")


def test_both_readers_find_the_last_frame_of_the_longest_c3d(fit, tmp_path):
    import c3d

    for shift, fits in ((65354, True), (65355, False)):  # 180 frames, the last has the number 65534 or 65535
        late = Recording.of("w", dataclasses.replace(fit, time_s=fit.time_s + shift / 30))
        if not fits:
            assert "65534" in refused("EXPORT_INPUT", late, tmp_path / "b", "c3d")
            continue
        path = written(late, tmp_path / "a", "c3d") / "w.c3d"
        assert c3d_of(path)["data"]["points"].shape[2] == 180
        with path.open("rb") as opened, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            assert [n for n, *_ in c3d.Reader(opened).read_frames()][-1] == 65534


def test_uneven_frames_are_brought_to_one_rate(tmp_path):
    even = marked_fit(n_frames=121)
    kept = np.sort(np.random.default_rng(5).permutation(121)[:110])
    kept[0], kept[-1] = 0, 120
    kept = np.unique(kept)
    fields = {f: getattr(even, f)[kept] for f in ("time_s", "qpos", "qpos_sd", "markers_world_m", "phone_quat_wxyz")}
    uneven = dataclasses.replace(even, **fields)
    file = c3d_of(written(Recording.of("walk", uneven), tmp_path / "a", "c3d") / "walk.c3d")
    assert file["parameters"]["PBL"]["TIMES"]["value"] == ["interpolated to an even rate"]
    points = file["data"]["points"][:3].transpose(2, 1, 0)
    assert points.shape == (121, 33, 3)
    np.testing.assert_allclose(points, 1e3 * even.markers_world_m, atol=15)  # mm, where frames were dropped
    assert np.median(np.abs(points - 1e3 * even.markers_world_m)) < 0.01
    # The poses follow the interpolated joints, not the interpolated matrices: they stay rotations.
    turns = file["data"]["rotations"][:3, :3].transpose(3, 2, 0, 1)
    np.testing.assert_allclose(turns @ turns.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-5)


def test_a_recording_that_starts_later_keeps_its_times(tmp_path):
    fit = marked_fit(n_frames=60)
    late = dataclasses.replace(fit, time_s=fit.time_s + 2.0)
    file = c3d_of(written(Recording.of("walk", late), tmp_path / "a", "c3d") / "walk.c3d")
    assert file["header"]["points"]["first_frame"] == 60  # from 0: the 61st, 2 s after the first


def test_sensors_of_the_phone_are_analog_channels_on_the_videos_clock(fit, tmp_path):
    time = np.arange(0.0, 5.0, 0.01)
    xyz = np.column_stack([time, 2 * time, np.full_like(time, 9.81)])  # straight lines: interpolation is exact
    log = PhoneLog(time, np.tile([1.0, 0, 0, 0], (len(time), 1)), "camera", None, "own", None, {}, "CSV")
    log = dataclasses.replace(log, sensors={"accelerometer": Sensor(time, xyz), "gyroscope": Sensor(time, xyz)})
    path = written(Recording.of("w", fit, load_log=Held((log, 0.5))), tmp_path / "a", "c3d") / "w.c3d"
    file = c3d_of(path)
    analog = file["parameters"]["ANALOG"]
    assert analog["LABELS"]["value"][:4] == [*(f"phone_accelerometer_{a}" for a in "xyz"), "phone_gyroscope_x"]
    assert analog["UNITS"]["value"][:4] == ["m/s^2"] * 3 + ["rad/s"]
    assert analog["RATE"]["value"][0] == 120  # the multiple of 30 Hz that is not below the sensor's 100
    values = file["data"]["analogs"][0]
    np.testing.assert_allclose(C3dFile(path.read_bytes()).analogs().reshape(-1, 6).T, values, atol=1e-5)
    at = np.arange(values.shape[1]) / 120
    inside = (at >= 0.5) & (at <= 5.49)
    np.testing.assert_allclose(values[1, inside], 2 * (at[inside] - 0.5), atol=1e-5)
    assert np.isnan(values[:, at < 0.49]).all()
    assert np.isnan(values[:, at > 5.51]).all()


# -------------------------------------------------------------------------------------------------------- Plug-in Gait
@pytest.fixture(scope="module")
def pig(walk, tmp_path_factory) -> tuple[Path, GaitMetrics]:
    """A C3D with Plug-in Gait's names, and what we measured of the walk."""
    measures = gait_metrics([walk])
    recording = Recording.of("walk", walk).with_measured(measures.trials[0])
    out = tmp_path_factory.mktemp("pig") / "a"
    return written(recording, out, "c3d", names="plug-in-gait") / "walk.c3d", measures


def test_our_reader_of_laboratories_finds_the_same_walk(pig, walk):
    path, measures = pig
    found, own = read_lab_trial(path), angle_series(walk)
    for ours, theirs in ((own.left, found.series.left), (own.right, found.series.right)):
        for name, values in ours.items():
            pelvis = 12.0 if name in ("pelvis_tilt", "hip_flexion") else 0.0
            np.testing.assert_allclose(theirs[name], values + pelvis, atol=1e-4, err_msg=name)
    events = measures.trials[0].events.events
    assert [(e.side, e.event) for e in found.events.events] == [(e.side, e.event) for e in events]
    np.testing.assert_allclose([e.time_s for e in found.events.events], [e.time_s for e in events], atol=1e-4)
    again = gait_metrics([found])
    for name in ("cadence_steps_per_min", "stance_percent", "stride_length_m", "speed_m_per_s"):
        own, read = (not_none(m.spatiotemporal.measures[name]).mean for m in (measures, again))
        assert read == pytest.approx(own, rel=1e-3), name


def test_markers_of_plug_in_gait_lie_on_the_body(pig, walk, tmp_path):
    file = C3dFile(pig[0].read_bytes())
    names = [*(s + n for n in ("ASI", "PSI", "KNE", "ANK", "HEE", "TOE") for s in "LR"), "SACR"]
    assert file.labels[: len(names)] == names
    assert file.texts("POINT:ANGLES") == file.labels[len(names) :]
    assert file.texts("POINT:ANGLE_UNITS") == ["deg"]
    at = dict(zip(names, 1e-3 * file.points(range(len(names))).transpose(1, 0, 2), strict=True))
    np.testing.assert_allclose(at["SACR"], (at["LPSI"] + at["RPSI"]) / 2, atol=1e-6)
    own = C3dFile((written(Recording.of("walk", walk), tmp_path / "a", "c3d") / "walk.c3d").read_bytes())
    assert own.labels == list(walk.marker_names)
    for name, point in (("KNE", "knee"), ("ANK", "ankle"), ("HEE", "heel")):
        for letter, side in (("L", "left"), ("R", "right")):
            joint = 1e-3 * own.points([own.labels.index(f"{side}_{point}")])[:, 0]
            off = np.linalg.norm(at[letter + name] - joint, axis=1)
            assert 0.02 < off.mean() < 0.09, name  # the landmarks are inside, the markers on the skin


def test_angles_of_uneven_frames_are_interpolated_as_the_markers_are(walk, tmp_path):
    kept = np.delete(np.arange(120), [30, 61, 62])
    fields = {f: getattr(walk, f)[kept] for f in ("time_s", "qpos", "qpos_sd", "markers_world_m", "phone_quat_wxyz")}
    residuals = {f: getattr(walk, f)[kept] for f in ("residual_2d_px", "residual_3d_m")}
    uneven = dataclasses.replace(walk, **fields, **residuals)
    path = written(Recording.of("w", uneven), tmp_path / "a", "c3d", names="plug-in-gait") / "w.c3d"
    knee = read_lab_trial(path, events_csv=None).series.left["knee_flexion"]
    np.testing.assert_allclose(knee, angle_series(walk).left["knee_flexion"], atol=1.5)


def _by_kind(events: list[tuple[str, str, float]]) -> dict[tuple[str, str], list[float]]:
    """(side, foot_down or foot_up) -> times in order, without those of the first and last 0.2 s."""
    kinds = [(side, event) for side in ("left", "right") for event in ("foot_down", "foot_up")]
    return {k: sorted(t for *kind, t in events if tuple(kind) == k and 0.2 < t < 3.8) for k in kinds}


def _ours(measures: GaitMetrics) -> dict[tuple[str, str], list[float]]:
    return _by_kind([(e.side, e.event, e.time_s) for e in measures.trials[0].events.events])


@pytest.mark.needs_extra
def test_gaitkit_finds_our_events_from_the_markers(pig, walk):
    gaitkit: Any = pytest.importorskip("gaitkit")
    trial = gaitkit.load_c3d(pig[0])
    assert trial["diagnostics"]["missing_core_markers"] == []
    knee = [frame["left_knee_angle"] for frame in trial["angle_frames"]]
    np.testing.assert_allclose(knee, angle_series(walk).left["knee_flexion"], atol=1e-4)
    found = gaitkit.detect(trial, method="zeni")
    kinds = (("foot_down", found.left_hs, found.right_hs), ("foot_up", found.left_to, found.right_to))
    events = [
        (side, kind, event["time"])
        for kind, *sides in kinds
        for side, of_side in zip(("left", "right"), sides, strict=True)
        for event in of_side
    ]
    for kind, times in _ours(pig[1]).items():
        assert _by_kind(events)[kind] == pytest.approx(times, abs=0.034), kind  # a frame
    cadence = 2 * found.cycles["cadence"].mean()  # strides, not steps
    assert cadence == pytest.approx(not_none(pig[1].spatiotemporal.measures["cadence_steps_per_min"].mean), rel=0.01)


@pytest.mark.needs_extra
def test_gaitalytics_cuts_the_walk_by_our_events(pig, walk, tmp_path):
    api: Any = pytest.importorskip("gaitalytics.api")
    config = tmp_path / "config.yaml"
    config.write_text(json.dumps({"analysis": {"markers": ["LKneeAngles", "RKneeAngles"]}}))
    trial = api.load_c3d_trial(pig[0], api.load_config(config))
    api.check_events(trial.events)
    down = {"Foot Strike": "foot_down", "Foot Off": "foot_up"}
    rows = trial.events[["context", "label", "time"]].itertuples(index=False)
    events = _by_kind([(side.lower(), down[label], time) for side, label, time in rows])
    assert events == {kind: pytest.approx(times, abs=1e-3) for kind, times in _ours(pig[1]).items()}
    cycles = api.segment_trial(trial).get_all_cycles()
    assert sum(map(len, cycles.values())) == pig[1].trials[0].spatiotemporal.n_cycles_found
    knee = list(cycles["Left"][0].get_all_data().values())[-1].sel(channel="LKneeAngles_x")
    own = next(c.curves for c in pig[1].trials[0].cycles if c.side == "left")["knee_flexion"]
    assert np.ptp(knee.values) == pytest.approx(np.ptp(own), abs=1.0)


# -------------------------------------------------------------------------------------------------------------- tables
def table(path: Path, **options: Any) -> Any:
    """(pandas' own types say less of a column than these tests need.)"""
    return pd.read_csv(path, **options)


def test_long_and_wide_tables_hold_the_same(out, fit, metrics):
    wide, long = (table(out / f"angles_{form}.csv") for form in ("wide", "long"))
    assert len(wide) == 180
    np.testing.assert_allclose(wide["hip_flexion_r_deg"], np.degrees(fit.qpos[:, 6]), atol=1e-5)
    assert wide["hip_flexion_r_deg"][:10].isna().all()
    part = long[(long.angle == "hip_flexion") & (long.side == "right")]
    assert set(part.unit) == {"deg"}
    np.testing.assert_allclose(part.value, wide["hip_flexion_r_deg"].dropna(), atol=1e-9)
    assert len(long) == 165 * 42  # 40 joints and both knees with the other sign; frames without a pose are left out
    assert set(long[long.angle == "pelvis_tx"].unit) == {"m"}
    cycles, cycle_values = table(out / "cycles_wide.csv"), table(out / "cycles_long.csv")
    own = metrics.trials[0].cycles
    np.testing.assert_allclose(cycles.stride_time_s, [c.stride_time_s for c in own], atol=1e-6)
    assert list(cycles.used) == [c.used for c in own]
    strides = cycle_values[cycle_values.measure == "stride_time_s"]
    np.testing.assert_allclose(strides.value, cycles.stride_time_s, atol=1e-9)
    curves, points = table(out / "curves_wide.csv"), table(out / "curves_long.csv")
    assert len(curves) == 51 * len(own)
    first = own[0].curves["knee_flexion"]
    np.testing.assert_allclose(curves["knee_flexion_deg"][:51], first, atol=1e-6)
    np.testing.assert_allclose(
        points[(points.cycle == 0) & (points.angle == "knee_flexion")].value_deg, first, atol=1e-6
    )
    measures = table(out / "measures_long.csv", keep_default_na=False, na_values=[""]).set_index(list(SCALAR))
    wide = table(out / "measures_wide.csv").set_index("scope")
    stride = not_none(metrics.spatiotemporal["stride_time_s"])
    assert wide.loc["session", "stride_time_s_mean"] == pytest.approx(stride.mean, abs=1e-6)
    left = measures.xs(("session", "stride_time_s", "left"), level=("scope", "measure", "statistic"))
    assert left["value"].item() == pytest.approx(stride.left, abs=1e-6)
    assert left["unit"].item() == "s"
    width = measures.xs(("session", "step_width_m", "mean"), level=("scope", "measure", "statistic"))
    assert np.isnan(width["value"].item())
    assert "one camera" in width["reason"].item()


def test_parquet_has_the_numbers_of_the_csv_with_units_and_origin(out):
    parquet = pytest.importorskip("pyarrow.parquet")
    for path in sorted(out.glob("*.parquet")):
        frame = parquet.read_table(path).to_pandas()
        text = table(path.with_suffix(".csv"), keep_default_na=False, na_values=[""])
        assert list(frame.columns) == list(text.columns), path.name
        for name in frame.columns:
            if frame[name].dtype.kind == "f":
                np.testing.assert_allclose(frame[name], text[name], atol=1e-6, err_msg=f"{path.name} {name}")
    wide = parquet.read_table(out / "angles_wide.parquet")
    assert wide.schema.metadata[b"model"].startswith(b"pbl_body_40 version 1")
    field = wide.schema.field("knee_angle_r_deg")
    assert field.metadata == {b"unit": b"deg", b"meaning": b"positive: extension: flexion is negative, as in OpenSim"}
    assert wide["knee_angle_r_deg"].null_count == 15  # missing is null, R's NA, not NaN
    assert str(wide.schema.field("trial").type).startswith("dictionary")  # a factor in R


def test_the_dictionary_explains_every_column(out):
    rows = list(csv.DictReader((out / "data_dictionary.csv").open(newline="")))
    texts = {r["column"]: r["meaning"] for r in rows if r["table"] == "measures_wide"}
    assert "error" in texts["gdi_sd"]
    assert "over both sides" in texts["stride_time_s_sd"]
    listed = {(r["table"], r["column"]) for r in rows}
    there = {
        (path.stem, name)
        for path in out.glob("*.csv")
        if path.stem != "data_dictionary"
        for name in next(csv.reader(path.open(newline="")))
    }
    assert listed == there
    assert [r["column"] for r in rows if not r["meaning"]] == []
    for row in rows:
        end = row["column"].rsplit("_", 1)[-1]
        if end in ("deg", "m", "s") and row["table"].endswith("wide"):
            assert re.split("[/ ]", row["unit"])[-1] == end, row


def test_several_trials_share_their_tables(fit, tmp_path):
    other = marked_fit(n_frames=40, seed=9)
    visit = Visit((Recording.of("one", fit), Recording.of("two", other)))
    write_export(visit, ["csv"], tmp_path / "a")
    frame = table(tmp_path / "a" / "angles_wide.csv")
    assert frame.groupby("trial").size().to_dict() == {"one": 180, "two": 40}
    two = frame[frame.trial == "two"]
    np.testing.assert_allclose(
        two["arm_add_l_deg"], np.degrees(other.qpos[:, other.joint_names.index("arm_add_l")]), atol=1e-5
    )


# ----------------------------------------------------------------------------------------------------------- keypoints
def test_keypoints_are_as_deeplabcut_writes_them(out, keypoints):
    path = out / "walk" / "walk.dlc.csv"
    frame = table(path, header=[0, 1, 2], index_col=0)
    assert frame.columns.names == ["scorer", "bodyparts", "coords"]
    ankle = frame["pbl_blazepose_33"]["left_ankle"]
    j = keypoints.names.index("left_ankle")
    np.testing.assert_allclose(ankle[["x", "y"]], keypoints.xy_px[:, j], atol=1e-3)
    np.testing.assert_allclose(ankle["likelihood"], keypoints.confidence[:, j], atol=1e-4)
    missed = frame["pbl_blazepose_33"][keypoints.names[3]].loc[4]
    assert np.isnan(missed["x"])
    assert missed["likelihood"] == 0


@pytest.mark.needs_extra
def test_movement_loads_the_keypoints(out, keypoints):
    load_poses: Any = pytest.importorskip("movement.io.load_poses")
    found = load_poses.from_dlc_file(out / "walk" / "walk.dlc.csv", fps=30)
    assert list(found.coords["keypoint"].values) == list(keypoints.names)
    xy = found.position.squeeze("individual").transpose("time", "keypoint", "space").values
    np.testing.assert_allclose(xy, keypoints.xy_px, atol=1e-3)
    assert np.nanmax(np.abs(np.squeeze(found.confidence.values) - keypoints.confidence)) < 1e-4


# ------------------------------------------------------------------------------------------------------------- OpenSim
@pytest.mark.needs_extra
@pytest.mark.parametrize("markers", ["blazepose_33", "bml_movi_87", "mpi_inf_3dhp_17"])
@pytest.mark.usefixtures("in_empty_folder")  # OpenSim writes a log where it starts
def test_opensim_agrees(markers, tmp_path):
    """Forward kinematics of 100 poses within 1 mm, inverse kinematics of our TRC within 1 deg of our angles, with
    OpenSim's default settings."""
    opensim: Any = pytest.importorskip("opensim")
    opensim.Logger.setLevelString("error")
    fit = marked_fit(markers, n_frames=104, seed=2)
    fit.qpos[50:54] = np.nan  # out of view for a moment
    fit = with_markers(fit)
    folder = written(Recording.of("walk", fit), tmp_path / "a", "osim", "mot", "trc")
    model = opensim.Model(str(folder / "walk.osim"))
    state = model.initSystem()
    motion = opensim.TimeSeriesTable(str(folder / "walk.mot"))
    assert motion.getTableMetaDataString("inDegrees") == "yes"
    names = list(motion.getColumnLabels())
    values = motion.getMatrix().to_numpy()
    assert len(names) == 40
    coordinates, places = model.getCoordinateSet(), model.getMarkerSet()
    worst = 0.0
    known = fit.markers_world_m[np.isfinite(fit.qpos[:, 0])]
    assert len(known) == 100
    for row, expected in zip(values, known, strict=True):
        for name, value in zip(names, row, strict=True):
            is_length = name in ("pelvis_tx", "pelvis_ty", "pelvis_tz")
            coordinates.get(name).setValue(state, float(value if is_length else np.radians(value)), False)
        model.realizePosition(state)
        found = [places.get(n).getLocationInGround(state).to_numpy() for n in fit.marker_names]
        worst = max(worst, float(np.abs(np.array(found) - expected @ Y_UP_TO_Z_UP).max()))
    assert worst < 1e-3
    tool = opensim.InverseKinematicsTool()
    tool.setModel(model)
    tool.setMarkerDataFileName(str(folder / "walk.trc"))
    tool.setOutputMotionFileName(str(tmp_path / "ik.mot"))
    tool.setStartTime(0.0)
    tool.setEndTime(100.0)
    tool.set_report_errors(False)
    assert tool.run()
    solved = opensim.TimeSeriesTable(str(tmp_path / "ik.mot"))
    column = list(solved.getColumnLabels())
    angles = solved.getMatrix().to_numpy()[:, [column.index(n) for n in names]]
    assert angles.shape == values.shape
    off = np.abs(angles - values).max(axis=0)
    assert dict(zip(names, off, strict=True)) == {n: pytest.approx(0, abs=1.0) for n in names}
    assert off[[names.index(f"pelvis_t{a}") for a in "xyz"]].max() < 1e-3


# ------------------------------------------------------------------------------------------------- origin, identity
def test_an_export_says_what_made_it(out):
    content = json.loads((out / "export.json").read_text())
    about = content["trials"]["walk"]
    assert content["software"].startswith("pbl-pipeline 0.")
    assert about["model"].startswith("pbl_body_40 version 1")
    assert about["fit_method"] == "gauss-newton, parameters 0123456789abcdef"
    assert about["keypoints_by"] == "a detector, licence Apache-2.0"
    assert (about["frames"], about["frames_with_a_pose"]) == (180, 165)
    assert sorted(content["files"]) == sorted(
        p.relative_to(out).as_posix() for p in out.rglob("*.*") if p.name not in ("export.json", ".participants.lock")
    )
    for ending in ("mot", "osim", "c3d"):
        assert about["model"].encode() in (out / "walk" / f"walk.{ending}").read_bytes(), ending


def test_nobody_is_named_unless_asked(trial, metrics, tmp_path):
    named = dataclasses.replace(trial, name="Doe-Jane", load_fit=Held(dataclasses.replace(trial.fit, name="Doe-Jane")))
    write_export(Visit((named,), measures=metrics), ALL, tmp_path / "a", ExportOptions(number_trials=True))
    files = [p for p in (tmp_path / "a").rglob("*") if p.is_file()]
    assert len(files) > 10
    assert [p.name for p in files if b"Doe-J" in p.read_bytes() or "Doe" in str(p.relative_to(tmp_path))] == []
    asked = written(trial, tmp_path / "b", "trc", "mot", "osim", "c3d", name="Jane Doe")
    assert [p.name for p in asked.iterdir() if b"Jane Doe" not in p.read_bytes()] == []


# ---------------------------------------------------------------------------------------------------------- bad input
def refused(code: str, trial: Recording, folder: Path, *formats: str, **options: Any) -> str:
    """The text of the error; nothing was written."""
    with pytest.raises(PblError) as caught:
        written(trial, folder, *formats, **options)
    assert caught.value.code == code
    assert not folder.exists() or not any(folder.rglob("*.???"))
    return caught.value.text()


def test_a_fit_that_failed_is_refused_unless_asked(trial, tmp_path):
    bad = Visit((trial,), fit_checks=(Check("residual_3d_cm", FAIL, 20.0, 6.0, "look"),))
    with pytest.raises(PblError, match="residual_3d_cm") as caught:
        write_export(bad, ["mot"], tmp_path / "a")
    assert caught.value.code == "EXPORT_INPUT"
    assert not (tmp_path / "a").exists()
    write_export(bad, ["mot"], tmp_path / "a", ExportOptions(allow_failed=True))
    assert "failed_checks=residual_3d_cm" in (tmp_path / "a" / "walk" / "walk.mot").read_text()


def test_a_fit_without_a_pose_or_of_another_body_is_refused(fit, tmp_path):
    empty = dataclasses.replace(fit, qpos=np.full_like(fit.qpos, np.nan))
    assert "without one pose" in refused("EXPORT_INPUT", Recording.of("w", empty), tmp_path / "a", "mot")
    other = dataclasses.replace(fit, body_sha256="0" * 64)
    assert "000000000000" in refused("EXPORT_INPUT", Recording.of("w", other), tmp_path / "a", "osim")
    backwards = dataclasses.replace(fit, time_s=fit.time_s[::-1])
    assert "time stamps" in refused("EXPORT_INPUT", Recording.of("w", backwards), tmp_path / "a", "mot")
    blind = dataclasses.replace(fit, markers_world_m=np.full_like(fit.markers_world_m, np.nan))
    assert "without one marker" in refused("EXPORT_INPUT", Recording.of("w", blind), tmp_path / "a", "trc")


def test_markers_that_the_body_lacks_are_refused_and_a_table_helps(fit, tmp_path):
    own = dataclasses.replace(fit, marker_set="our_lab")
    text = refused("MARKER_SET_UNKNOWN", Recording.of("w", own), tmp_path / "a", "osim")
    assert "--marker-set" in text
    table = tmp_path / "our_lab.csv"
    shipped = Path(pbl_pipeline.body.__file__).parent / "data" / "markers_blazepose_33.csv"
    table.write_text(shipped.read_text())
    folder = written(Recording.of("w", own, markers=load_marker_set(table)), tmp_path / "b", "osim", "mot")
    _, xyz = opensim_kinematics(folder / "w.osim", folder / "w.mot")
    np.testing.assert_allclose(xyz[:, :33] @ Y_UP_TO_Z_UP.T, fit.markers_world_m[10:175], atol=1e-5)
    fewer = dataclasses.replace(fit, marker_names=("snout", *fit.marker_names[1:]))
    assert "snout" in refused("MARKER_SET_UNKNOWN", Recording.of("w", fewer), tmp_path / "a", "osim")


def test_names_that_a_format_cannot_hold_are_refused(fit, keypoints, tmp_path):
    text = refused("EXPORT_INPUT", Recording.of("gäng", fit), tmp_path / "a", "c3d")
    assert "--number-trials" in text
    assert written(Recording.of("gäng", fit, keypoints=keypoints), tmp_path / "b", "csv", "dlc").is_dir()
    refused("USAGE", Recording.of("w", fit), tmp_path / "a", "c3d", name="Jürgen")
    refused("USAGE", Recording.of("w", fit), tmp_path / "a", "mot", name="two\nlines")
    refused("EXPORT_INPUT", Recording.of("../w", fit), tmp_path / "a", "csv")
    spaced = dataclasses.replace(fit, marker_names=("left eye", *fit.marker_names[1:]))
    assert "left eye" in refused("EXPORT_INPUT", Recording.of("w", spaced), tmp_path / "a", "trc", body_points=False)


def test_other_refusals(fit, tmp_path, machine):
    assert "svg" in refused("USAGE", Recording.of("w", fit), tmp_path / "a", "svg")
    assert "keypoints" in refused("EXPORT_INPUT", Recording.of("w", fit), tmp_path / "a", "dlc")
    long = dataclasses.replace(fit, time_s=fit.time_s + 3000.0)
    assert "65534" in refused("EXPORT_INPUT", Recording.of("w", long), tmp_path / "a", "c3d")
    for module, form in (("ezc3d", "c3d"), ("pyarrow", "parquet")):
        machine(without=[module])
        assert "pbl-pipeline[export]" in refused("PACKAGE_MISSING", Recording.of("w", fit), tmp_path / "a", form)


def test_a_folder_with_files_is_kept_unless_asked(fit, tmp_path):
    note = tmp_path / "a" / "note.txt"
    note.parent.mkdir()
    note.write_text("mine")
    with pytest.raises(PblError) as caught:
        written(Recording.of("w", fit), tmp_path / "a", "mot")
    assert caught.value.code == "FILE_UNWRITABLE"
    assert "--overwrite" in caught.value.text()
    written(Recording.of("w", fit), tmp_path / "a", "mot", overwrite=True)
    written(Recording.of("w", fit), tmp_path / "a", "mot", overwrite=True)
    assert note.read_text() == "mine"
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["export.json", "note.txt", "w.mot"]


# ------------------------------------------------------------------------------------------------------------- command
@pytest.fixture(scope="module")
def files(fit: TrialFit, keypoints: Keypoints, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`walk.fit.npz` with keypoints and session.json beside it."""
    folder = tmp_path_factory.mktemp("fits")
    time = np.arange(0.0, 8.0, 0.02)
    seen = dataclasses.replace(
        keypoints, phone_time_s=time - 1.25, phone_quat_wxyz=np.tile([0.5, -0.5, 0.5, -0.5], (len(time), 1))
    )
    save_visit(Visit((Recording.of("walk", fit, seen),), solution_of(fit)), folder)
    log = {"time_s": time, "qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5, "ax": 0.0, "ay": 9.81, "az": time}
    pd.DataFrame(log).to_csv(folder / "log.csv", index=False)
    return folder


def test_the_command_on_files(files, tmp_path):
    done = pbl("export", files / "walk.fit.npz", "--to", "mot", "--to", "dlc", "--out", tmp_path / "a")
    assert done.code == 0, done.err
    assert [Path(p).name for p in done.out.splitlines()] == ["walk.mot", "walk.dlc.csv", "export.json"]
    assert "fitted_with=0.1.0+gabc" in (tmp_path / "a" / "walk" / "walk.mot").read_text()
    again = pbl("export", files / "walk.fit.npz", "--to", "mot", "--out", tmp_path / "a")
    assert (again.code, again.error_code) == (1, "FILE_UNWRITABLE")
    names = ("--to", "c3d", "--names", "plug-in-gait")
    assert pbl("export", files / "walk.fit.npz", *names, "--out", tmp_path / "b").code == 0
    assert C3dFile((tmp_path / "b" / "walk" / "walk.c3d").read_bytes()).labels[0] == "LASI"


def test_the_command_with_events_and_the_phones_log(files, tmp_path):
    log = ("--attitude", files / "log.csv")
    done = pbl("export", files / "walk.fit.npz", "--to", "c3d", *log, "--out", tmp_path / "a")
    assert done.code == 0, done.err
    file = c3d_of(tmp_path / "a" / "walk" / "walk.c3d")
    truth = [t for t, side, event in foot_events(5.5, 0.6) if (side, event) == ("right", "foot_down")]
    group = file["parameters"]["EVENT"]
    kinds = zip(group["CONTEXTS"]["value"], group["LABELS"]["value"], group["TIMES"]["value"][1], strict=True)
    found = np.array([t for side, label, t in kinds if (side, label) == ("Right", "Foot Strike")])
    assert all(np.abs(found - t).min() < 0.06 for t in truth[1:-1])
    z = file["data"]["analogs"][0][file["parameters"]["ANALOG"]["LABELS"]["value"].index("phone_accelerometer_z")]
    at = np.arange(len(z)) / file["parameters"]["ANALOG"]["RATE"]["value"][0]
    np.testing.assert_allclose(z, at + 1.25, atol=1e-4)  # the keypoints say where the log lies on the video's clock


def test_a_log_of_another_recording_is_refused(files, tmp_path):
    lines = (files / "log.csv").read_text().splitlines()
    (tmp_path / "log.csv").write_text("\n".join(lines[:-20]) + "\n")
    log = ("--attitude", tmp_path / "log.csv")
    done = pbl("export", files / "walk.fit.npz", "--to", "c3d", *log, "--out", tmp_path / "a")
    assert done.error_code == "PHONE_LOG"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--to", "mot"], "USAGE"),
        (["walk.fit.npz", "--to", "mot", "--subject", "P1"], "USAGE"),
        (["--subject", "P1", "--to", "c3d", "--attitude", "log.csv"], "USAGE"),
        (["walk.fit.npz", "--to", "bvh"], "USAGE"),
        (["walk.fit.npz", "--to", "mot", "--names", "plug-in-gait"], "USAGE"),
        (["walk.fit.npz", "--to", "c3d", "--names", "helen-hayes"], "USAGE"),
        (["nothing.fit.npz", "--to", "mot"], "FILE_MISSING"),
        (["walk.keypoints.npz", "--to", "mot"], "FILE_FORMAT"),
        (["walk.fit.npz", "--to", "mot", "--attitude", "log.csv", "--attitude", "log.csv"], "USAGE"),
    ],
)
def test_wrong_calls(files, tmp_path, arguments, code):
    with contextlib.chdir(files):
        done = pbl("export", *arguments, "--out", tmp_path / "a")
    assert (done.code, done.error_code) == (1, code), done.err


# --- What a spreadsheet would compute is written as a text; numbers stay numbers.


FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\uff1d1+1", "'=1", "''-x"]
PLAIN = ["P001", "", "-", "-5", "+1.5e3", "a=1", "'quoted'", "'-5", "3_months", "\u2212 5"]


@pytest.mark.parametrize("text", FORMULAS)
def test_formulas_are_texts(text: str):
    assert quoted(text) == f"'{text}"
    assert unquoted(quoted(text)) == text


@pytest.mark.parametrize("text", PLAIN)
def test_other_texts_and_numbers_stay(text: str):
    assert quoted(text) == text
    assert unquoted(text) == text


def test_a_table_as_csv():
    frame = pd.DataFrame(
        {
            "=A1": ["=1+1", "plain", None],
            "n": [-1.5, np.nan, 2.0],
            "i": [-1, 0, 1],
            "kind": pd.Categorical(["@x", "y", "@x"]),
            "mixed": pd.Series([-1, "=2", True], dtype=object),
            "day": pd.to_datetime(["2026-01-01", None, "2026-01-03"]),
        }
    )
    text = frame_to_csv(frame, "%.8g")
    assert text == (
        "'=A1,n,i,kind,mixed,day\n'=1+1,-1.5,-1,'@x,-1,2026-01-01\nplain,,0,y,'=2,\n,2,1,'@x,True,2026-01-03\n"
    )
    back = unquoted_frame(pd.read_csv(io.StringIO(text)))
    assert list(back["=A1"])[:2] == ["=1+1", "plain"]
    assert list(back["kind"]) == ["@x", "y", "@x"]
    assert list(back["n"])[::2] == [-1.5, 2.0]


def test_tables_of_a_visit(tmp_path: Path):
    trial, values = Column("trial", Texts.of(["=cmd,x", "walk"]), "", ""), Column("v", np.array([-1.5, 2.0]), "", "")
    write_csv(Table("t", (trial, values)), tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="") as file:
        (_, first, second) = csv.reader(file)
    assert (first[0], float(first[1]), second[0]) == ("'=cmd,x", -1.5, "walk")


def test_no_table_is_written_past_it():
    """Every CSV file with texts from outside goes through `csv_cells`; events have none."""
    root = Path(__file__).parents[2]
    allowed = {
        "pbl_pipeline/csv_cells.py",
        "pbl_pipeline/results/events.py",
        "pbl_pipeline/export/keypoints_csv.py",
    }
    found = {
        str(path.relative_to(root))
        for path in source.files(*source.PACKAGES)
        if any(way in path.read_text("utf-8") for way in (".to_csv(", "csv.writer(", "DictWriter(", ".to_excel("))
    }
    assert found == allowed


def test_a_name_that_does_not_show_what_it_is_is_refused(tmp_path: Path):
    for name in ("a\u202eb", "\u2066a", "a\u200bb", "\ufeffa", "a\u00adb", "a\x7fb", "a\nb", "\u3164", "\u2800"):
        with pytest.raises(PblError, match="USAGE"):
            check_label("session", name, 64)
    for name in ("M\u00fcller", "\u4e2d\u6587", "a b-c.d", "e\u0301", "\U0001f6b6"):
        check_label("session", name, 64)
    (tmp_path / "walk\u202e4pm.mp4").write_bytes(b"x")
    assert pbl("run", tmp_path / "walk\u202e4pm.mp4", "--out", tmp_path / "out").error_code == "USAGE"
