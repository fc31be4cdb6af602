"""The benchmarks of the fit: their cases, their measures against hand-worked numbers, one real case, one that fails."""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pbl_pipeline import bench
from pbl_pipeline.bench import Case, Data, case, data
from pbl_pipeline.bench.case import MAIN_JOINTS, PAPER_JOINTS, joint_errors_deg, mean_over, summary
from pbl_pipeline.bench.machine import machine
from pbl_pipeline.body import load_body
from pbl_pipeline.cli.bench import bench as command
from pbl_workers.cli.bench_chain import MANY, Measured, text

NAMES = load_body().joint_names


# --- what is run


def test_the_cases_are_trials_by_batch():
    cases = bench.fit_cases("gauss-newton", (1, 10), (1, 16, 64), 3, 2)
    assert [(c.data.n_trials, c.batch) for c in cases] == [(n, b) for n in (1, 10) for b in (1, 16, 64)]
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


@pytest.mark.parametrize("options", [["--trials", "one"], ["--batch", "0"], ["--seeds", "0"]])
def test_wrong_options_are_refused(options):
    assert CliRunner().invoke(command, ["fit", *options]).exit_code == 2


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
    assert machine()["cores"] >= 1


@pytest.mark.slow
def test_a_case_that_hangs_is_ended():
    (got,) = bench.run_cases([Case("paper-2025", Data(n_frames=40, n_sessions=1))], 0.5)
    assert got["error"] == "over 0.5 s"


@pytest.mark.slow
def test_an_unknown_method_has_a_code():
    (got,) = bench.run_cases([Case("no-such", Data(n_frames=40, n_sessions=1))], 120.0)
    assert got["error"] == "SOLVER_UNKNOWN"
    assert "no-such" in got["error_text"]


# --- `pbl bench chain`: what it makes of its figures, and the whole of it on one recording.


FOUND = Measured(
    videos=10,
    video_s=8.0,
    processes=2,
    gpus=1,
    seconds=36.0,
    processor_s=72.0,
    original_bytes=10**9,
    result_bytes=10**8,
    jobs_s={"Keypoints": 30.0, "Tracking": 10.0},
)


def costs(found: Measured, video_s: float = 8.0, machines: int = 1) -> list[list[str]]:
    """The numbers of each line of the cost table."""
    return [line.split() for line in text(found, 16, video_s, machines).splitlines()[-len(MANY) :]]


def test_the_cost_of_many_follows_from_what_was_measured():
    assert costs(FOUND)[0] == ["1,000", "1.0", "2.0", "1.0", "100", "10.0"]
    assert costs(FOUND)[2] == ["1,000,000", "1,000", "2,000", "1,000", "100,000", "10,000"]


def test_longer_recordings_cost_more_and_more_machines_take_less_time():
    assert costs(FOUND, video_s=16.0)[0][1:] == ["2.0", "4.0", "2.0", "200", "20.0"]
    assert costs(FOUND, machines=10)[0][1:] == ["0.1", "2.0", "1.0", "100", "10.0"]


def test_the_parts_say_which_table_takes_the_time():
    lines = text(FOUND, 16, 8.0, 1).splitlines()
    assert [line.split() for line in lines[4:6]] == [["Keypoints", "3.000", "75.0"], ["Tracking", "1.000", "25.0"]]
    assert "0.278 a second, 7.2 s of processor time each" in lines[0]


def test_the_profile_adds_stages_and_kinds_of_all_processes():
    rows = [("Tracking", "networks", 20.0), ("Tracking", "crops", 4.0), ("Kinetics", "forces", 5.0)] * 2
    lines = text(dataclasses.replace(FOUND, profile=rows), 16, 8.0, 1).split("\n\n")[2].splitlines()
    assert [line.split() for line in (lines[0], *lines[2:])] == [
        ["s", "a", "recording", "networks", "forces", "crops", "all"],
        ["Tracking", "4.00", "0.80", "4.80"],
        ["Kinetics", "1.00", "1.00"],
        ["all", "4.00", "1.00", "0.80", "5.80"],
    ]


def test_without_a_gpu_there_are_no_gpu_hours():
    assert costs(dataclasses.replace(FOUND, gpus=0))[0][3] == "-"


@pytest.mark.long
@pytest.mark.database
@pytest.mark.slow
def test_a_recording_goes_through_all_tables(tmp_path: Path):
    pbl = [sys.executable, "-c", "from pbl_pipeline.cli import main; main()"]
    options = ["--videos", "1", "--processes", "1", "--json", str(tmp_path / "chain.json")]
    subprocess.run([*pbl, "bench", "chain", *options], check=True)
    (row,) = json.loads((tmp_path / "chain.json").read_text())["rows"]
    assert row["jobs_s"].keys() >= {"VideoInfo", "Tracking", "Keypoints", "SessionFit", "SessionGdi", "Kinetics"}
    assert row["seconds"] > 0
    assert row["result_bytes"] > 0
