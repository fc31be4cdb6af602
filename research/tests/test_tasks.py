"""Times of tasks are within their bars; the synthetic fits and the shared clip take four minutes of processor time."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from research.benchmarks.drawn_tasks import main as drawn
from research.benchmarks.tasks import main


def test_drawn_tasks_are_counted_and_timed():
    done = CliRunner().invoke(drawn, ["--seeds", "0", "29"])
    assert done.exit_code == 0, done.output


@pytest.mark.long
@pytest.mark.slow
def test_times_of_tasks_are_within_a_tenth_of_a_second(shared_data: Path):
    done = CliRunner().invoke(main, [])
    assert done.exit_code == 0, done.output
    assert "bar 0.1 s: PASS" in done.output
