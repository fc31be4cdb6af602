"""`pbl bench chain`: what it makes of its figures, and the whole of it on one recording."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from workers.cli.bench_chain import MANY, Measured, text

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
