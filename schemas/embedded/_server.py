"""Start, stop and look at the embedded server."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import socket
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pymysql

from pbl_pipeline.errors import PblError

from ._account import Account, server_account
from ._binaries import Binaries, Say, get_server, silent
from ._folder import ADMIN_USER, APP_USER, Credentials, Folder, folder_error

HOST = "127.0.0.1"
#: Ports to choose from: below the range the system hands out to outgoing connections.
PORTS = range(13306, 30000)
START_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 60.0

#: Options of the running server. Without a character set the server would use latin1, and with a case-insensitive
#: collation the keys "a" and "A" would collide; packets of 16 MB (the default) cut arrays off at 8 MB.
SERVER_OPTIONS = (
    f"--bind-address={HOST}",
    "--skip-name-resolve",
    "--character-set-server=utf8mb4",
    "--collation-server=utf8mb4_bin",
    "--max-allowed-packet=1G",
    "--innodb-buffer-pool-size=256M",
    "--innodb-log-file-size=256M",
    "--innodb-flush-log-at-trx-commit=1",
    "--performance-schema=OFF",
    "--wait-timeout=604800",
)

# Children of this process, kept so that an ended one is reaped and not taken for a running server.
_children: dict[int, subprocess.Popen[bytes]] = {}


@dataclass(frozen=True)
class Status:
    """What is known about the server; entries are None where it does not run."""

    running: bool
    folder: str
    initialised: bool
    pid: int | None = None
    host: str | None = None
    port: int | None = None
    version: str | None = None
    uptime_s: int | None = None
    data_mb: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def start(say: Say = silent, folder: Folder | None = None) -> Status:
    """Have the server running: get it, set it up and start it as far as needed. Safe to call again, and at once.

    Parameters
    ----------
    say
        Told in a sentence what is being done.
    folder
        Where; default `settings.home_dir()/db`.

    Returns
    -------
    Status
        With `running` True.

    Raises
    ------
    PblError
        DB_UNAVAILABLE: no server to be had, folder unusable, or the server does not start (with its last words).
    """
    folder = folder or Folder.default()
    account = server_account()
    folder.create(account)
    with folder.locked():
        if _pid(folder) is not None:
            _wait_until_answers(folder, None)
            say(f"The database is running already (port {folder.state()['port']}).")
            return status(folder)
        binaries = get_server(say)
        if not folder.initialised():
            say(f"Creating the database in {folder.path}")
            _initialise(folder, binaries, account)
        _launch(folder, binaries, account)
    now = status(folder)
    say(f"The database is running: {HOST}:{now.port}, process {now.pid}, folder {folder.path}")
    return now


def stop(say: Say = silent, folder: Folder | None = None) -> bool:
    """End the server and wait for it. Safe to call when none runs.

    Returns
    -------
    bool
        True when one was running.

    Raises
    ------
    PblError
        DB_REFUSED when it does not end within a minute.
    """
    folder = folder or Folder.default()
    if not folder.path.is_dir() or not folder.initialised():
        say("The database is not running.")
        return False
    with folder.locked():
        pid = _pid(folder)
        if pid is None:
            say("The database is not running.")
            return False
        try:
            with _admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute("SHUTDOWN")
        except pymysql.err.Error:
            # It answers no more, or not yet: the signal asks for the same orderly end.
            _signal(pid, signal.SIGTERM)
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while _alive(pid, folder):
            if time.monotonic() > deadline:
                raise PblError(
                    "DB_REFUSED",
                    key=f"process {pid}",
                    found=f"the server did not end within {STOP_TIMEOUT_S:.0f} s",
                    expected="an orderly end within seconds",
                    next_step=f"see {folder.log}; in need: kill -9 {pid} (committed rows are kept)",
                )
            time.sleep(0.05)
        folder.write_state(pid=None)
    say("The database is stopped.")
    return True


def status(folder: Folder | None = None) -> Status:
    """Look at the server; changes nothing."""
    folder = folder or Folder.default()
    if not folder.initialised():
        return Status(False, str(folder.path), False)
    state = folder.state()
    pid = _pid(folder)
    if pid is None:
        return Status(False, str(folder.path), True, port=state.get("port"), version=state.get("version"))
    version, uptime_s, data_mb = state.get("version"), None, None
    try:
        with _admin(folder) as connection, connection.cursor() as cursor:
            cursor.execute("SHOW GLOBAL STATUS LIKE 'Uptime'")
            uptime_s = int((cursor.fetchone() or ("", 0))[1])
            cursor.execute("SELECT VERSION()")
            version = (cursor.fetchone() or (None,))[0]
            cursor.execute(
                "SELECT COALESCE(SUM(data_length + index_length), 0) FROM information_schema.tables "
                "WHERE table_schema NOT IN ('mysql', 'sys', 'information_schema', 'performance_schema')"
            )
            data_mb = round(float((cursor.fetchone() or (0,))[0]) / 2**20, 2)
    except pymysql.err.OperationalError:
        return Status(False, str(folder.path), True, pid=pid, host=HOST, port=state.get("port"), version=version)
    return Status(True, str(folder.path), True, pid, HOST, state.get("port"), version, uptime_s, data_mb)


def remove(folder: Folder | None = None) -> None:
    """Stop the server and delete its folder with all tables. For tests: no command does this."""
    folder = folder or Folder.default()
    stop(folder=folder)
    shutil.rmtree(folder.path, ignore_errors=True)


def allow_prefix(prefix: str, folder: Folder | None = None) -> None:
    """Let the application use the schemas `<prefix>_...`; the server keeps the right, `server.json` the memory of it.

    Raises
    ------
    PblError
        USAGE when the prefix is not a name; DB_NOT_RUNNING when the server does not answer.
    """
    folder = folder or Folder.default()
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,29}", prefix):
        raise PblError(
            "USAGE",
            key=f"PBL_DB_PREFIX={prefix!r}",
            found="this prefix cannot begin the name of a schema",
            expected="a small letter, then up to 29 small letters, digits or underscores",
            next_step="choose another prefix, or unset PBL_DB_PREFIX to use pbl",
        )
    if prefix in folder.state().get("prefixes", []):
        return
    with folder.locked():
        try:
            with _admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute(_grant(prefix))
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


def _grant(prefix: str) -> str:
    # In a pattern of GRANT the underscore stands for any character unless escaped.
    pattern = f"{prefix}_".replace("_", r"\_")
    return f"GRANT ALL PRIVILEGES ON `{pattern}%`.* TO '{APP_USER}'@'{HOST}'"


def _initialise(folder: Folder, binaries: Binaries, account: Account) -> None:
    """Fill the data folder and set the accounts, before the server listens for the first time."""
    # What an interrupted first start left is not a database: nothing was ever stored in it.
    shutil.rmtree(folder.data, ignore_errors=True)
    folder.create(account)
    install_db = [
        str(binaries.install_db),
        "--no-defaults",
        "--auth-root-authentication-method=normal",
        "--skip-test-db",
        f"--datadir={folder.data}",
        f"--basedir={binaries.basedir}",
        f"--tmpdir={folder.tmp}",
    ]
    _run_as(install_db, folder, binaries, account, "")
    credentials = Credentials.new()
    # The installation leaves up to four root accounts without a password. They go, all of them: the server's own
    # administrator has a random password, and nobody who is not told it gets in.
    sql = f"""USE mysql;
FLUSH PRIVILEGES;
BEGIN NOT ATOMIC
  FOR account IN (SELECT User, Host FROM mysql.global_priv WHERE User <> 'mariadb.sys' AND User <> 'PUBLIC') DO
    EXECUTE IMMEDIATE CONCAT('DROP USER ', QUOTE(account.User), '@', QUOTE(account.Host));
  END FOR;
END;
CREATE USER '{ADMIN_USER}'@'{HOST}' IDENTIFIED BY '{credentials.admin_password}';
GRANT ALL PRIVILEGES ON *.* TO '{ADMIN_USER}'@'{HOST}' WITH GRANT OPTION;
CREATE USER '{APP_USER}'@'{HOST}' IDENTIFIED BY '{credentials.app_password}';
{_grant("pbl")};
"""
    # Bootstrap mode reads one statement a line.
    sql = (
        sql.replace("BEGIN NOT ATOMIC\n", "BEGIN NOT ATOMIC ")
        .replace("DO\n", "DO ")
        .replace(";\n  END FOR;\nEND", "; END FOR; END")
    )
    bootstrap = [
        str(binaries.server),
        "--no-defaults",
        "--bootstrap",
        f"--datadir={folder.data}",
        f"--basedir={binaries.basedir}",
        f"--tmpdir={folder.tmp}",
    ]
    _run_as(bootstrap, folder, binaries, account, sql)
    folder.write_state(port=_free_port(), pid=None, prefixes=["pbl"])
    folder.write_credentials(credentials)


def _launch(folder: Folder, binaries: Binaries, account: Account) -> None:
    port = folder.state().get("port")
    for attempt in range(5):
        if port is None or attempt > 0 or not _port_free(port):
            port = _free_port()
        command = [
            str(binaries.server),
            "--no-defaults",
            f"--basedir={binaries.basedir}",
            f"--datadir={folder.data}",
            f"--tmpdir={folder.tmp}",
            # Relative to the data folder: a socket's path may have 107 bytes at most, the folder's may be longer.
            "--socket=../run/s.sock",
            f"--pid-file={folder.run / 'pid'}",
            f"--log-error={folder.log}",
            f"--port={port}",
            *SERVER_OPTIONS,
        ]
        log_start = folder.log.stat().st_size if folder.log.exists() else 0
        try:
            child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=_env(binaries),
                start_new_session=True,
                **account.popen(),
            )
        except OSError as error:
            raise folder_error(folder.path, error) from error
        _children[child.pid] = child
        folder.write_state(port=port, pid=child.pid)
        try:
            _wait_until_answers(folder, child)
            return
        except PblError:
            said = folder.log.read_bytes()[log_start:] if folder.log.exists() else b""
            if child.poll() is None or b"Bind on TCP/IP port" not in said:
                raise
            # Somebody took the port between our look and the server's: choose another.


def _wait_until_answers(folder: Folder, child: subprocess.Popen[bytes] | None) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            with _admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute("SELECT VERSION()")
                version = (cursor.fetchone() or (None,))[0]
                if folder.state().get("version") != version:
                    folder.write_state(version=version)
                return
        except pymysql.err.OperationalError as error:
            ended = _pid(folder) is None if child is None else child.poll() is not None
            if ended or time.monotonic() > deadline:
                what = (
                    "ended at once" if ended else f"does not answer within {START_TIMEOUT_S:.0f} s ({error.args[-1]})"
                )
                raise PblError(
                    "DB_UNAVAILABLE",
                    key=folder.path,
                    found=f"the server {what}; its last lines:\n{_indent(folder.log_tail())}",
                    expected="a server that answers within seconds",
                    next_step=_advice(folder),
                ) from error
            time.sleep(0.05)


def _advice(folder: Folder) -> str:
    tail = folder.log_tail(40)
    if "No space left" in tail or "Errcode: 28" in tail:
        return "the disk is full: free some space, then pbl db start"
    if "Permission denied" in tail or "Errcode: 13" in tail:
        return f"something in {folder.path} belongs to another user: start it as the user who set it up"
    if "Unable to lock" in tail or "unavailable" in tail:
        return "another server uses these files: end it (pbl db stop, or the process named mariadbd), then pbl db start"
    return f"read {folder.log}; if it speaks of corruption, restore a backup or move the folder away, then pbl db init"


def _run_as(command: list[str], folder: Folder, binaries: Binaries, account: Account, stdin: str) -> None:
    done = subprocess.run(
        command,
        input=stdin.encode(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd="/",
        env=_env(binaries),
        timeout=300,
        check=False,
        **account.popen(),
    )
    said = done.stdout.decode(errors="replace")
    if done.returncode != 0 or "ERROR" in said:
        shutil.rmtree(folder.data, ignore_errors=True)
        raise PblError(
            "DB_UNAVAILABLE",
            key=folder.path,
            found=f"{Path(command[0]).name} failed (code {done.returncode}):\n"
            + _indent("\n".join(said.splitlines()[-12:])),
            expected="an empty database",
            next_step="free some space if the disk is full, check that the folder is on a local disk, then pbl db start",
        )


def _env(binaries: Binaries) -> dict[str, str]:
    """A small environment: the server has no business with the caller's variables, which may hold passwords."""
    kept = {k: v for k, v in os.environ.items() if k in ("LANG", "TZ")}
    # UMASK is MariaDB's own variable: files it makes are for its account only.
    return {"PATH": os.defpath + ":/usr/sbin:/sbin", "UMASK": "0600", "UMASK_DIR": "0700", **kept, **binaries.env}


def _admin(folder: Folder) -> pymysql.Connection[Any]:
    return pymysql.connect(
        host=HOST,
        port=int(folder.state().get("port") or 0),
        user=ADMIN_USER,
        password=folder.credentials().admin_password,
        connect_timeout=3,
        read_timeout=10,
        ssl_disabled=True,
    )


def _pid(folder: Folder) -> int | None:
    """Number of the running server process of this folder, or None."""
    pid = folder.state().get("pid")
    return pid if pid is not None and _alive(pid, folder) else None


def _alive(pid: int, folder: Folder) -> bool:
    if pid in _children:
        return _children[pid].poll() is None
    # The number may have gone to another program since, so the command line has to name our data folder.
    proc = Path("/proc") / str(pid)
    if Path("/proc/self").exists():
        try:
            state = (proc / "stat").read_text().rpartition(")")[2].split()[0]
            return state not in ("Z", "X") and f"--datadir={folder.data}" in (proc / "cmdline").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return False
    listed = subprocess.run(["ps", "-p", str(pid), "-o", "command="], capture_output=True, text=True, check=False)
    return f"--datadir={folder.data}" in listed.stdout


def _signal(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def _port_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # As the server does, so that connections of its last life, not yet timed out, do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
        return True


def _free_port() -> int:
    for port in random.sample(PORTS, 200):
        if _port_free(port):
            return port
    raise PblError(
        "DB_UNAVAILABLE",
        found=f"200 ports between {PORTS.start} and {PORTS.stop} were tried and all are taken",
        expected="a free port on 127.0.0.1",
        next_step="see what listens there: ss -ltn",
    )


def _indent(text: str) -> str:
    return "\n".join(f"      {line}" for line in text.splitlines())
