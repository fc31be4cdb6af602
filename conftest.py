"""Fixtures of `tests` and `research/tests`: the development data, a private database, and no trace of the developer's
own. They stand at the root because each has to exist once: a second copy of `nothing_of_the_developer` would point
PBL_HOME away from a database that runs.

Tests use the user's cache (PBL_CACHE) like every command does: assets are checked against their SHA-256 at each use and
compiled programs are found by what was compiled, so neither can carry a result from one run to the next, and fetching
45 MB and compiling for a minute in every run would test nothing new (tests/integration/test_assets_real.py fetches
into an empty cache on purpose). Set PBL_CACHE to try a cold start. The database, its store and all results are private.
"""

from __future__ import annotations

import gc
import importlib.util
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import SHARED, Environment, compiled
from tests.database import installation, leave_nothing_of_the_developer
from tests.remembered import points_kept_in, remembered

#: How to have what the browser tests need, "" on a machine that has it.
_CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_NO_BROWSER = " and ".join(
    how
    for how, there in (
        ("apt-get install chromium", _CHROMIUM),
        ("pip install -e .[browser]", importlib.util.find_spec("playwright")),
    )
    if not there
)

#: Markers of tests that run only where they are asked for, and why.
_LEFT_OUT = {
    "machine": "starts services or needs two idle cores",
    "long": "takes tens of seconds for what few changes touch",
}


# Modules and tests live as long as the process: while they are loaded there is nothing to collect, and later they are
# not searched again each time (`pytest_collection_finish`).
gc.disable()


def pytest_collection_finish() -> None:
    """Clear up once after loading the tests; from here on as usual, for what the tests make."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark `database` and `browser` by the fixtures; skip tests that run only where they are asked for; the demo comes
    first: it takes longest, and what it compiles others find, if they do not compile it at the same time."""
    items.sort(key=lambda item: item.path.name != "test_demo.py")
    for item in items:
        names = getattr(item, "fixturenames", ())
        if "database" in names:
            item.add_marker(pytest.mark.database)
        if "chromium" in names:
            item.add_marker(pytest.mark.browser)
            if _NO_BROWSER:
                item.add_marker(pytest.mark.skip(reason=f"browser: {_NO_BROWSER}"))
        for marker, reason in _LEFT_OUT.items():
            if item.get_closest_marker(marker) and marker not in config.option.markexpr:
                item.add_marker(pytest.mark.skip(reason=f"{reason}: pytest -m {marker}"))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say in one line that the browser tests were left out, and how to have them."""
    skipped = terminalreporter.stats.get("skipped", ())
    n_left_out = sum(f"browser: {_NO_BROWSER}" in str(report.longrepr) for report in skipped)
    if _NO_BROWSER and n_left_out:
        terminalreporter.write_line(f"LEFT OUT: {n_left_out} tests of pages in a browser; to run them: {_NO_BROWSER}")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The development recordings beside the project; tests that need them skip where they are absent."""
    if not SHARED.is_dir():
        pytest.skip("the development data (../shared/data) is absent")
    return SHARED


@pytest.fixture(scope="session", autouse=True)
def nothing_of_the_developer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Without DJ_* and the database's PBL_* variables: no test can reach a real server or the user's tables."""
    with pytest.MonkeyPatch.context() as patch:
        leave_nothing_of_the_developer(patch)
        # Where no test asks for a database, a command that wants one finds none running.
        patch.setenv("PBL_HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> Environment:
    """Variables of the environment for a test, by their names; None removes one."""

    def set_for_the_test(**values: object) -> None:
        for name, value in values.items():
            if value is None:
                monkeypatch.delenv(name, raising=False)
            else:
                monkeypatch.setenv(name, str(value))

    return set_for_the_test


@pytest.fixture(scope="session", autouse=True)
def phases_predicted_once() -> Iterator[None]:
    """Network and filter of events look at each walk once: tests have few, and every report and export is of one."""
    from pbl_pipeline.gait.events import phase

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phase, "predict", remembered(phase.predict))
        patch.setattr(phase, "smooth_phases", remembered(phase.smooth_phases))
        yield


@pytest.fixture(name="little_optimised")
def _little_optimised() -> Iterator[None]:
    """For tests that compile much and compute little (`compiled.little_optimised`)."""
    with compiled.little_optimised():
        yield


@pytest.fixture(scope="session")
def points_seen_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """For files that measure the same recordings: in a run the networks of points look at each crop once."""
    from pbl_pipeline.models import Network

    run = tmp_path_factory.getbasetemp()
    folder = (run.parent if "PYTEST_XDIST_WORKER" in os.environ else run) / "points"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Network, "__call__", points_kept_in(folder, Network.__call__))
        yield


@pytest.fixture(scope="session")
def database(nothing_of_the_developer: None) -> Iterator[Path]:
    """The embedded server, running, with PBL_HOME set to its folder for the whole session; yields that folder."""
    with installation() as home:
        yield home


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The Chromium of the machine, without windows."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()
