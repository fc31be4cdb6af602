"""Laboratory recordings (C3D) through cycles, measures and the original index."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    NINE_ANGLES,
    PLUG_IN_GAIT,
    PLUG_IN_GAIT_POINTS,
    GaitEvents,
    gait_metrics,
    load_events,
    load_norm,
    read_lab_feet,
    read_lab_trial,
)
from pbl_pipeline.gait.laboratory import _read
from pbl_pipeline.gait.normative import gait_norm
from research.benchmarks.gdi import children, conventions
from tests import not_none
from tests.command import pbl

MARKERS = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")


def write_c3d(path: Path, angles: np.ndarray, names: list[str], rate: float = 100.0) -> Path:
    """A C3D file with points (T, P, 3) and no events."""
    import c3d

    writer = c3d.Writer(point_rate=rate, analog_rate=rate)
    writer.set_point_labels(names)
    for frame in angles:
        points = np.zeros((len(names), 5))
        points[:, :3] = frame
        writer.add_frames([(points, np.zeros((0, 1)))])
    with path.open("wb") as f:
        writer.write(f)
    return path


@pytest.fixture(scope="module")
def walk(shared_data) -> Path:
    return shared_data / "real" / "gait_lab_c3d" / "Straight_HC038A11.c3d.gz"


def test_angles_are_those_of_the_laboratory(walk):
    trial = read_lab_trial(walk)
    assert trial.name == "Straight_HC038A11"
    assert trial.series.angle_model == PLUG_IN_GAIT
    assert (trial.events.method, len(trial.events.events)) == ("labels", 10)
    # The first frame is 270 at 100 Hz; frame 1 is at 0 s.
    assert trial.series.time_s[[0, -1]] == pytest.approx([2.69, 5.14])
    assert trial.events.times("left", "foot_down") == pytest.approx([2.81, 3.87, 4.93], abs=0.005)
    assert set(trial.series.left) == set(NINE_ANGLES)


def test_the_mean_curves_have_the_shape_and_signs_of_the_norm(shared_data):
    """Eleven children against the 166 controls: a sign or a side exchanged would turn a correlation."""
    cycles = [c for _, metrics in children(shared_data) for t in metrics.trials for c in t.cycles]
    assert len(cycles) == 25
    norm = load_norm("gillette-166-nine-angles")
    for angle in NINE_ANGLES:
        mean = np.mean([c.curves[angle] for c in cycles], axis=0)
        normal = norm.curves[angle]["mean_deg"]
        assert abs(mean.mean() - normal.mean()) < 3.5, angle
        if angle != "hip_rotation":  # its shape differs between laboratories
            assert np.corrcoef(mean, normal)[0, 1] > 0.9, angle


def test_healthy_children_are_within_the_norm(shared_data):
    means = [m.gdi.mean for _, m in children(shared_data) if m.gdi.mean is not None]
    assert len(means) == 11
    assert np.mean(means) == pytest.approx(100.2, abs=0.1)
    assert np.std(means, ddof=1) == pytest.approx(7.3, abs=0.1)


def test_no_other_convention_is_the_controls(shared_data):
    """Any sign turned makes the children's curves less like the controls'; and the way of the program that was
    published with the index (its resampling, its frames) comes to the same index."""
    made = conventions(shared_data, say=lambda _: None)
    mean, _, distance = made["as it is"]
    turned = {name: values for name, values in made.items() if "turned" in name}
    assert len(turned) == 10
    assert min(away for _, _, away in turned.values()) > distance + 0.4
    assert made["as the program published with the index"][0] == pytest.approx(mean, abs=1.0)


def test_measures_of_a_child(walk):
    metrics = gait_metrics([read_lab_trial(walk)], model="gillette-2008")
    values = metrics.spatiotemporal
    assert values.n_cycles_used == values.n_cycles_found == 3
    assert values["stride_length_m"] is not None
    speed, width = (not_none(values[k]) for k in ("speed_m_per_s", "step_width_m"))
    # The pelvis' way by its markers is another measurement of the same speed.
    feet = not_none(read_lab_trial(walk).feet)
    way = np.linalg.norm(np.diff(feet.pelvis_m[[0, -1], :2], axis=0)) / (feet.time_s[-1] - feet.time_s[0])
    assert speed.mean == pytest.approx(way, rel=0.03)
    assert 0.03 < width.mean < 0.2
    assert {c.check: c.outcome for c in metrics.qc}["norm_convention"] == "PASS"
    assert {c.check: c.outcome for c in metrics.qc}["lengths_scale"] == "PASS"


def test_the_command(walk, tmp_path):
    out = tmp_path / "metrics.json"
    done = pbl("gait", walk, "--out", out)
    assert done.code == 0, done.err
    assert "GDI of nine angles" in done.out
    session = json.loads(out.read_text())["session"]
    assert session["gdi"]["norm"] == "gillette-166-nine-angles"
    assert session["profile_deg"]["gps"] > 0
    assert session["step_time_s"]["asymmetry_percent"] is not None
    assert pbl("gait", walk, "--out", out, "--norm", "gillette-166-three-angles").error_code == "NORM_INVALID"


def test_events_may_be_given(walk, tmp_path):
    trial = read_lab_trial(walk)
    shifted = [e for e in trial.events.events if e.time_s > 3.2]
    events = GaitEvents("PASS", tuple(shifted), "", "x", "", "y")
    events.save(tmp_path / "events.csv")
    again = read_lab_trial(walk, tmp_path / "events.csv")
    assert (again.events.method, len(again.events.events)) == ("given", len(shifted))


@pytest.mark.slow
def test_events_of_a_recording_by_command(walk, tmp_path):
    """From its markers, whatever its labels say; then given back to `pbl gait`."""
    csv, out = tmp_path / "events.csv", tmp_path / "metrics.json"
    assert pbl("events", walk, "--out", csv).code == 0
    trial = read_lab_trial(walk)
    found, labels = load_events(csv), trial.events.events
    for label in labels:
        assert min(abs(e.time_s - label.time_s) for e in found if (e.side, e.event) == (label.side, label.event)) < 0.05
    assert pbl("gait", walk, "--events", csv, "--out", out).code == 0
    assert json.loads(out.read_text())["session"]["stride_time_s"]["mean"] == pytest.approx(
        gait_metrics([trial]).to_dict()["session"]["stride_time_s"]["mean"], abs=0.02
    )


@pytest.mark.parametrize(
    ("axes", "signs", "words"),
    [([0, 2, 1], [1, 1, -1], "no one is standing"), ([0, 1, 2], [1, -1, 1], None), ([0, 1, 2], [1, -1, -1], None)],
    ids=["y up", "mirrored", "upside down"],
)
def test_labels_do_not_make_up_for_odd_markers(walk, tmp_path, monkeypatch, axes, signs, words):
    """The labels and angles of the recording are right, its markers are turned: no lengths, no cycles by them."""

    def turned(path, wanted, person):
        points, names, time, table = _read(path, wanted, person)
        at = [i for i, n in enumerate(names) if not n.endswith(("Angles", "Angle"))]
        points[:, at] = points[:, at][..., axes] * signs
        return points, names, time, table

    monkeypatch.setattr("pbl_pipeline.gait.laboratory._read", turned)
    if words is None:
        with pytest.raises(PblError, match="GAIT_INPUT") as error:
            read_lab_trial(walk)
        assert error.value.key == str(walk)
        return
    metrics = gait_metrics([read_lab_trial(walk)])
    assert (metrics.status, metrics.gdi.mean) == ("EMPTY", None)
    assert words in metrics.reason


def test_without_labels_the_method_finds_the_events(walk, tmp_path):
    """Angles and foot markers of a child, written without events."""
    angles = {side + point for point, _ in PLUG_IN_GAIT_POINTS.values() for side in "LR"}
    points, names, _, _ = _read(walk, {*MARKERS, *angles})
    path = write_c3d(tmp_path / "own.c3d", points, names)
    for method in ("phase-transformer", "zeni-2008"):
        assert read_lab_trial(path, method=method).events.method == method
        assert pbl("gait", path, "--method", method, "--out", tmp_path / f"{method}.json").code == 0
    early, late = (
        json.loads((tmp_path / f"{m}.json").read_text())["session"]["double_support_percent"]["mean"]
        for m in ("phase-transformer", "zeni-2008")
    )
    assert late > early + 5  # Zeni's initial contact is 39 ms early
    points, names = normal_walk()
    with pytest.raises(PblError, match="GAIT_INPUT") as error:
        read_lab_feet(write_c3d(tmp_path / "bare.c3d", points, names))
    assert "LHEE" in error.value.found


def normal_walk(n: int = 300, factor: float = 1.0) -> tuple[np.ndarray, list[str]]:
    """Points (T, P, 3) of normal angles over three cycles, no markers."""
    phase = 2 * np.pi * np.arange(n) / 100.0
    names, values = [], []
    for point in dict.fromkeys(p for p, _ in PLUG_IN_GAIT_POINTS.values()):
        for k, side in enumerate("LR"):
            names.append(side + point)
            xyz = np.zeros((n, 3))
            for angle, (of, component) in PLUG_IN_GAIT_POINTS.items():
                if of == point:
                    xyz[:, component] = gait_norm().curve(angle, phase + k * np.pi, 0.43)
            values.append(xyz * factor)
    return np.stack(values, axis=1), names


def test_a_file_of_ones_own(tmp_path):
    points, names = normal_walk()
    path = write_c3d(tmp_path / "own.c3d", points, names)
    steps = (
        (0.0, "left", "foot_down"),
        (0.1, "right", "foot_up"),
        (0.5, "right", "foot_down"),
        (0.6, "left", "foot_up"),
    )
    rows = [f"{k + t:.2f},{side},{event},1.0" for k in range(3) for t, side, event in steps]
    (tmp_path / "events.csv").write_text("\n".join(["time_s,side,event,probability", *rows]) + "\n")
    trial = read_lab_trial(path, tmp_path / "events.csv")
    metrics = gait_metrics([trial])
    knee = next(c for c in metrics.trials[0].cycles if c.side == "left").curves["knee_flexion"]
    np.testing.assert_allclose(
        knee, gait_norm().curve("knee_flexion", 2 * np.pi * np.linspace(0, 1, 51), 0.43), atol=0.1
    )
    speed = metrics.spatiotemporal["speed_m_per_s"]
    assert speed is None
    assert "positions" in metrics.spatiotemporal.reasons["speed_m_per_s"]
    with pytest.raises(PblError, match="GAIT_INPUT"):
        read_lab_trial(path)


def test_bad_files(tmp_path, walk):
    points, names = normal_walk(factor=np.pi / 180)
    with pytest.raises(PblError, match="ANGLE_UNITS"):
        read_lab_trial(write_c3d(tmp_path / "rad.c3d", points, names))
    points, names = normal_walk()
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        read_lab_trial(write_c3d(tmp_path / "few.c3d", points[:, 2:], names[2:]))
    assert "LPelvisAngles" in caught.value.found
    (tmp_path / "text.c3d").write_text("no C3D file at all")
    with pytest.raises(PblError, match="FILE_FORMAT"):
        read_lab_trial(tmp_path / "text.c3d")
    (tmp_path / "cut.c3d").write_bytes(gzip.decompress(walk.read_bytes())[:3000])
    with pytest.raises(PblError, match="FILE_FORMAT"):
        read_lab_trial(tmp_path / "cut.c3d")
    with pytest.raises(PblError, match="FILE_MISSING"):
        read_lab_trial(tmp_path / "absent.c3d")


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["a.c3d", "b.fit.npz"], "USAGE"),
        (["a.fit.npz", "--events", "e.csv"], "USAGE"),
        (["a.c3d", "b.c3d", "--events", "e.csv"], "USAGE"),
        (["a.c3d", "--index", "gdi"], "SOLVER_UNKNOWN"),
    ],
)
def test_wrong_calls(tmp_path, words, code):
    assert pbl("gait", *words, "--out", tmp_path / "m.json").error_code == code
