"""A run of `research/benchmarks/gpu_worker.py`, small."""

import re

import pytest
from click.testing import CliRunner

from research.benchmarks.gpu_worker import main


@pytest.mark.long
def test_it_measures_a_worker(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # restored after: the benchmark changes it
    done = CliRunner().invoke(
        main, ["--sessions", "4", "--warm-up", "2", "--batch", "2", "--alike", "--processes", "1"]
    )
    assert done.exit_code == 0, done.output
    assert re.search(r"batches of 2, processes 1: [\d.]+ sessions/s", done.output)
