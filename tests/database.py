"""Private database servers for tests and benchmarks, each in a home of its own."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.operations import embedded


def new_home() -> Path:
    """A fresh folder for PBL_HOME. Not pytest's own: those are closed to the account root's server runs as."""
    home = Path(tempfile.mkdtemp(prefix="pbl-test-"))
    home.chmod(0o755)
    return home


def remove_home(home: Path) -> None:
    """Stop the server of this home, if any, and delete everything."""
    embedded.stop(folder=embedded.Folder(home / "db"))
    shutil.rmtree(home, ignore_errors=True)


def leave_nothing_of_the_developer(patch: pytest.MonkeyPatch) -> None:
    """Take away DJ_* and the database's PBL_* variables: no real server and none of the user's tables is in reach."""
    for name in [n for n in os.environ if n.startswith("DJ_") or n in ("PBL_STORE", "PBL_DB_PREFIX")]:
        if name not in ("DJ_LOG_LEVEL", "DJ_IGNORE_CONFIG_FILE"):
            patch.delenv(name)


@contextlib.contextmanager
def installation() -> Iterator[Path]:
    """A running embedded server with its store, and PBL_HOME set to its folder, which is yielded and removed after.

    It leaves it to the system when a commit is on the disk: a test outlives no power cut. What a killed server keeps is
    tested on servers with the settings of users (test_embedded_db.py).
    """
    home = new_home()
    end = functools.partial(remove_home, home)
    atexit.register(end)  # also when what uses it breaks off
    with pytest.MonkeyPatch.context() as patch:
        leave_nothing_of_the_developer(patch)
        patch.setenv("PBL_HOME", str(home))
        try:
            folder = embedded.Folder(home / "db")
            embedded.start(folder=folder)
            with embedded.admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute("SET GLOBAL innodb_flush_log_at_trx_commit = 2")
            yield home
        finally:
            end()
            atexit.unregister(end)
