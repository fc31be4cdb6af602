"""Content, account and port of the folder of the embedded server, and its permissions."""

from __future__ import annotations

import json
import os
import random
import secrets
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import one_process
from pbl_schemas.operations.folders import write_json

HOST = "127.0.0.1"
#: Ports to choose from: below the range that systems hand out to outgoing connections.
PORTS = range(13306, 30000)


def port_free(port: int) -> bool:
    """Return whether a server could listen on `port` now."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # As the server does, so that connections of its last life that have not timed out do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
        return True


def free_port() -> int:
    """Return a random free port, so that several databases on one machine rarely collide. Raises `PblError`
    DB_UNAVAILABLE when 200 tries find none."""
    for port in random.sample(PORTS, 200):
        if port_free(port):
            return port
    raise PblError(
        "DB_UNAVAILABLE",
        found=f"200 ports between {PORTS.start} and {PORTS.stop} were tried and all are taken",
        expected="a free port on 127.0.0.1",
        next_step="see what listens there: ss -ltn",
    )


#: Kinds of the entries of `server.json`.
_STATE = {
    "port": int | None,
    "pid": int | None,
    "version": str | None,
    "prefixes": list | None,
    "on_demand": bool | None,
}

#: Accounts for a server that root starts, by preference: `mysql` exists only with its packages, `nobody` always.
UNPRIVILEGED = ("mysql", "nobody")


@dataclass(frozen=True)
class Account:
    """A system account: its name, user and group number."""

    name: str
    uid: int
    gid: int

    def popen(self) -> dict[str, Any]:
        """Return arguments of `subprocess` that run a child as this account; none for the caller's own."""
        if self.uid == os.geteuid():
            return {}
        return {"user": self.uid, "group": self.gid, "extra_groups": []}

    def own(self, path: Path) -> None:
        """Give `path` to this account (only root can, and only root has to)."""
        if self.uid != os.geteuid():
            os.chown(path, self.uid, self.gid)


def server_account(data: Path) -> Account:
    """Return the account for the server process: never root.

    Raises `PblError` DB_UNAVAILABLE when the caller is root and the system has no unprivileged account to drop to.

    `data`: the data folder. For root, the owner of an existing one.
    """
    import pwd  # here, because Windows has none and also imports this module

    if os.geteuid() != 0:
        return Account(_name_of(os.geteuid()), os.geteuid(), os.getegid())
    if data.exists() and data.stat().st_uid != 0:
        owner = data.stat()
        return Account(_name_of(owner.st_uid), owner.st_uid, owner.st_gid)
    for name in UNPRIVILEGED:
        try:
            entry = pwd.getpwnam(name)
        except KeyError:
            continue
        return Account(entry.pw_name, entry.pw_uid, entry.pw_gid)
    raise PblError(
        "DB_UNAVAILABLE",
        found="you are root, and there is no account to run the database server as",
        expected=f"one of the accounts {', '.join(UNPRIVILEGED)}; the server never runs as root",
        next_step="run the command as an ordinary user, or create the account: useradd --system --no-create-home mysql",
    )


def check_enterable(folder: Path, account: Account) -> None:
    """Check as `account` that it can enter `folder`: permission bits alone do not decide. Raises `PblError`
    DB_UNAVAILABLE, which names the first closed folder on the way, and the remedy."""
    if not account.popen():
        return
    if _can_enter(folder, account):
        return
    closed = next(step for step in [*reversed(folder.parents), folder] if not _can_enter(step, account))
    raise PblError(
        "DB_UNAVAILABLE",
        key=folder,
        found=f"the account {account.name!r}, which the database server runs as, cannot enter {closed}",
        expected="a folder whose parents it can enter, because the server never runs as root",
        next_step=f"set PBL_HOME to another folder (root's default is /var/lib/pbl), or: chmod a+x {closed}",
    )


def _can_enter(folder: Path, account: Account) -> bool:
    command = ["/bin/sh", "-c", 'cd "$1"', "sh", str(folder)]
    return subprocess.run(command, capture_output=True, cwd="/", check=False, **account.popen()).returncode == 0


def _name_of(uid: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:  # a container may run under a number without a name
        return str(uid)


#: Accounts inside the database.
APP_USER = "pbl"
ADMIN_USER = "pbl_admin"


@dataclass(frozen=True)
class Credentials:
    """The passwords of the application, and of the administrator, who stops the server and grants rights."""

    app_password: str
    admin_password: str

    @staticmethod
    def new() -> Credentials:
        """Return random passwords of 192 bits, in characters that need no quoting."""
        return Credentials(secrets.token_hex(24), secrets.token_hex(24))


class Folder:
    """`<home>/db`: `data/` and `run/` belong to the server's account, the rest to the user.

    data/              the tables (0700)
    run/server.log     the server's log
    run/s.sock         its socket
    credentials.json   passwords (0600)
    server.json        port, process number, version
    lock               held while a command starts or stops the server
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data, self.run, self.tmp = path / "data", path / "run", path / "tmp"
        self.log = self.run / "server.log"
        self.credentials_file, self.state_file = path / "credentials.json", path / "server.json"

    @staticmethod
    def default() -> Folder:
        return Folder(settings.home_dir() / "db")

    def initialised(self) -> bool:
        """Return whether the set-up of the first start is complete (the credentials are written last)."""
        return os.path.exists(self.credentials_file)  # `Path.exists` raises where the folder may not be entered

    def create(self, account: Account) -> None:
        """Make the folders; `account` owns those of the server. Raises `PblError` DB_UNAVAILABLE when they cannot be
        made, or when `account` cannot enter them."""
        try:
            missing = [p for p in (self.path, *self.path.parents) if not p.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
            for folder in missing:  # under any umask: the server's account enters, no one else writes
                folder.chmod(0o755)
            check_enterable(self.path, account)
            for folder, mode in ((self.data, 0o700), (self.run, 0o755), (self.tmp, 0o700)):
                folder.mkdir(exist_ok=True)
                account.own(folder)
                folder.chmod(mode)
        except OSError as error:
            raise folder_error(self.path, error) from error

    @contextmanager
    def locked(self, timeout_s: float = 120.0) -> Iterator[None]:
        """Hold the folder's lock; another command that starts or stops the server waits. Raises `PblError`
        DB_UNAVAILABLE when another command holds it for longer than `timeout_s`."""
        with ExitStack() as stack:
            try:
                stack.enter_context(one_process(self.path / "lock", timeout_s))
            except TimeoutError as error:
                raise PblError(
                    "DB_UNAVAILABLE",
                    key=self.path,
                    found=f"another command has been starting or stopping the server for {timeout_s:.0f} s",
                    expected="one command at a time",
                    next_step="find the `pbl db` command that hangs, end it and try again",
                ) from error
            except OSError as error:
                raise folder_error(self.path, error) from error
            yield

    def credentials(self) -> Credentials:
        """Return the stored passwords. Raises `PblError` DB_NOT_RUNNING when the database was never set up; DB_REFUSED
        when the file may not be read; FILE_FORMAT for one that is damaged."""
        try:
            with _undamaged(
                self.credentials_file, "restore it from a copy of the folder: nothing else has the passwords"
            ):
                return Credentials(**json.loads(self.credentials_file.read_text(encoding="utf-8")))
        except FileNotFoundError as error:
            raise PblError(
                "DB_NOT_RUNNING",
                key=self.path,
                found="there is no database in this folder yet",
                expected="a database that was started once",
                next_step="pbl db start",
            ) from error
        except NotADirectoryError as error:
            raise folder_error(self.path, error) from error
        except PermissionError as error:
            raise PblError(
                "DB_REFUSED",
                key=self.credentials_file,
                found="the file with the passwords belongs to another user",
                expected="the user who set up the database",
                next_step="run the command as that user, or set PBL_HOME to a folder of your own",
            ) from error

    def write_credentials(self, credentials: Credentials) -> None:
        """Store the passwords, readable by their owner only from the first byte on."""
        _write(self.credentials_file, asdict(credentials), 0o600)

    def state(self) -> dict[str, Any]:
        """Return `port`, `pid`, `version` and the schema prefixes the application may use; empty before the first
        start. Raises `PblError` FILE_FORMAT for a damaged file."""
        again = "end the server of this folder if it runs (its number is in run/pid), move the file away, pbl db start"
        try:
            with _undamaged(self.state_file, again):
                found = json.loads(self.state_file.read_text(encoding="utf-8"))
                if not isinstance(found, dict) or not all(isinstance(found.get(n), k) for n, k in _STATE.items()):
                    raise TypeError("another content")
                return found
        except FileNotFoundError:
            return {}
        except (NotADirectoryError, PermissionError) as error:
            raise folder_error(self.path, error) from error

    def write_state(self, **changes: Any) -> dict[str, Any]:
        """Change some entries of the state, keeping the others."""
        state = {**self.state(), **changes}
        _write(self.state_file, state, 0o644)
        return state

    def log_tail(self, lines: int = 12) -> str:
        """Return the last lines of the server's log."""
        try:
            return "\n".join(self.log.read_text(errors="replace", encoding="utf-8").splitlines()[-lines:])
        except OSError as error:
            return f"(no log: {error})"


@contextmanager
def _undamaged(path: Path, next_step: str) -> Iterator[None]:
    """Raise FILE_FORMAT for a damaged file. The content, which may be secret, is not repeated."""
    try:
        yield
    except (ValueError, TypeError, RecursionError) as error:
        found = f"the file is damaged ({type(error).__name__})"
        raise PblError("FILE_FORMAT", found, "the file as `pbl db` wrote it", next_step, str(path)) from error


def folder_error(path: Path, error: OSError) -> PblError:
    """Return the coded error for a folder that cannot be written."""
    return PblError(
        "DB_UNAVAILABLE",
        key=path,
        found=f"the folder cannot be used: {error.strerror or error} ({error.filename or path})",
        expected="a folder of your own on a local disk with a few hundred MB free",
        next_step="free some space, or set PBL_HOME to another folder",
    )


def _write(path: Path, content: dict[str, Any], mode: int) -> None:
    try:
        write_json(path, content, mode)
    except OSError as error:
        raise folder_error(path.parent, error) from error
