"""Shared fixtures: the development data, a private database, and no trace of the developer's own.

Tests use the user's cache (PBL_CACHE) like every command does: assets are checked against their SHA-256 at each use and
compiled programs are found by what was compiled, so neither can carry a result from one run to the next, and fetching
45 MB and compiling for a minute in every run would test nothing new (tests/integration/test_assets_real.py fetches
into an empty cache on purpose). Set PBL_CACHE to try a cold start. The database, its store and all results are private.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.database import installation, leave_nothing_of_the_developer

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The marker `database` follows from the fixture of that name; `machine` runs only where it is asked for."""
    for item in items:
        if "database" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.database)
        if item.get_closest_marker("machine") and "machine" not in config.option.markexpr:
            item.add_marker(pytest.mark.skip(reason="takes minutes and starts services: pytest -m machine"))


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


@pytest.fixture(scope="session")
def database(nothing_of_the_developer: None) -> Iterator[Path]:
    """The embedded server, running, with PBL_HOME set to its folder for the whole session; yields that folder."""
    with installation() as home:
        yield home
