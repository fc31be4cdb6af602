"""Events of 11 laboratory walks against the labels of the laboratory (markers and force plates), of each method."""

import gzip
import io
import json
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import detect_events, feet_from_markers
from research.benchmarks.events import Tally, cross_validated, lab_walks, reduced
from tests import not_none

pytestmark = pytest.mark.slow

MARKERS = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")
EVENT = {"Foot Strike": "foot_down", "Foot Off": "foot_up"}
#: An extremum this close to the end of the recording cannot be seen to be one.
EDGE_S = 0.15


def read_walk(path: Path):
    """Time (T,), marker positions (T, J, 3) in m, labelled events (side, event, time)."""
    c3d = pytest.importorskip("c3d", reason="the c3d package (dev extra) reads the laboratory files")
    reader = c3d.Reader(io.BytesIO(gzip.decompress(path.read_bytes())))
    labels: list[str] = []
    for key in ("POINT:LABELS", "POINT:LABELS2"):
        values = reader.get(key)
        if values is not None:
            labels += [str(s).strip() for s in np.ravel(values.string_array)]
    columns = [labels.index(n) for n in MARKERS]
    rows = np.array([points[columns] for _, points, _ in reader.read_frames()], float)
    xyz = np.where(rows[..., 3:4] < 0, np.nan, rows[..., :3] / 1000.0)
    time = (reader.first_frame - 1 + np.arange(len(xyz))) / reader.point_rate
    table = reader.get("EVENT")
    words = zip(
        np.ravel(table.get("CONTEXTS").string_array),
        np.ravel(table.get("LABELS").string_array),
        table.get("TIMES").float_array,
        strict=True,
    )
    return time, xyz, [(c.strip().lower(), EVENT[label.strip()], float(t[0] * 60 + t[1])) for c, label, t in words]


def compare(folder: Path, method: str) -> tuple[list[tuple], int, int, int]:
    """(walk, side, event, error in s) of each matched label; labels in all; labels away from the edges unmatched;
    events between the first and the last label that are no label."""
    matched, n_labels, missed_inside, invented = [], 0, 0, 0
    for path in sorted(folder.glob("Straight_*.c3d.gz")):
        time, xyz, labels = read_walk(path)
        found = detect_events(feet_from_markers(time, MARKERS, "plug_in_gait", xyz), method)
        first, last = min(t for *_, t in labels), max(t for *_, t in labels)
        for e in found.events:
            same = [t for s, k, t in labels if (s, k) == (e.side, e.event)]
            invented += first < e.time_s < last and all(abs(e.time_s - t) >= 0.1 for t in same)
        for side, event, true_s in labels:
            n_labels += 1
            error = np.array(found.times(side, event)) - true_s
            if len(error) and np.abs(error).min() < 0.1:
                matched.append((path.name, side, event, error[np.abs(error).argmin()]))
            elif time[0] + EDGE_S < true_s < time[-1] - EDGE_S:
                missed_inside += 1
    return matched, n_labels, missed_inside, invented


def test_the_event_model_against_the_force_plates(shared_data):
    """The bars of the project. The one constant of the method, a delay of 8 ms for all events alike, is half of what
    these walks ask for (docs/events.md)."""
    tally = Tally()
    for walk in lab_walks():
        tally.add(detect_events(not_none(walk.feet), "phase-transformer"), walk.events.events)
    print(tally)  # noqa: T201
    assert tally.labels == 95
    assert tally.matched >= 0.97
    assert tally.invented == 0
    for event in ("foot_down", "foot_up"):
        mean, sd = tally.ms(event)
        assert -12 < mean < -1
        assert sd < 15


def test_the_delay_holds_for_a_child_that_it_was_not_set_on(shared_data):
    whole, errors = cross_validated(say=lambda text: None)
    assert whole == pytest.approx(0.015, abs=0.001)
    for mean, sd in errors.values():
        assert abs(mean) < 8
        assert sd < 15


def test_the_event_model_on_heel_toe_and_hips_alone(shared_data):
    matched, n_labels, _, invented = compare(shared_data / "real" / "gait_lab_c3d", "phase-transformer")
    assert len(matched) >= 0.97 * n_labels
    assert invented == 0
    error = 1000 * np.array([m[3] for m in matched])
    print(f"{error.mean():+.1f} +- {error.std(ddof=1):.1f} ms")  # noqa: T201
    assert abs(error.mean()) < 15
    assert error.std(ddof=1) < 25


def test_the_event_model_on_ankles_with_noise(shared_data):
    """17 joints at 30 Hz with 20 mm noise."""
    tally = Tally()
    for walk in lab_walks():
        tally.add(detect_events(reduced(not_none(walk.feet), seed=7)), walk.events.events)
    assert tally.matched >= 0.95
    assert tally.invented <= 1
    for event in ("foot_down", "foot_up"):
        mean, sd = tally.ms(event)
        assert abs(mean) < 15
        assert sd < 22


def test_upside_down_and_mirrored_markers_are_refused(shared_data):
    path = next((shared_data / "real" / "gait_lab_c3d").glob("Straight_*.c3d.gz"))
    time, xyz, _ = read_walk(path)
    for flip in ([1, -1, -1], [1, -1, 1], [-1, 1, 1]):
        with pytest.raises(PblError, match="GAIT_INPUT"):
            detect_events(feet_from_markers(time, MARKERS, "plug_in_gait", xyz * flip))


def test_heel_and_toe_against_the_force_plates(shared_data):
    matched, n_labels, missed_inside, _ = compare(shared_data / "real" / "gait_lab_c3d", "zeni-2008")
    assert n_labels == 95
    assert len({m[0] for m in matched}) == 11
    assert len(matched) >= 0.95 * n_labels
    assert missed_inside == 0
    for event, mean_ms, sd_ms in (("foot_down", -39, 12), ("foot_up", 13, 10)):
        error = 1000 * np.array([m[3] for m in matched if m[2] == event])
        print(f"{event}: n {len(error)}, {error.mean():+.1f} +- {error.std(ddof=1):.1f} ms")  # noqa: T201
        assert error.mean() == pytest.approx(mean_ms, abs=5)
        assert error.std(ddof=1) < sd_ms + 3


def test_foot_velocity_against_the_force_plates(shared_data):
    """All that it finds is right, but feet that come down flat and steps at the ends of the recording are missed."""
    matched, n_labels, _, invented = compare(shared_data / "real" / "gait_lab_c3d", "oconnor-2007")
    assert len(matched) >= 0.80 * n_labels
    assert invented == 0
    for event, mean_ms in (("foot_down", 18), ("foot_up", -7)):
        error = 1000 * np.array([m[3] for m in matched if m[2] == event])
        assert error.mean() == pytest.approx(mean_ms, abs=6)


def read_bodies(path: Path):
    """Joint centres of an OpenSim body (y up) as the markers we read, z up."""
    data = json.loads(gzip.decompress(path.read_bytes()))
    bodies = ("femur_l", "femur_r", "calcn_l", "calcn_r", "toes_l", "toes_r")
    xyz = np.stack([np.array(data["bodies"][b]["translation"], float) for b in bodies], axis=1)
    return np.array(data["time"], float), np.stack([xyz[..., 0], -xyz[..., 2], xyz[..., 1]], axis=-1)


@pytest.mark.parametrize("system", ["mocap", "mono", "wham"])
def test_real_sit_to_stand_is_empty(shared_data, system):
    time, xyz = read_bodies(shared_data / "real" / "video_mocap" / "STS" / f"sample_{system}.json.gz")
    found = detect_events(feet_from_markers(time, MARKERS, "plug_in_gait", xyz))
    assert (found.status, found.events) == ("EMPTY", ())


@pytest.mark.parametrize("method", ["phase-transformer", "zeni-2008"])
def test_monocular_walks_agree_with_the_markers(shared_data, method):
    """One step and a half of one person: optical markers and two published monocular systems."""
    kinds = [
        ("left", "foot_up"),
        ("left", "foot_down"),
        ("right", "foot_up"),
        ("right", "foot_down"),
        ("left", "foot_up"),
    ]
    walks = {}
    for system in ("mocap", "mono", "wham"):
        time, xyz = read_bodies(shared_data / "real" / "video_mocap" / "walk" / f"sample_{system}.json.gz")
        events = detect_events(feet_from_markers(time, MARKERS, "plug_in_gait", xyz), method).events
        # The model also finds the initial contact in the second frame, where there is little before it to see it by.
        walks[system] = [e for e in events if e.time_s > 0.05]
        assert [(e.side, e.event) for e in walks[system]] == kinds
    for system in ("mono", "wham"):
        error = [a.time_s - b.time_s for a, b in zip(walks[system], walks["mocap"], strict=True)]
        assert np.abs(error).max() < 0.05
