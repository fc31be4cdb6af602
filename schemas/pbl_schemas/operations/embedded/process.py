"""The server process: launch it, find it again, log in to it."""

from __future__ import annotations

import re
import subprocess
import time
from pathlib import Path
from textwrap import indent
from typing import Any

import pymysql

from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import memory_bytes

from .binaries import Binaries
from .folder import ADMIN_USER, HOST, Account, Folder, folder_error, free_port, port_free

START_TIMEOUT_S = 60.0
#: An empty database takes 100 MB with these, and 349 MB with 256M and the growth by 64 MB that is the default.
LOG_SIZE = "--innodb-log-file-size=64M"

#: Options of the running server. Without a character set it would use latin1; with a case-insensitive collation the
#: keys "a" and "A" would collide; the default packets of 16 MB truncate arrays at 8 MB; a worker may be silent for a
#: long time while it computes.
OPTIONS = (
    f"--bind-address={HOST}",
    "--skip-name-resolve",
    "--character-set-server=utf8mb4",
    "--collation-server=utf8mb4_bin",
    "--max-allowed-packet=1G",
    LOG_SIZE,
    "--innodb-autoextend-increment=8",
    "--innodb-flush-log-at-trx-commit=1",
    "--performance-schema=OFF",
    "--wait-timeout=604800",
)

# Children of this process, kept so that an exited one is reaped and not mistaken for a running server.
_children: dict[int, subprocess.Popen[str]] = {}


def buffer_pool_mb() -> int:
    """Return the memory (MB) in which the server keeps rows: an eighth of the machine's, between 256 MB and 8 GB,
    because computations share it."""
    return min(max(memory_bytes() // 8 // 2**20, 256), 8192)


def launch(folder: Folder, binaries: Binaries, account: Account) -> None:
    """Start the server as a separate process that outlives this one, and wait until it answers. Raises `PblError`
    DB_UNAVAILABLE with the server's last lines and the remedy."""
    port = folder.state().get("port")
    for attempt in range(5):
        if port is None or attempt > 0 or not port_free(port):
            port = free_port()
        command = [
            str(binaries.server),
            "--no-defaults",
            f"--basedir={binaries.basedir}",
            f"--datadir={folder.data}",
            f"--tmpdir={folder.tmp}",
            # Relative to the data folder: a socket's path is limited to 107 bytes, and the folder's may be longer.
            "--socket=../run/s.sock",
            f"--pid-file={folder.run / 'pid'}",
            f"--log-error={folder.log}",
            f"--port={port}",
            f"--innodb-buffer-pool-size={buffer_pool_mb()}M",
            *OPTIONS,
        ]
        log_start = folder.log.stat().st_size if folder.log.exists() else 0
        try:
            child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=binaries.environment(),
                start_new_session=True,
                text=True,
                **account.popen(),
            )
        except OSError as error:
            raise folder_error(folder.path, error) from error
        _children[child.pid] = child
        folder.write_state(port=port, pid=child.pid)
        try:
            wait_until_answers(folder)
            return
        except PblError:
            said = folder.log.read_bytes()[log_start:] if folder.log.exists() else b""
            if child.poll() is None or b"Bind on TCP/IP port" not in said or attempt == 4:
                raise
            # Another program took the port after it was checked: choose another.


def wait_until_answers(folder: Folder) -> None:
    """Wait until an administrator can log in. Raises `PblError` DB_UNAVAILABLE when the process ends, or does not
    answer within a minute (it continues then)."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            with admin(folder) as connection, connection.cursor() as cursor:
                cursor.execute("SELECT VERSION()")
                version = (cursor.fetchone() or (None,))[0]
        except pymysql.err.OperationalError as error:
            ended = running_pid(folder) is None
            if not ended and time.monotonic() < deadline:
                time.sleep(0.05)
                continue
            if ended:
                what, next_step = "ended instead of starting", _advice(folder)
            else:
                what = f"runs but does not answer within {START_TIMEOUT_S:.0f} s ({error.args[-1]})"
                next_step = "a long recovery may still be going on: check again with pbl db status"
            raise PblError(
                "DB_UNAVAILABLE",
                key=folder.path,
                found=f"the server {what}; its last lines:\n{indent(folder.log_tail(), 6 * ' ')}",
                expected="a server that answers within seconds",
                next_step=next_step,
            ) from error
        if folder.state().get("version") != version:
            folder.write_state(version=version)
        return


def admin(folder: Folder) -> pymysql.Connection[Any]:
    """Return a connection as administrator, with short time limits."""
    return pymysql.connect(
        host=HOST,
        port=int(folder.state().get("port") or 0),
        user=ADMIN_USER,
        password=folder.credentials().admin_password,
        connect_timeout=3,
        read_timeout=10,
        ssl_disabled=True,
    )


def running_pid(folder: Folder) -> int | None:
    """Return the number of the server process of this folder; None if it does not run."""
    pid = folder.state().get("pid")
    return pid if pid is not None and alive(pid, folder) else None


def alive(pid: int, folder: Folder) -> bool:
    """Return whether process `pid` is still the server of this folder: another program may have its number."""
    if pid in _children:
        return _children[pid].poll() is None
    marker = f"--datadir={folder.data}"
    if not Path("/proc/self/cmdline").exists():
        listed = subprocess.run(["ps", "-p", str(pid), "-o", "command="], capture_output=True, text=True, check=False)
        return marker in listed.stdout
    proc = Path("/proc") / str(pid)
    try:
        state = (proc / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
        return state not in ("Z", "X") and marker in (proc / "cmdline").read_text(encoding="utf-8").split("\0")
    except (FileNotFoundError, ProcessLookupError):
        return False


def _advice(folder: Folder) -> str:
    tail = folder.log_tail(40)
    if re.search(r"No space left|\berr\w*:? 28\b", tail, re.IGNORECASE):
        return "the disk is full: free some space, then pbl db start"
    if re.search(r"Permission denied|\berr\w*:? 13\b", tail, re.IGNORECASE):
        return f"something in {folder.path} belongs to another user: start it as the user who set it up"
    if "Unable to lock" in tail or "Resource temporarily unavailable" in tail:
        return "another server uses these files: end that process named mariadbd, then pbl db start"
    return f"read {folder.log}; if it speaks of corruption, restore a backup or move the folder away, then pbl db init"
