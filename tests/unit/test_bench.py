"""The benchmark of the fit: its cases, its measures against hand-worked numbers, one real case and one that fails."""

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
from pbl_pipeline.bench import Case, Data, _case, _data
from pbl_pipeline.bench._accuracy import (
    MAIN_JOINTS,
    PAPER_JOINTS,
    camera_error_deg,
    joint_errors_deg,
    mean_over,
    summary,
)
from pbl_pipeline.bench._plan import NEVER_SEEN, UNSEEN_S
from pbl_pipeline.body import load_body
from pbl_pipeline.cli.bench import bench as command
from pbl_pipeline.errors import PblError
from research.benchmarks.ratios import ratio_text, ratios

NAMES = load_body().joint_names


# --- what is run


def test_the_cases_are_solver_by_trials_by_camera_by_batch():
    cases = bench.speed_cases(bench.SOLVERS, (1, 10), bench.MOTIONS, (1, 16, 64), 3, 3, 2000)
    assert len(cases) == 2 * 2 * 3 + 2 * 2
    assert {c.batch for c in cases if c.solver == "implicit-adam"} == {1}
    assert {c.adam_steps for c in cases if c.solver == "implicit-adam"} == {2000}
    assert {c.adam_steps for c in cases if c.solver == "gauss-newton"} == {None}
    assert all(c.data.n_sessions == (c.batch if c.batch > 1 else 3) for c in cases)
    assert len({bench.label(c) for c in cases}) == len(cases)


@pytest.mark.parametrize(
    ("options", "sections", "n"),
    [
        (["--quick"], {"speed"}, 3),
        (["--solver", "gauss-newton", "--trials", "1", "--batch", "1,64", "--motion", "handheld"], {"speed"}, 2),
        (["--long"], {"long"}, 2),
        (["--robust"], {"robust"}, 5),
        (["--long", "--robust", "--solver", "all", "--motion", "handheld"], {"long", "robust"}, 7),
    ],
)
def test_options_choose_the_cases(options, sections, n, monkeypatch, tmp_path):
    asked = []

    def run_cases(cases, timeout_s, note):
        asked.extend(cases)
        return [row()]

    monkeypatch.setattr(bench, "run_cases", run_cases)
    done = CliRunner().invoke(command, ["fit", *options, "--json", str(tmp_path / "a.json")])
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "a.json").read_text())["rows"][0]["warm_seconds"] == 2.0
    assert {c.section for c in asked} == sections
    assert len(asked) == n


@pytest.mark.parametrize("options", [["--trials", "one"], ["--batch", "0"], ["--solver", "adam"], ["--seeds", "0"]])
def test_wrong_options_are_refused(options):
    assert CliRunner().invoke(command, ["fit", *options]).exit_code == 2


def test_batches_of_the_paper_solver_alone_are_no_benchmark():
    done = CliRunner().invoke(command, ["fit", "--solver", "implicit-adam", "--batch", "16"])
    assert done.exit_code == 2
    assert "gauss-newton" in done.output


def test_the_process_that_starts_others_imports_no_jax():
    code = "import pbl_pipeline.bench, pbl_pipeline.cli.bench, sys; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# --- the data


def test_data_are_written_and_read_again(tmp_path):
    data = Data(n_trials=2, motion="handheld", n_frames=200, trouble="all", n_sessions=2)
    _data.write(tmp_path, data)
    keypoints, truth = _data.read(tmp_path, data, 1)
    assert len(keypoints) == len(truth) == 2
    k = keypoints[0]
    assert k.xy_px.shape == (200, 87, 2)
    assert truth[0].qpos.shape == (200, 40)
    assert truth[0].clock_offset_s == 0.04
    assert not np.allclose(truth[0].qpos, truth[1].qpos)
    assert np.all(k.confidence[:, k.names.index(NEVER_SEEN)] == 0)
    gone = np.flatnonzero(k.confidence.max(axis=1) == 0) / 30
    assert gone[0] == UNSEEN_S[0]
    assert len(gone) == 30
    assert data.key != dataclasses.replace(data, motion="static").key


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


def row(solver="gauss-newton", motion="static", batch=1, warm=2.0, main=1.0, section="speed", **more):
    case = Case(section, solver, Data(motion=motion, n_frames=more.pop("n_frames", 300)), batch)
    figures = {
        "cold_seconds": 20.0,
        "start_seconds": 6.0,
        "warm_seconds": warm,
        "host_bytes": 1e9,
        "device_bytes": None,
    }
    accuracy = {"all_deg": 2 * main, "main_deg": main, "camera_deg": 0.5, "unknown_share": 0.0}
    out = {"label": bench.label(case), **dataclasses.asdict(case), **figures, "paper_loss": 9.0, "accuracy": accuracy}
    return {**out, "device": "cpu", "cores": 2, "jax": "0", **more}


def test_ratios_compare_what_the_bars_compare():
    rows = [
        row(),
        row("implicit-adam", warm=50.0, main=1.1, paper_loss=8.91, adam_steps=2000),
        row(motion="handheld", main=1.05),
        row(batch=64, warm=6.4),
    ]
    found = {r["what"]: r for r in ratios(rows)}
    assert len(found) == 3
    solvers = found["implicit-adam 2,000 steps / gauss-newton, 1 trial, static"]
    assert solvers["seconds"] == pytest.approx(25)
    assert solvers["main_error"] == pytest.approx(1.1)
    assert solvers["loss"] == pytest.approx(0.99)
    held = found["handheld / static, gauss-newton, 1 trial"]
    assert held["all_error"] == pytest.approx(1.05)
    # A figure of the ratio must not be taken for an error code.
    text = ratio_text(rows)
    assert sum(line.startswith("handheld / static") and line.endswith("1.000") for line in text.splitlines()) == 1
    batch = found["batch 64 / one by one, gauss-newton, 1 trial, static"]
    assert batch["sessions_per_s"] == pytest.approx((64 / 6.4) / (1 / 2.0))


def test_ratio_of_twice_the_frames():
    rows = [row(section="long", n_frames=5400, warm=20.0), row(section="long", n_frames=10800, warm=42.0)]
    (found,) = ratios(rows)
    assert found["seconds"] == pytest.approx(2.1)
    assert found["memory"] == pytest.approx(1.0)


def test_the_table_shows_every_row_and_the_code_of_one_that_failed():
    failed = {**row("implicit-adam", motion="handheld"), "error": "FIT_DIVERGED", "error_text": "FIT_DIVERGED: why"}
    failed = {k: v for k, v in failed.items() if k not in ("accuracy", "warm_seconds", "paper_loss")}
    text = bench.text([row(), row(motion="handheld"), failed])
    lines = text.splitlines()
    assert sum(line.startswith(("gauss-newton   ", "implicit-adam  ")) for line in lines) == 3
    (bad,) = [line for line in lines if line.startswith("implicit-adam  ")]
    assert bad.endswith("FIT_DIVERGED")
    assert "FIT_DIVERGED: why" in text
    assert "2.000" in lines[3]
    assert "extrapolated" not in text
    assert "extrapolated" in bench.text([row("implicit-adam", adam_steps=10)])


# --- real runs


@pytest.mark.slow
def test_a_case_is_measured(tmp_path):
    """In this process and with its cache, so what is tested is that every figure is there, not how fast it was."""
    data = Data(n_frames=64, n_sessions=2)
    _data.write(tmp_path, data)
    case = Case("speed", "gauss-newton", data, repeat=2)
    begin = time.time()
    got = _case.measure(case, tmp_path, "warm", begin - 100.0)
    assert 100 < got["first_seconds"] < 100 + time.time() - begin
    assert len(got["warm_seconds_each"]) == 2
    assert got["warm_seconds"] == min(got["warm_seconds_each"])
    assert got["paramset"] == "gauss-newton"
    assert got["host_bytes"] > 1e8
    assert got["n_sessions"] == 2
    assert 0 < got["accuracy"]["main_deg"] < 6
    assert got["accuracy"]["sd_all_deg"] > 0
    assert 1 < got["paper_loss"] < 100
    assert "error" not in got
    assert _case.machine()["cores"] >= 1


@pytest.mark.slow
def test_a_batch_is_measured_and_compared_with_the_sessions_alone(tmp_path):
    data = Data(n_frames=64, n_sessions=2, motion="handheld")
    _data.write(tmp_path, data)
    got = _case.measure(Case("speed", "gauss-newton", data, batch=2, repeat=1), tmp_path, "warm", time.time())
    assert got["n_sessions"] == 2
    assert got["batch_difference_rad"] < 1e-3
    assert got["accuracy"]["camera_deg"] < 5
    assert got["accuracy"]["clock_ms"] < 40


def test_fewer_steps_are_another_paramset():
    assert _case.paramset_of("implicit-adam", 20).name == "paper-2025, 20 steps"
    assert _case.paramset_of("implicit-adam", None).name == "paper-2025"
    assert _case.paramset_of("implicit-adam", 25_000).name == "paper-2025"


@pytest.mark.slow
def test_a_case_in_its_own_process_that_fails_is_a_row_with_its_code(tmp_path):
    """Twenty frames are under a second: the fit refuses them."""
    (got,) = bench.run_cases([Case("speed", "implicit-adam", Data(n_frames=20, n_sessions=1), repeat=1)], 120.0)
    assert got["error"] == "FIT_INPUT"
    assert got["cold_seconds"] is None
    assert got["start_seconds"] is None
    assert "FIT_INPUT" in bench.text([got])
    json.dumps(got, allow_nan=False)


@pytest.mark.slow
def test_a_case_that_hangs_is_ended():
    (got,) = bench.run_cases([Case("speed", "implicit-adam", Data(n_frames=40, n_sessions=1))], 0.5)
    assert got["error"] == "over 0.5 s"


def test_an_unknown_solver_has_a_code(monkeypatch):
    monkeypatch.setitem(_case.PARAMSET_OF, "gauss-newton", "no-such")
    with pytest.raises(PblError, match="no-such") as error:
        _case.paramset_of("gauss-newton", None)
    assert error.value.code == "SOLVER_UNKNOWN"
