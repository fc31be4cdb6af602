"""Notices of compiled libraries: that line is kept off the standard error, everything else is not."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError

PROBE = """
import os
from pbl_pipeline.models.tflite import without_notice
try:
    with without_notice(b"known words"):
        os.write(2, b"INFO: known words\\nERROR: other words\\n")
        raise RuntimeError("it failed")
except RuntimeError as error:
    os.write(2, f"{error}\\n".encode())
with without_notice(b"known words"):
    os.write(2, b"later: known words\\n")
"""


def said(program: str) -> str:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300).stderr


def test_all_else_is_written_also_where_the_block_fails():
    assert said(PROBE) == "ERROR: other words\nit failed\nlater: known words\n"


@pytest.mark.slow
def test_loading_a_model_says_nothing():
    try:
        path = assets.fetch("blazepose_detector")
    except PblError:
        pytest.skip("the model is not in the cache")
    name = "blazepose_detector"
    program = "from pbl_pipeline import assets\nfrom pbl_pipeline.models import LiteModel\n"
    program += f"LiteModel({str(path)!r}, assets.ASSETS[{name!r}].sha256)\n"
    assert said(program) == ""
