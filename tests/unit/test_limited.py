"""Functions in processes that begin as copies of one that has imported."""

import os
import sys

import pytest

from pbl_pipeline.limited import limited


def test_a_copy_has_the_environment_of_its_call_and_not_of_the_first(monkeypatch: pytest.MonkeyPatch):
    for value in ("first", "second"):
        monkeypatch.setenv("PBL_TEST_COPY", value)
        assert limited(os.getenv, "PBL_TEST_COPY", returns=True) == value
    monkeypatch.delenv("PBL_TEST_COPY")
    assert limited(os.getenv, "PBL_TEST_COPY", returns=True) is None


def test_what_is_preloaded_sets_no_environment():
    """A copy would lose it: `jax_setup` sets XLA's flags when it is imported."""
    assert not limited(_loaded, "pbl_pipeline.jax_setup", returns=True)


def _loaded(module: str) -> bool:
    import pbl_pipeline.video  # noqa: F401

    return module in sys.modules
