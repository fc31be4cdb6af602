"""Video files that lie about themselves: a result or a coded error, whatever their bytes say."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.video import probe
from research.benchmarks.hostile import KINDS
from tests.integration import chain


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_a_result_or_a_coded_error(tmp_path: Path, kind: str):
    good = chain.small_video(tmp_path, "good", n=40).read_bytes()
    path, codes = tmp_path / "damaged.mp4", set()
    for seed in range(60):
        path.write_bytes(KINDS[kind](good, random.Random(seed)))
        try:
            probe(path)
        except PblError as error:
            codes.add(error.code)
    assert codes
    assert all(code.startswith("VIDEO_") for code in codes)
