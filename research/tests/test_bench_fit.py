"""The benchmark that compares solvers of the fit."""

import dataclasses
import json
import time

import pytest
from click.testing import CliRunner

from pbl_pipeline import bench
from pbl_pipeline.bench import Case, Data, case
from research.benchmarks import fit as comparison
from research.benchmarks import fit_data
from research.benchmarks.fit_case import accuracy_of
from tests.unit.test_bench import row


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
