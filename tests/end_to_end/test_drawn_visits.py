"""`pbl demo --visits`: three drawn persons at two visits each, from an empty home to rows."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pbl_workers.drawn_visits import PERSONS, VISITS
from tests.database import new_home, remove_home

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture
def home() -> Iterator[Path]:
    path = new_home()
    yield path
    remove_home(path)


def pbl(home: Path, *words: object) -> str:
    code = "from pbl_pipeline.cli import main; main()"
    env = {**os.environ, "PBL_HOME": str(home)}
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        env=env,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_six_drawn_visits_have_an_index_forces_and_scores(home: Path, tmp_path: Path):
    said = pbl(home, "demo", "--visits", "--out", tmp_path / "drawn")
    found = {(s, d): float(i) for s, d, i in re.findall(r"(DRAWN\d) ([\d-]+): index ([\d.]+), 90 % interval", said)}
    assert set(found) == {(s, str(day)) for s in PERSONS for day in VISITS.values()}
    first, second = map(str, VISITS.values())
    assert found["DRAWN1", second] > found["DRAWN1", first] + 5  # what was put in became less
    assert abs(found["DRAWN3", second] - found["DRAWN3", first]) < 3  # and stayed the same
    assert re.search(r"Kinetics +6 +0 +0 +0", said)
    assert "of no real person" in said
    again = pbl(home, "demo", "--visits", "--out", tmp_path / "drawn")
    assert not re.search(r"SessionFit +[1-9]", again)
    assert pbl(home, "list", "visits").count("DRAWN") == 6
