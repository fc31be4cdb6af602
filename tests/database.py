"""Private database servers for tests and benchmarks, each in a home of its own."""

import atexit
import contextlib
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from pbl_schemas.datajoint_setup import datajoint
from pbl_schemas.operations import embedded
from tests import mysql

#: For tests of what the embedded server alone has.
embedded_only = pytest.mark.skipif(mysql.chosen(), reason="a test of the embedded database, not of the server's kind")


def new_home() -> Path:
    """A fresh folder for PBL_HOME. Not pytest's own: those are closed to the account root's server runs as."""
    home = Path(tempfile.mkdtemp(prefix="pbl-test-"))
    home.chmod(0o755)
    return home


def remove_home(home: Path) -> None:
    """Stop the server of this home, if any, and delete everything."""
    embedded.stop(folder=embedded.Folder(home / "db"))
    shutil.rmtree(home, ignore_errors=True)


def keep(home: Path, name: str) -> None:
    """Keep a copy of the database of the embedded server of this home."""
    folder = embedded.Folder(home / "db")
    embedded.stop(folder=folder)
    subprocess.run(["cp", "-a", "--sparse=always", folder.path, home / name], check=True)
    embedded.start(folder=folder)


def put_back(home: Path, name: str) -> None:
    """Make the database of this home the copy that was kept under this name."""
    folder = embedded.Folder(home / "db")
    embedded.stop(folder=folder)
    shutil.rmtree(folder.path)
    subprocess.run(["cp", "-a", "--sparse=always", home / name, folder.path], check=True)
    embedded.start(folder=folder)


def leave_nothing_of_the_developer(patch: pytest.MonkeyPatch) -> None:
    """Take away DJ_* and the database's PBL_* variables: no real server and none of the user's tables is in reach."""
    for name in [n for n in os.environ if n.startswith("DJ_") or n in ("PBL_STORE", "PBL_DB_PREFIX")]:
        if name not in ("DJ_LOG_LEVEL", "DJ_IGNORE_CONFIG_FILE"):
            patch.delenv(name)


@contextlib.contextmanager
def lines_parsed_once() -> Iterator[None]:
    """Let DataJoint parse each line of a definition once: tests declare and compare the same tables again and again."""
    parser = datajoint.declare.attribute_parser

    @functools.cache
    def parsed(line: str) -> Any:
        return parser.parse_string(line, parse_all=True)

    def copied(line: str, parse_all: bool) -> Any:
        return parsed(line).copy()

    with mock.patch.object(datajoint.declare, "attribute_parser", mock.Mock(parse_string=copied)):
        yield


@contextlib.contextmanager
def server(home: Path) -> Iterator[dict[str, str]]:
    """Start the database of a home; yields the variables with which `pbl` uses it. MySQL is ended after, the embedded
    server with its home (`remove_home`)."""
    with lines_parsed_once():
        if mysql.chosen():
            with mysql.running(home / "db") as started:
                yield {"PBL_HOME": str(home), **started.environment}
        else:
            embedded.start(folder=embedded.Folder(home / "db"))
            yield {"PBL_HOME": str(home)}


@contextlib.contextmanager
def installation() -> Iterator[Path]:
    """A running server with its store, and PBL_HOME set to its folder, which is yielded and removed after.

    The embedded one; a MySQL server where PBL_TEST_DATABASE asks for that (`tests.mysql`). The embedded one leaves it
    to the system when a commit is on the disk: a test outlives no power cut. What a killed server keeps is tested on
    servers with the settings of users (test_embedded_db.py).
    """
    home = new_home()
    end = functools.partial(remove_home, home)
    atexit.register(end)  # also when what uses it breaks off
    with pytest.MonkeyPatch.context() as patch:
        leave_nothing_of_the_developer(patch)
        try:
            with server(home) as variables:
                for name, value in variables.items():
                    patch.setenv(name, value)
                if not mysql.chosen():
                    with embedded.admin(embedded.Folder(home / "db")) as connection, connection.cursor() as cursor:
                        cursor.execute("SET GLOBAL innodb_flush_log_at_trx_commit = 2")
                yield home
        finally:
            end()
            atexit.unregister(end)
