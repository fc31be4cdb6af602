"""Start, stop and inspect the embedded server."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pymysql

from pbl_pipeline.errors import PblError

from .account import server_account
from .binaries import Say, check_obtainable, get_server, silent
from .folder import Folder
from .port import HOST
from .process import admin, alive, launch, running_pid, terminate, wait_until_answers
from .setup import grant, initialise

STOP_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Status:
    """Status of the server; entries are None where it does not run.

    `running` means that it answers; a process that does not answer has a `pid` and `running` False.
    """

    running: bool
    folder: str
    initialised: bool
    pid: int | None = None
    host: str | None = None
    port: int | None = None
    version: str | None = None
    uptime_s: int | None = None
    data_mb: float | None = None


def start(say: Say = silent, folder: Folder | None = None) -> Status:
    """Have the server running: get it, set it up and start it as far as needed. Safe to call again, and at once.

    Raises `PblError` DB_UNAVAILABLE: no server could be obtained, the folder is unusable, or the server does not start
    (with its last log lines).

    Returns `Status`, with `running` True.
    """
    folder = folder or Folder.default()
    if running_pid(folder) is None:
        check_obtainable()  # before a folder is made
    account = server_account(folder.data)
    folder.create(account)
    with folder.locked():
        if running_pid(folder) is not None:
            wait_until_answers(folder)
            now = status(folder)
            say(f"The database is running already: {HOST}:{now.port}, process {now.pid}, folder {folder.path}")
            return now
        binaries = get_server(say)
        if not folder.initialised():
            say(f"Creating the database in {folder.path}")
            initialise(folder, binaries, account)
        launch(folder, binaries, account)
    now = status(folder)
    say(f"The database is running: {HOST}:{now.port}, process {now.pid}, folder {folder.path}")
    return now


def stop(say: Say = silent, folder: Folder | None = None, on_demand: bool = False) -> bool:
    """End the server and wait for it. Safe to call when none runs.

    Raises `PblError` DB_REFUSED when it does not end within a minute.

    Returns True when one was running.

    Parameters
    ----------
    on_demand
        The next connection starts it again (`starts_on_demand`), until it is stopped without this.
    """
    folder = folder or Folder.default()
    if not folder.initialised():
        say(f"The database is not running: there is none in {folder.path}")
        return False
    with folder.locked():
        folder.write_state(on_demand=on_demand)
        pid = running_pid(folder)
        if pid is None:
            say("The database is not running.")
            return False
        try:
            with admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute("SHUTDOWN")
        except pymysql.err.Error:
            # It no longer answers, or not yet: the signal asks for the same orderly end.
            terminate(pid)
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while alive(pid, folder):
            if time.monotonic() > deadline:
                raise PblError(
                    "DB_REFUSED",
                    key=f"process {pid}",
                    found=f"the server did not end within {STOP_TIMEOUT_S:.0f} s",
                    expected="an orderly end within seconds",
                    next_step=f"see {folder.log}; as a last resort: kill -9 {pid} (committed rows are kept)",
                )
            time.sleep(0.05)
        folder.write_state(pid=None)
    say("The database is stopped.")
    return True


def starts_on_demand(folder: Folder) -> bool:
    """Whether the server does not run and was stopped so that the next connection starts it."""
    return bool(folder.state().get("on_demand")) and running_pid(folder) is None


def status(folder: Folder | None = None) -> Status:
    """The server's status; changes nothing."""
    folder = folder or Folder.default()
    if not folder.initialised():
        return Status(False, str(folder.path), False)
    state = folder.state()
    pid, port, version = running_pid(folder), state.get("port"), state.get("version")
    if pid is None:
        return Status(False, str(folder.path), True, version=version)
    try:
        with admin(folder) as connection, connection.cursor() as cursor:
            cursor.execute("SHOW GLOBAL STATUS LIKE 'Uptime'")
            uptime_s = int((cursor.fetchone() or ("", 0))[1])
            cursor.execute(
                "SELECT COALESCE(SUM(data_length + index_length), 0) FROM information_schema.tables "
                "WHERE table_schema NOT IN ('mysql', 'sys', 'information_schema', 'performance_schema')"
            )
            data_mb = round(float((cursor.fetchone() or (0,))[0]) / 2**20, 2)
    except pymysql.err.OperationalError:
        return Status(False, str(folder.path), True, pid, HOST, port, version)
    return Status(True, str(folder.path), True, pid, HOST, port, version, uptime_s, data_mb)


def allow_prefix(prefix: str, folder: Folder | None = None) -> None:
    """Let the application use the schemas `<prefix>_...`; grants access and records it in `server.json`.

    Raises `PblError` USAGE when the prefix cannot begin a name; DB_NOT_RUNNING when the server does not answer.
    """
    folder = folder or Folder.default()
    if prefix in folder.state().get("prefixes", []):
        return
    statement = grant(prefix)
    with folder.locked():
        try:
            with admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute(statement)
        except pymysql.err.OperationalError as error:
            raise not_running(folder, str(error.args[-1])) from error
        folder.write_state(prefixes=sorted({prefix, *folder.state().get("prefixes", [])}))


def not_running(folder: Folder, found: str) -> PblError:
    """The coded error for an embedded server that does not answer."""
    return PblError(
        "DB_NOT_RUNNING",
        key=f"embedded database in {folder.path}",
        found=found,
        expected="a running server",
        next_step="pbl db start",
    )
