"""A private database for the tests that need one: own folder, own port, gone afterwards."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas import embedded


def new_home() -> Path:
    """A fresh folder for PBL_HOME. Not pytest's own: those are closed to the account root's server runs as."""
    home = Path(tempfile.mkdtemp(prefix="pbl-test-"))
    home.chmod(0o755)
    return home


def remove_home(home: Path) -> None:
    """Stop the server of this home, if any, and delete everything."""
    embedded.remove(embedded.Folder(home / "db"))
    shutil.rmtree(home, ignore_errors=True)


@pytest.fixture(scope="session")
def database() -> Iterator[Path]:
    """The embedded server, running, with PBL_HOME set to its folder for the whole session; yields that folder.

    DJ_* variables of the developer are taken away: tests never touch a real server.
    """
    home = new_home()
    atexit.register(remove_home, home)  # also when pytest itself breaks off
    with pytest.MonkeyPatch.context() as patch:
        for name in [n for n in os.environ if n.startswith("DJ_") or n in ("PBL_STORE", "PBL_DB_PREFIX")]:
            if name not in ("DJ_LOG_LEVEL", "DJ_IGNORE_CONFIG_FILE"):
                patch.delenv(name)
        patch.setenv("PBL_HOME", str(home))
        try:
            embedded.start(folder=embedded.Folder(home / "db"))
            yield home
        finally:
            remove_home(home)
            atexit.unregister(remove_home)
