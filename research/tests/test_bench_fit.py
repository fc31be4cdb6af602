"""The benchmark that compares solvers of the fit."""

from __future__ import annotations

import dataclasses
import json
import time

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from pbl_pipeline import bench
from pbl_pipeline.bench import Case, Data, case, data
from research.benchmarks import fit as comparison
from research.benchmarks import fit_data
from research.benchmarks.fit_case import accuracy_of, camera_error_deg
from tests.unit.test_bench import row


def test_the_cases_of_the_comparison_are_solver_by_trials_by_camera_by_batch():
    methods = list(comparison.METHOD_OF.values())
    cases = comparison.speed_cases(methods, (1, 10), fit_data.MOTIONS, (1, 16, 64), 3, 3)
    assert len(cases) == 2 * 2 * 3 + 2 * 2
    assert {c.batch for c in cases if c.method == "paper-2025"} == {1}
    assert all(c.data.n_sessions == (c.batch if c.batch > 1 else 3) for c in cases)
    assert len({c.label for c in cases}) == len(cases)


@pytest.mark.parametrize(
    ("options", "n"),
    [
        (["--quick"], 4),
        (["--solver", "gauss-newton", "--trials", "1", "--batch", "1,64", "--motion", "handheld"], 2),
        (["--long"], 2),
        (["--long", "--solver", "all", "--motion", "handheld"], 2),
    ],
)
def test_options_choose_the_cases_of_the_comparison(options, n, monkeypatch):
    asked = []

    def run_cases(cases, timeout_s, note, programs):
        asked.extend(cases)
        return [compared(row())]

    monkeypatch.setattr(comparison, "run_cases", run_cases)
    done = CliRunner().invoke(comparison.main, options)
    assert done.exit_code == 0, done.output
    assert len(asked) == n


def test_batches_of_the_paper_solver_alone_are_no_benchmark():
    done = CliRunner().invoke(comparison.main, ["--solver", "implicit-adam", "--batch", "16"])
    assert done.exit_code == 2
    assert "gauss-newton" in done.output


def test_data_of_the_comparison_have_a_camera(tmp_path):
    what = fit_data.WalkerData(n_trials=1, n_sessions=1, n_frames=60, motion="handheld", short_side_px=720)
    fit_data.write(tmp_path, what)
    (session,) = data.sessions(tmp_path)
    (keypoints,) = data.read_keypoints(session)
    assert keypoints.image_size_px == (720, 1280)
    assert data.read_truth(session, "R_nc")[0].shape == (60, 3, 3)
    assert float(data.read_truth(session, "clock_offset_s")[0]) == 0.04
    assert what.key != dataclasses.replace(what, motion="static").key


def test_camera_error_is_the_median_angle():
    true = Rotation.from_euler("z", np.linspace(0, 1, 5)[:, None])
    off = Rotation.from_euler("x", np.deg2rad([0, 1, 2, 3, 170])[:, None])
    quat = (true * off).as_quat(scalar_first=True)
    quat[0] = np.nan
    assert camera_error_deg(quat, true.as_matrix()) == pytest.approx(2.5)
    assert camera_error_deg(-quat[1:4], true.as_matrix()[1:4]) == pytest.approx(2)  # q and -q are one rotation


def compared(of, motion="handheld"):
    """The row as the comparison of solvers has it."""
    data = dataclasses.asdict(fit_data.WalkerData(motion=motion))
    return {**of, "data": data, "paper_loss": 9.0, "accuracy": {**of["accuracy"], "camera_deg": 0.5, "clock_ms": 1.0}}


def test_the_table_of_the_comparison_has_the_camera_of_a_held_phone_only():
    rows = [compared(row()), compared(row("paper-2025"), "static"), compared(row("some/adam-500.json"))]
    text = comparison.text(rows)
    held, still, short = text.splitlines()[2:5]
    assert held.split()[-3:] == ["0.50", "1.0", "9.00"]
    assert still.split()[-3:] == ["-", "-", "9.00"]
    assert short.startswith("adam-500 ")
    assert "the paper's objective" in text


@pytest.mark.long
@pytest.mark.slow
def test_a_batch_of_the_comparison_is_measured_and_compared_with_the_sessions_alone(tmp_path):
    fit_data.write(tmp_path, fit_data.WalkerData(n_frames=64, n_sessions=2, motion="handheld"))
    how = {"method": "gauss-newton", "batch": 2, "repeat": 1, "camera_motion": "handheld", "judge": accuracy_of}
    got = case.measure(tmp_path, "warm", time.time(), **how)
    assert got["n_sessions"] == 2
    assert got["batch_difference_rad"] < 1e-3
    assert got["accuracy"]["camera_deg"] < 5
    assert got["accuracy"]["clock_ms"] < 40
    assert 1 < got["paper_loss"] < 100


@pytest.mark.long
@pytest.mark.slow
def test_fewer_steps_are_another_method_of_its_own_process(tmp_path):
    """Twenty frames are under a second: the fit refuses them."""
    short = comparison.shorter(tmp_path, 20)
    (got,) = bench.run_cases([Case(short, Data(n_frames=20, n_sessions=1), repeat=1)], 120.0)
    assert got["label"].startswith("adam-20, ")
    assert got["error"] == "FIT_INPUT"
    assert got["cold_seconds"] is None
    assert got["start_seconds"] is None
    assert "FIT_INPUT" in bench.fit_text([got])
    json.dumps(got, allow_nan=False)
