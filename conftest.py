"""Fixtures of `tests` and `research/tests`: the development data, a private database, and no trace of the developer's
own. They stand at the root because each has to exist once: a second copy of `nothing_of_the_developer` would point
PBL_HOME away from a database that runs.

Tests use the user's cache (PBL_CACHE) like every command does: assets are checked against their SHA-256 at each use and
compiled programs are found by what was compiled, so neither can carry a result from one run to the next, and fetching
45 MB and compiling for a minute in every run would test nothing new (tests/integration/test_assets_real.py fetches
into an empty cache on purpose). Set PBL_CACHE to try a cold start. The database, its store and all results are private.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import importlib.util
import inspect
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pbl_pipeline.resources import fewer_collections
from tests import SHARED, Calls, Environment, Faults, Limits, Machine, StandIn, compiled
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
    fewer_collections()


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


class _Changes:
    """Changes by `monkeypatch`, so that all of a test end in the reverse order of their beginning; with `end` these end
    earlier."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._patch, self.end = patch, contextlib.ExitStack()

    def setattr(self, where: Any, name: str, value: object) -> None:
        where = importlib.import_module(where) if isinstance(where, str) else where
        before = inspect.getattr_static(where, name) if isinstance(where, type) else getattr(where, name)
        self.end.callback(self._patch.setattr, where, name, before)
        self._patch.setattr(where, name, value)

    def without(self, package: str) -> None:
        """An import of this package raises ImportError."""
        before = sys.modules.get(package)
        back = functools.partial(self._patch.setitem, sys.modules, package, before)
        self.end.callback(back if before else functools.partial(self._patch.delitem, sys.modules, package))
        self._patch.setitem(sys.modules, package, None)  # type: ignore[arg-type]


@pytest.fixture
def changes(monkeypatch: pytest.MonkeyPatch) -> Callable[[], _Changes]:
    """For the fixtures below: changes that end with their `with` or with the test."""
    return lambda: _Changes(monkeypatch)


@pytest.fixture
def limits(changes: Callable[[], _Changes]) -> Limits:
    """Times, sizes and numbers that a module states as constants, for a test: `limits(loop, REFRESH_EVERY_S=0.1)`."""

    def are(module: ModuleType | str, **values: object) -> contextlib.ExitStack:
        patch = changes()
        for name, value in values.items():
            assert name.isupper(), f"{name} is not a constant"
            patch.setattr(module, name, value)
        return patch.end

    return are


@pytest.fixture
def machine(changes: Callable[[], _Changes]) -> Machine:
    """What the machine has, for a test: bytes free of 1 TB on every disk, the number of the account, no package of a
    name, no database server outside PATH, a GPU or the address of the process that computes on one."""

    def has(
        *,
        free_bytes: int | None = None,
        account: int | None = None,
        without: Iterable[str] = (),
        servers: bool = True,
        gpu: str | bool | None = None,
    ) -> contextlib.ExitStack:
        patch = changes()
        if free_bytes is not None:
            disk = shutil.disk_usage("/")._replace(total=10**12, free=free_bytes)
            patch.setattr(shutil, "disk_usage", lambda _: disk)
        if account is not None:
            patch.setattr(os, "geteuid", lambda: account)
        for package in without:
            patch.without(package)
        if not servers:
            patch.setattr("pbl_schemas.operations.embedded.binaries", "PLACES", ())
            patch.setattr("pbl_pipeline.cli.doctor", "_SERVER_PLACES", ())
        if gpu is not None:
            patch.setattr("pbl_pipeline.models.gpu_address", "gpu_visible", lambda: bool(gpu))
        if isinstance(gpu, str):
            patch.setattr("pbl_pipeline.models.gpu_address", "running_server", lambda _: gpu)
        return patch.end

    return has


@pytest.fixture
def faults(changes: Callable[[], _Changes]) -> Faults:
    """Lets a function fail: `faults(incoming, "register", None, OSError())` raises an error at the second call; returns
    the arguments of the calls, and works as before at the end of its `with`.

    The error comes before the function does what it does, with `after=True` behind it. `before` and `then` are called
    with the arguments, before and after that."""

    def let(
        where: Any,
        name: str,
        *errors: BaseException | type[BaseException] | None,
        after: bool = False,
        before: Callable[..., object] = lambda *_, **__: None,
        then: Callable[..., object] = lambda *_, **__: None,
    ) -> Calls:
        patch = changes()
        where = importlib.import_module(where) if isinstance(where, str) else where
        real, left, calls = getattr(where, name), list(errors), Calls(patch.end)

        def fails(*args: Any, **options: Any) -> Any:
            calls.append(args)
            before(*args, **options)
            error = left.pop(0) if left else None
            if error is not None and not after:
                raise error
            done = real(*args, **options)
            then(*args, **options)
            if error is not None:
                raise error
            return done

        patch.setattr(where, name, fails)
        return calls

    return let


@pytest.fixture
def stand_in(changes: Callable[[], _Changes]) -> StandIn:
    """Replaces stages of the chain by their names (`tests.integration.chain.STAGES`)."""
    from tests.integration import chain

    return lambda **functions: chain.replace(changes(), **functions)


@pytest.fixture
def in_empty_folder(tmp_path: Path) -> Iterator[Path]:
    """A folder of the test's own, which is the working folder."""
    with contextlib.chdir(tmp_path):
        yield tmp_path


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
