"""Create, start, stop and inspect the embedded server."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent

import pymysql

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_out_folder

from .binaries import Binaries, Say, check_obtainable, find_server, get_server, silent
from .folder import ADMIN_USER, APP_USER, HOST, Account, Credentials, Folder, free_port, server_account
from .process import LOG_SIZE, admin, alive, launch, running_pid, wait_until_answers

SETUP_TIMEOUT_S = 300.0
#: An empty database takes 110 MB, most of it the log that is laid out in advance.
NEEDED_MB = 500

#: The installation leaves up to four root accounts without a password (localhost, the machine's name, 127.0.0.1, ::1).
#: All are dropped: the only administrator has a random password. mariadb.sys owns system views and is locked, PUBLIC
#: is a role.
DROP_EVERY_ACCOUNT = (
    "BEGIN NOT ATOMIC FOR a IN (SELECT User, Host FROM mysql.global_priv WHERE User NOT IN ('mariadb.sys', 'PUBLIC')) "
    "DO EXECUTE IMMEDIATE CONCAT('DROP USER ', QUOTE(a.User), '@', QUOTE(a.Host)); END FOR; END;"
)


def initialise(folder: Folder, binaries: Binaries, account: Account) -> None:
    """Fill `folder.data` and write the credentials, which mark the set-up as complete. Raises `PblError` DB_UNAVAILABLE
    with the output of the program that failed."""
    # The remains of an interrupted first start are not a database: nothing was ever stored in it.
    shutil.rmtree(folder.data, ignore_errors=True)
    folder.create(account)
    where = [f"--datadir={folder.data}", f"--basedir={binaries.basedir}", f"--tmpdir={folder.tmp}", LOG_SIZE]
    # "--force": the name of this machine need not resolve (a bare container); the accounts with it are dropped below.
    install = [str(binaries.install_db), "--no-defaults", "--force", "--auth-root-authentication-method=normal"]
    _run([*install, "--skip-test-db", *where], "", folder, binaries, account)
    credentials = Credentials.new()
    # One statement a line, read from stdin: passwords appear neither on a command line nor in a file.
    statements = [
        "USE mysql;",
        "FLUSH PRIVILEGES;",
        DROP_EVERY_ACCOUNT,
        f"CREATE USER '{ADMIN_USER}'@'{HOST}' IDENTIFIED BY '{credentials.admin_password}';",
        f"GRANT ALL PRIVILEGES ON *.* TO '{ADMIN_USER}'@'{HOST}' WITH GRANT OPTION;",
        f"CREATE USER '{APP_USER}'@'{HOST}' IDENTIFIED BY '{credentials.app_password}';",
        f"{grant('pbl')};",
    ]
    bootstrap = [str(binaries.server), "--no-defaults", "--bootstrap", *where]
    _run(bootstrap, "\n".join(statements) + "\n", folder, binaries, account)
    folder.write_state(port=free_port(), pid=None, prefixes=["pbl"])
    folder.write_credentials(credentials)


def prepare(say: Say = silent, folder: Folder | None = None) -> None:
    """Get the server if it is absent, and check the place of a new database; makes none. Raises `PblError`
    DB_UNAVAILABLE as `start` does."""
    folder = folder or Folder.default()
    if running_pid(folder) is not None:
        return
    check_obtainable()
    try:
        check_out_folder(folder.path, 0 if folder.initialised() else NEEDED_MB)
    except PblError as error:
        next_step = "free some space, or set PBL_HOME to a folder of your own on a local disk"
        raise PblError(
            "DB_UNAVAILABLE", error.found, f"a folder with {NEEDED_MB} MB free", next_step, folder.path
        ) from error
    if find_server() is None:
        folder.create(server_account(folder.data))
        with folder.locked():
            get_server(say)


def grant(prefix: str) -> str:
    r"""Return the statement that grants the application all rights on the schemas `<prefix>_...`, and none elsewhere.

    Raises `PblError` USAGE when `prefix` cannot begin the name of a schema.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,29}", prefix):
        raise PblError(
            "USAGE",
            key=f"PBL_DB_PREFIX={prefix!r}",
            found="this prefix cannot begin the name of a schema",
            expected="a small letter, then up to 29 small letters, digits or underscores",
            next_step="choose another prefix, or unset PBL_DB_PREFIX to use pbl",
        )
    # In a pattern of GRANT the underscore stands for any character unless escaped.
    pattern = f"{prefix}_".replace("_", r"\_")
    return f"GRANT ALL PRIVILEGES ON `{pattern}%`.* TO '{APP_USER}'@'{HOST}'"


def _run(command: list[str], stdin: str, folder: Folder, binaries: Binaries, account: Account) -> None:
    try:
        done = subprocess.run(
            command,
            input=stdin.encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd="/",
            env=binaries.environment(),
            timeout=SETUP_TIMEOUT_S,
            check=False,
            **account.popen(),
        )
        code, said = done.returncode, done.stdout.decode(errors="replace")
    except subprocess.TimeoutExpired as error:
        code, said = "none", f"no end within {SETUP_TIMEOUT_S:.0f} s\n{(error.stdout or b'').decode(errors='replace')}"
    except OSError as error:
        code, said = "none", f"cannot be run: {error}"
    if code == 0 and "[ERROR]" not in said and not said.startswith("ERROR"):
        return
    shutil.rmtree(folder.data, ignore_errors=True)
    # The installer ends with a page of general advice; the lines with the reason precede it.
    lines = [line for line in said.splitlines() if "ERROR" in line] or said.splitlines()
    raise PblError(
        "DB_UNAVAILABLE",
        key=folder.path,
        found=f"{Path(command[0]).name} failed (code {code}):\n" + indent("\n".join(lines[-8:]), 6 * " "),
        expected="an empty database",
        next_step="free some space if the disk is full, see that the folder is on a local disk, then: pbl db start",
    )


STOP_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Status:
    """Status of the server; entries are None if it does not run.

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
    """Get the server, set it up and start it, as far as needed. Safe to repeat, also concurrently.

    Raises `PblError` DB_UNAVAILABLE: no server could be obtained, the folder is unusable, or the server does not start
    (with its last log lines).

    Returns `Status`, with `running` True.
    """
    folder = folder or Folder.default()
    prepare(say, folder)  # before a folder is made
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
    """Stop the server and wait for its end. Safe to call when none runs.

    Returns whether one was running. Raises `PblError` DB_REFUSED if it does not end within a minute.

    `on_demand`: let the next connection start it again (`starts_on_demand`), until it is stopped without this.
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
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
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
    """Return whether the server is stopped in such a way that the next connection starts it."""
    return bool(folder.state().get("on_demand")) and running_pid(folder) is None


def status(folder: Folder | None = None) -> Status:
    """Return the server's status; change nothing."""
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
    """Grant the application access to the schemas `<prefix>_...`, and record it in `server.json`. Raises `PblError`
    USAGE when the prefix cannot begin a name; DB_NOT_RUNNING when the server does not answer."""
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
    """Return the coded error for an embedded server that does not answer."""
    return PblError(
        "DB_NOT_RUNNING",
        key=f"embedded database in {folder.path}",
        found=found,
        expected="a running server",
        next_step="pbl db start",
    )
