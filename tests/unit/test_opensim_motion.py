"""Joint angles of other programs: events, measures and index of OpenSim motions whose walk is known."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.export.ground import coordinates, write_mot
from pbl_pipeline.export.trial import ExportTrial
from pbl_pipeline.gait import (
    GaitCycle,
    GaitMetrics,
    feet_from_fit,
    find_cycles,
    gait_metrics,
    read_motion,
    read_motion_feet,
    read_motion_trial,
    score_gdi,
)
from pbl_pipeline.gait.events import detect_events
from pbl_pipeline.synthetic import plain_walk
from research.corpus.true_fit import fit_of_qpos
from tests import not_none
from tests.command import pbl

STRIDE_S, SPEED = 1.1, 1.2
#: The size of the person: the angles do not state it.
SCALE = 0.9
Columns = dict[str, np.ndarray]


@functools.cache
def trial() -> ExportTrial:
    time = np.arange(0, 8, 0.01)
    qpos = plain_walk(time, stride_s=STRIDE_S, speed_m_per_s=SPEED, camera_height_m=0)
    return ExportTrial("walk", fit_of_qpos("walk", time, qpos, np.full(8, SCALE)))


@functools.cache
def columns() -> Columns:
    names, values = coordinates(trial())
    return {"time": np.asarray(trial().fit.time_s), **dict(zip(names, values.T, strict=True))}


def written(path: Path, table: Columns, unit: str = "yes") -> Path:
    rows = "".join("\t".join(f"{v:.7f}" for v in row) + "\n" for row in zip(*table.values(), strict=True))
    path.write_text(f"Coordinates\ninDegrees={unit}\nendheader\n" + "\t".join(table) + "\n" + rows)
    return path


def turned(table: Columns) -> Columns:
    """The columns whose values are angles."""
    return {n: v for n, v in table.items() if n != "time" and not n.endswith(("_tx", "_ty", "_tz"))}


def of_other_leg(table: Columns) -> Columns:
    return {n: table.get(n[:-1] + {"r": "l", "l": "r"}.get(n[-1], ""), v) for n, v in table.items()}


def without(table: Columns, *starts: str) -> Columns:
    return {n: v for n, v in table.items() if not n.startswith(starts)}


@functools.cache
def cycles_of_fit() -> tuple[GaitCycle, ...]:
    fit = trial().fit
    return find_cycles(detect_events(feet_from_fit(fit)), fit, keep_ends=True)


def measured(path: Path, **options) -> GaitMetrics:
    return gait_metrics([read_motion_trial(path, **options)])


def mean(found: GaitMetrics, name: str) -> float:
    return not_none(found.spatiotemporal[name]).mean


def origin(path: Path, **options) -> str:
    (check,) = (c for c in read_motion_trial(path, **options).events.qc if c.check == "input_assumptions")
    return check.advice


def refused(code: str, read: Callable, path: Path, **options) -> PblError:
    with pytest.raises(PblError, match=code) as error:
        read(path, **options)
    return error.value


@pytest.fixture
def mot(tmp_path: Path) -> Path:
    return tmp_path / "walk.mot"


def test_our_own_motion_has_the_index_and_the_lengths_of_its_fit(mot: Path):
    write_mot(trial(), mot, {"software": "pbl-pipeline 1.2"}, "walk")
    found, fit = measured(mot), score_gdi(cycles_of_fit())
    assert (found.gdi.n, found.gdi.mean) == (fit.n, pytest.approx(fit.mean, abs=0.1))
    assert found.gdi.left == pytest.approx(fit.left, abs=0.1)
    lengths = {n: mean(found, n) for n in ("stride_time_s", "stride_length_m", "speed_m_per_s")}
    assert lengths == pytest.approx(
        {"stride_time_s": STRIDE_S, "stride_length_m": SPEED * STRIDE_S, "speed_m_per_s": SPEED}, rel=0.01
    )
    own = np.mean([not_none(c.lengths.step_length_m) for c in cycles_of_fit() if c.used])
    assert mean(found, "step_length_m") == pytest.approx(own, abs=0.01)
    assert "16 cm" in found.spatiotemporal.reasons["step_width_m"]
    said = origin(mot)
    assert "pbl-pipeline 1.2" in said
    assert "angles in degrees" in said
    assert "negative in flexion" in said


def test_other_names_units_and_signs_change_nothing(mot: Path):
    index = measured(written(mot, columns())).gdi.mean
    radians = columns() | {n: np.radians(v) for n, v in turned(columns()).items()}
    paths = {(n if n == "time" else f"/jointset/joint/{n}/value"): v for n, v in radians.items()}
    assert measured(written(mot.with_suffix(".sto"), paths, "no")).gdi.mean == pytest.approx(index, abs=0.01)
    other = columns() | {n: -v for n, v in columns().items() if n.startswith("knee_angle")}
    assert measured(written(mot, other)).gdi.mean == pytest.approx(index, abs=0.01)
    assert "positive in flexion" in origin(mot)


def test_without_translations_there_are_events_and_an_index_but_no_lengths(mot: Path):
    whole = measured(written(mot, columns()))
    found = measured(written(mot, without(columns(), "pelvis_tx", "pelvis_ty", "pelvis_tz")))
    assert found.gdi.mean == pytest.approx(whole.gdi.mean, abs=0.1)
    assert mean(found, "stride_time_s") == pytest.approx(STRIDE_S, rel=0.01)
    assert found.spatiotemporal["stride_length_m"] is None
    assert "no positions" in found.spatiotemporal.reasons["stride_length_m"]


def test_angles_of_absent_coordinates_are_absent(mot: Path):
    whole = read_motion_trial(written(mot, columns())).events
    found = read_motion_trial(written(mot, without(columns(), "pelvis_", "hip_rotation", "subtalar")))
    times = [[e.time_s for e in events.events] for events in (found.events, whole)]
    np.testing.assert_allclose(times[0], times[1], atol=0.025)
    assert "not measured: pelvis_tilt, pelvis_list, pelvis_rotation, hip_rotation_r" in origin(mot)
    assert sorted(found.series.left) == ["ankle_dorsiflexion", "hip_adduction", "hip_flexion", "knee_flexion"]


def test_a_treadmill_has_no_lengths(mot: Path):
    still = {f"pelvis_t{x}": columns()[f"pelvis_t{x}"] * (x == "y") for x in "xyz"}
    found = measured(written(mot, columns() | still))
    assert found.gdi.mean is not None
    assert found.spatiotemporal["stride_length_m"] is None


def test_what_the_index_needs_is_named_where_it_is_absent(mot: Path):
    found = measured(written(mot, without(columns(), "hip_adduction")))
    assert found.gdi.mean is None
    assert "no hip adduction" in found.gdi.reason
    assert found.spatiotemporal["stride_time_s"] is not None


def test_events_of_a_file_where_the_feet_cannot_be_placed(mot: Path, tmp_path: Path):
    events = tmp_path / "events.csv"
    detect_events(feet_from_fit(trial().fit)).save(events)
    written(mot, without(columns(), "ankle_angle", "pelvis_"))
    assert "ankle_angle_l, ankle_angle_r" in refused("GAIT_INPUT", read_motion_trial, mot).found
    refused("GAIT_INPUT", read_motion_feet, mot)
    found = measured(mot, events_csv=events)
    assert found.gdi.mean == pytest.approx(score_gdi(cycles_of_fit()).mean, abs=0.1)
    swapped = tmp_path / "swapped.csv"
    text = events.read_text().replace("left", "?").replace("right", "left").replace("?", "right")
    swapped.write_text(text)
    with pytest.raises(PblError, match="knees bent by"):
        measured(mot, events_csv=swapped)


def test_exchanged_legs_are_told_by_the_standing_foot(mot: Path):
    assert (
        "left and right exchanged"
        in refused("GAIT_INPUT", read_motion_trial, written(mot, of_other_leg(columns()))).found
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c | {"time": 1000 * c["time"]}, "milliseconds read as seconds"),
        (lambda c: c | {"time": c["time"] / 10}, "strides of 0.11 s"),
        (lambda c: c | {f"pelvis_t{x}": 1000 * c[f"pelvis_t{x}"] for x in "xyz"}, "millimetres read as metres"),
        (lambda c: c | {"hip_flexion_r": c["hip_flexion_r"] + 180}, "hip flexion, right"),
        (
            lambda c: {n.replace("hip_", "Right hip "): c[n] for n in ("time", "hip_flexion_r")},
            "no coordinate of a leg",
        ),
    ],
)
def test_what_no_person_does_is_refused(mot: Path, change: Callable[[Columns], Columns], said: str):
    assert said in refused("GAIT_INPUT", read_motion_trial, written(mot, change(columns()))).found


def test_times_and_gaps(mot: Path):
    back = columns() | {"time": columns()["time"][::-1]}
    assert "do not increase" in refused("GAIT_INPUT", read_motion_trial, written(mot, back)).found
    lost = columns() | {n: np.where(np.arange(len(v)) % 800 < 300, np.nan, v) for n, v in turned(columns()).items()}
    found = read_motion_trial(written(mot, lost))
    assert found.events.events[0].time_s > 2.9
    none = columns() | {
        n: np.where(np.arange(len(v)) % 2 == (n[-1] == "r"), np.nan, v) for n, v in turned(columns()).items()
    }
    assert read_motion_trial(written(mot, none)).events.reason
    nan = columns() | {"hip_rotation_r": np.full(800, np.nan)}
    assert "not measured: hip_rotation_r" in origin(written(mot, nan))


def test_signs_of_the_pelvis_that_do_not_fit_the_hips_are_named(mot: Path):
    other = columns() | {n: -columns()[n] for n in ("pelvis_list",)}
    assert "may have other signs" in origin(written(mot, other))


def test_the_commands_read_motions(mot: Path, tmp_path: Path):
    write_mot(trial(), mot, {}, "walk")
    out = tmp_path / "metrics.json"
    assert "GDI of three angles" in pbl("gait", mot, "--out", out).out
    (check,) = (c for c in json.loads(out.read_text())["session"]["qc"] if c["check"] == "input_assumptions")
    assert check["advice"].startswith("walk.mot: ")
    assert "initial contacts" in pbl("events", mot, "--out", tmp_path / "e.csv").out
    again = pbl("gait", mot, "--events", tmp_path / "e.csv", "--out", out)
    assert again.code == 0
    assert pbl("gait", mot, "--person", "Ann", "--out", out).error_code == "USAGE"


def test_the_columns_of_a_table_with_spaces_in_its_names(mot: Path):
    read = read_motion(
        written(mot, {"time": np.arange(3.0), "right knee": np.arange(3.0) + 40, "left knee": np.zeros(3)})
    )
    assert list(read.angles_deg) == ["right knee", "left knee"]
