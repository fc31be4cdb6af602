"""Processes that begin as copies of one that has imported."""

import os

import pytest

from pbl_pipeline import processes
from pbl_pipeline.limited import limited


def test_a_copy_has_the_environment_of_its_call_and_not_of_the_first(monkeypatch: pytest.MonkeyPatch):
    for value in ("first", "second"):
        monkeypatch.setenv("PBL_TEST_COPY", value)
        assert limited(os.getenv, "PBL_TEST_COPY", returns=True) == value
    monkeypatch.delenv("PBL_TEST_COPY")
    assert limited(os.getenv, "PBL_TEST_COPY", returns=True) is None


@pytest.mark.parametrize(("platform", "own_environment", "kind"), [
    ("linux", False, "forkserver"), ("linux", True, "spawn"), ("darwin", False, "spawn"),
])  # fmt: skip
def test_who_imports_for_itself(monkeypatch: pytest.MonkeyPatch, platform: str, own_environment: bool, kind: str):
    monkeypatch.setattr("sys.platform", platform)
    assert processes.context(own_environment).get_start_method() == kind
