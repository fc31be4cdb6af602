"""The benchmarks of the fit: their cases, their measures against hand-worked numbers, one real case, one that fails."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from pbl_pipeline import bench
from pbl_pipeline.bench import Case, Data, case, data
from pbl_pipeline.bench.accuracy import MAIN_JOINTS, PAPER_JOINTS, joint_errors_deg, mean_over, summary
from pbl_pipeline.body import load_body
from pbl_pipeline.cli.bench import bench as command
from research.benchmarks import fit as comparison
from research.benchmarks import fit_data
from research.benchmarks.fit_case import accuracy_of, camera_error_deg

NAMES = load_body().joint_names


# --- what is run


def test_the_cases_are_trials_by_batch():
    cases = bench.fit_cases("gauss-newton", (1, 10), (1, 16, 64), 3, 2)
    assert [(c.data.n_trials, c.batch) for c in cases] == [(n, b) for n in (1, 10) for b in (1, 16, 64)]
    assert all(c.data.n_sessions == (c.batch if c.batch > 1 else 3) for c in cases)
    assert len({c.label for c in cases}) == len(cases)


def test_the_cases_of_the_comparison_are_solver_by_trials_by_camera_by_batch():
    methods = list(comparison.METHOD_OF.values())
    cases = comparison.speed_cases(methods, (1, 10), fit_data.MOTIONS, (1, 16, 64), 3, 3)
    assert len(cases) == 2 * 2 * 3 + 2 * 2
    assert {c.batch for c in cases if c.method == "paper-2025"} == {1}
    assert all(c.data.n_sessions == (c.batch if c.batch > 1 else 3) for c in cases)
    assert len({c.label for c in cases}) == len(cases)


@pytest.mark.parametrize(
    ("options", "n"),
    [(["--quick"], 1), (["--trials", "1", "--batch", "1,64"], 2), (["--method", "paper-2025", "--batch", "1"], 2)],
)
def test_options_choose_the_cases(options, n, monkeypatch, tmp_path):
    asked = []

    def run_cases(cases, timeout_s, note):
        asked.extend(cases)
        return [row()]

    monkeypatch.setattr(bench, "run_cases", run_cases)
    done = CliRunner().invoke(command, ["fit", *options, "--json", str(tmp_path / "a.json")])
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "a.json").read_text())["rows"][0]["warm_seconds"] == 2.0
    assert len(asked) == n


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


@pytest.mark.parametrize("options", [["--trials", "one"], ["--batch", "0"], ["--seeds", "0"]])
def test_wrong_options_are_refused(options):
    assert CliRunner().invoke(command, ["fit", *options]).exit_code == 2


def test_batches_of_the_paper_solver_alone_are_no_benchmark():
    done = CliRunner().invoke(comparison.main, ["--solver", "implicit-adam", "--batch", "16"])
    assert done.exit_code == 2
    assert "gauss-newton" in done.output


def test_the_process_that_starts_others_imports_no_jax():
    code = "import pbl_pipeline.bench, pbl_pipeline.cli.bench, sys; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# --- the data


def test_data_are_written_and_read_again(tmp_path):
    what = Data(n_trials=2, n_sessions=2, n_frames=200)
    data.write(tmp_path, what)
    first, second = data.sessions(tmp_path)
    keypoints, truth = data.read_keypoints(second), data.read_truth(second)
    assert len(keypoints) == len(truth) == 2
    assert keypoints[0].xy_px.shape == (200, 87, 2)
    assert truth[0].shape == (200, 40)
    assert not np.allclose(truth[0], truth[1])
    assert not np.allclose(truth[0], data.read_truth(first)[0])
    # All of the person in the picture; the benchmark's fraction of missing points.
    seen = keypoints[0].xy_px[keypoints[0].confidence > 0]
    assert np.mean(keypoints[0].confidence == 0) == pytest.approx(0.05, abs=0.01)
    assert np.mean(np.all((seen > 0) & (seen < [1080, 1920]), axis=1)) > 0.99
    assert what.key != dataclasses.replace(what, n_trials=1).key


def test_data_of_the_comparison_have_a_camera(tmp_path):
    what = fit_data.WalkerData(n_trials=1, n_sessions=1, n_frames=60, motion="handheld", short_side_px=720)
    fit_data.write(tmp_path, what)
    (session,) = data.sessions(tmp_path)
    (keypoints,) = data.read_keypoints(session)
    assert keypoints.image_size_px == (720, 1280)
    assert data.read_truth(session, "R_nc")[0].shape == (60, 3, 3)
    assert float(data.read_truth(session, "clock_offset_s")[0]) == 0.04
    assert what.key != dataclasses.replace(what, motion="static").key


# --- the measures


def test_joint_error_is_the_median_of_a_trial_then_the_mean_over_joints():
    truth = np.zeros((5, 40))
    fitted = np.zeros((5, 40))
    fitted[:, NAMES.index("knee_angle_r")] = np.deg2rad([1, -2, 3, -50, np.nan])
    fitted[:, NAMES.index("elbow_flex_l")] = np.deg2rad(3)
    errors = joint_errors_deg(fitted, truth, NAMES)
    assert set(errors) == set(PAPER_JOINTS)
    assert len(PAPER_JOINTS) == 6 + 2 + 2 + 3 + 3 + 4 + 2
    assert len(MAIN_JOINTS) == 13
    assert errors["knee_angle_r"] == pytest.approx(2.5)  # the frame without a result does not count
    assert mean_over(errors, MAIN_JOINTS) == pytest.approx(2.5 / 13)
    assert mean_over(errors, PAPER_JOINTS) == pytest.approx((2.5 + 3) / 22)
    assert np.isnan(joint_errors_deg(fitted * np.nan, truth, NAMES)["knee_angle_r"])


def test_camera_error_is_the_median_angle():
    true = Rotation.from_euler("z", np.linspace(0, 1, 5)[:, None])
    off = Rotation.from_euler("x", np.deg2rad([0, 1, 2, 3, 170])[:, None])
    quat = (true * off).as_quat(scalar_first=True)
    quat[0] = np.nan
    assert camera_error_deg(quat, true.as_matrix()) == pytest.approx(2.5)
    assert camera_error_deg(-quat[1:4], true.as_matrix()[1:4]) == pytest.approx(2)  # q and -q are one rotation


def test_the_mean_over_trials_leaves_out_what_is_unknown():
    trials = [{"joints_deg": {"a": 1.0}, "clock_ms": float("nan")}, {"joints_deg": {"a": 3.0}, "clock_ms": 4.0}]
    assert summary(trials) == {"joints_deg": {"a": 2.0}, "clock_ms": 4.0}


# --- the table


def row(method="gauss-newton", batch=1, **more):
    """A row of `pbl bench fit`."""
    of = Case(method, Data(), batch)
    figures = {"cold_seconds": 20.0, "start_seconds": 6.0, "warm_seconds": 2.0, "host_bytes": 1e9, "device_bytes": None}
    accuracy = {"all_deg": 2.0, "main_deg": 1.0, "unknown_share": 0.0}
    out = {"label": of.label, **dataclasses.asdict(of), **figures, "accuracy": accuracy}
    return {**out, "device": "cpu", "cores": 2, "jax": "0", **more}


def compared(of, motion="handheld"):
    """The row as the comparison of solvers has it."""
    data = dataclasses.asdict(fit_data.WalkerData(motion=motion))
    return {**of, "data": data, "paper_loss": 9.0, "accuracy": {**of["accuracy"], "camera_deg": 0.5, "clock_ms": 1.0}}


def test_the_table_shows_every_row_and_the_code_of_one_that_failed():
    failed = {**row("paper-2025"), "error": "FIT_DIVERGED", "error_text": "FIT_DIVERGED: why"}
    failed = {k: v for k, v in failed.items() if k not in ("accuracy", "warm_seconds")}
    text = bench.fit_text([row(), row(batch=64), failed])
    lines = text.splitlines()
    assert sum(line.startswith(("gauss-newton   ", "paper-2025  ")) for line in lines) == 3
    (bad,) = [line for line in lines if line.startswith("paper-2025  ")]
    assert bad.endswith("FIT_DIVERGED")
    assert "FIT_DIVERGED: why" in text
    assert "2.000" in lines[2]
    assert "32.00" in lines[3]  # sessions a second


def test_the_table_of_the_comparison_has_the_camera_of_a_held_phone_only():
    rows = [compared(row()), compared(row("paper-2025"), "static"), compared(row("some/adam-500.json"))]
    text = comparison.text(rows)
    held, still, short = text.splitlines()[2:5]
    assert held.split()[-3:] == ["0.50", "1.0", "9.00"]
    assert still.split()[-3:] == ["-", "-", "9.00"]
    assert short.startswith("adam-500 ")
    assert "the paper's objective" in text


# --- real runs


@pytest.mark.slow
def test_a_case_is_measured(tmp_path):
    """In this process and with its cache, so what is tested is that every figure is there, not how fast it was."""
    data.write(tmp_path, Data(n_frames=64, n_sessions=2))
    begin = time.time()
    how = {"method": "gauss-newton", "batch": 1, "repeat": 2, "camera_motion": "static", "judge": case.accuracy_of}
    got = case.measure(tmp_path, "warm", begin - 100.0, **how)
    assert 100 < got["first_seconds"] < 100 + time.time() - begin
    assert len(got["warm_seconds_each"]) == 2
    assert got["warm_seconds"] == min(got["warm_seconds_each"])
    assert got["paramset"] == "gauss-newton"
    assert got["host_bytes"] > 1e8
    assert got["n_sessions"] == 2
    assert 0 < got["accuracy"]["main_deg"] < 6
    assert "error" not in got
    assert case.machine()["cores"] >= 1


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


@pytest.mark.slow
def test_a_case_that_hangs_is_ended():
    (got,) = bench.run_cases([Case("paper-2025", Data(n_frames=40, n_sessions=1))], 0.5)
    assert got["error"] == "over 0.5 s"


@pytest.mark.slow
def test_an_unknown_method_has_a_code():
    (got,) = bench.run_cases([Case("no-such", Data(n_frames=40, n_sessions=1))], 120.0)
    assert got["error"] == "SOLVER_UNKNOWN"
    assert "no-such" in got["error_text"]
