"""Functions in processes that begin as copies of one that has imported."""

import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import forkserver
from pathlib import Path

import pytest

from pbl_pipeline.limited import LimitExceeded, limited
from tests import Environment


def test_a_copy_has_the_environment_of_its_call_and_not_of_the_first(environment: Environment):
    for value in ("first", "second"):
        environment(PBL_TEST_COPY=value)
        assert limited(os.getenv, "PBL_TEST_COPY", returns=True) == value
    environment(PBL_TEST_COPY=None)
    assert limited(os.getenv, "PBL_TEST_COPY", returns=True) is None


def test_a_process_that_cannot_start_says_nothing_about_what_it_was_to_do():
    limited(os.getpid)
    copied = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    os.kill(copied, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(limited, os.getpid)
        with pytest.raises(TimeoutError):
            waiting.result(0.5)
        os.kill(copied, signal.SIGKILL)
        with pytest.raises(LimitExceeded, match="did not start"):
            waiting.result(30)
    os.waitid(os.P_PID, copied, os.WEXITED | os.WNOWAIT)
    assert limited(os.getpid, returns=True)


def test_what_is_preloaded_sets_no_environment():
    """A copy would lose it: `jax_setup` sets XLA's flags when it is imported."""
    assert not limited(_loaded, "pbl_pipeline.jax_setup", returns=True)


def test_the_current_folder_is_not_imported_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It may hold another checkout, or a file with the name of a module of Python."""
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    for module in ("pbl_pipeline", "selectors"):
        (tmp_path / f"{module}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    forkserver._forkserver._stop()  # type: ignore[attr-defined]
    assert limited(os.getenv, "PYTHONSAFEPATH", returns=True) is None
    assert not (tmp_path / "imported").exists()


def test_the_environment_changes_only_where_the_process_that_is_copied_begins(monkeypatch: pytest.MonkeyPatch):
    """Other threads may be reading it."""
    limited(os.getpid)
    monkeypatch.setattr("pbl_pipeline.limited.variables", None)
    assert limited(os.getpid, returns=True)


def _loaded(module: str) -> bool:
    import pbl_pipeline.video  # noqa: F401

    return module in sys.modules
