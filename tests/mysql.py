"""A MySQL server in a folder of its own, for tests: Debian's, unpacked and run through its own loader and libraries.

No package of the machine is touched, nothing is installed: apt keeps lists, state and archives of its own. The server
is that of Debian unstable (no other release of Debian has MySQL), so it needs the C library of there as well.

    PBL_TEST_DATABASE=mysql pytest tests/integration/test_tables.py    # any test of tables, on it
    PBL_TEST_MYSQL_ROOT=/opt/mysql                                     # an unpacked server that is there already
"""

import contextlib
import dataclasses
import fcntl
import os
import pwd
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pymysql

from pbl_pipeline import settings
from pbl_schemas.operations.embedded.folder import free_port

#: Set to `mysql`: `tests.database.installation` starts this server in place of the embedded one.
CHOICE = "PBL_TEST_DATABASE"
#: Root of an unpacked server (`usr/sbin/mysqld` in it), for machines without apt or without a way out.
ROOT = "PBL_TEST_MYSQL_ROOT"
_PACKAGE = "mysql-server-core"
#: Only what signs the archive is the machine's. The archive's index may be older than its date of expiry on a mirror.
_APT = """
Dir "{folder}";
Dir::State::status "{folder}/status";
Dir::Etc "{folder}/etc";
Dir::Cache "{folder}/cache";
Dir::Etc::sourcelist "{folder}/etc/sources.list";
Acquire::Check-Valid-Until "false";
APT::Sandbox::User "";
APT::Install-Recommends "false";
"""
_SOURCE = "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian sid main\n"


class NoMySQL(Exception):
    """There is no MySQL to test with, and why."""


def chosen() -> bool:
    """Return True where the tests are to run on MySQL."""
    return os.environ.get(CHOICE) == "mysql"


def programs() -> Path:
    """Return the root of the unpacked server, fetched into the user's cache where it is absent (50 MB). Raises
    `NoMySQL` if it cannot be fetched."""
    if named := os.environ.get(ROOT):
        if not (Path(named) / "usr" / "sbin" / "mysqld").is_file():
            raise NoMySQL(f"{ROOT}={named} holds no usr/sbin/mysqld")
        return Path(named)
    place = settings.cache_dir() / "tests"
    place.mkdir(exist_ok=True)
    with (place / "mysql.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        root = place / "mysql"
        if not root.is_dir():
            _fetch(root)
    return root


def _fetch(root: Path) -> None:
    if settings.offline():
        raise NoMySQL("PBL_OFFLINE forbids to fetch it")
    if shutil.which("apt-get") is None or shutil.which("dpkg-deb") is None:
        raise NoMySQL(f"no apt to get it with; name an unpacked one in {ROOT}")
    work = root.with_name("mysql.tmp")
    shutil.rmtree(work, ignore_errors=True)
    for name in ("etc/apt.conf.d", "etc/preferences.d", "lists/partial", "cache/archives/partial", "debs"):
        (work / name).mkdir(parents=True)
    (work / "status").touch()  # nothing is installed there: the libraries are fetched as well
    (work / "etc" / "sources.list").write_text(_SOURCE)
    (work / "apt.conf").write_text(_APT.format(folder=work) + f'Dir::State::lists "{work}/lists";\n')
    environment = {**os.environ, "APT_CONFIG": str(work / "apt.conf"), "LC_ALL": "C"}

    def run(*command: str) -> str:
        done = subprocess.run(command, env=environment, cwd=work / "debs", capture_output=True, text=True, check=False)
        if done.returncode:
            raise NoMySQL(f"{' '.join(command[:3])}: {done.stderr.strip().splitlines()[-1:]}")
        return done.stdout

    run("apt-get", "-q", "update")
    planned = run("apt-get", "-s", "-q", "install", _PACKAGE)
    run("apt-get", "-q", "download", *sorted({p.split()[1] for p in planned.splitlines() if p.startswith("Inst ")}))
    for package in sorted((work / "debs").glob("*.deb")):
        run("dpkg-deb", "-x", str(package), str(work / "root"))
    (work / "root").rename(root)
    shutil.rmtree(work)


@dataclasses.dataclass
class Server:
    """A running server, on 127.0.0.1 only."""

    folder: Path
    port: int
    password: str
    process: subprocess.Popen[bytes] | None = None

    @property
    def environment(self) -> dict[str, str]:
        """The variables with which `pbl` uses it, as root."""
        return {"DJ_HOST": "127.0.0.1", "DJ_PORT": str(self.port), "DJ_USER": "root", "DJ_PASS": self.password}

    def start(self) -> None:
        """Start it where it does not run, also after `kill`, and wait until it answers."""
        if self.process is not None and self.process.poll() is None:
            return
        self.process = subprocess.Popen(_command(self.folder, self.port), stderr=subprocess.DEVNULL)
        until = time.monotonic() + 120.0
        while not self.answers():
            if self.process.poll() is not None or time.monotonic() > until:
                raise NoMySQL(f"mysqld does not start: {(self.folder / 'log').read_text()[-2000:]}")
            time.sleep(0.1)

    def answers(self) -> bool:
        """Return True when a login is taken."""
        try:
            self.connection().close()
        except pymysql.err.OperationalError:
            return False
        return True

    def connection(self) -> pymysql.Connection:
        """A connection as root."""
        return pymysql.connect(host="127.0.0.1", port=self.port, user="root", password=self.password, autocommit=True)

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    def kill(self) -> None:
        """Kill it at once, as a loss of power would."""
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """End it in order."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                self.kill()


def start(folder: Path) -> Server:
    """Make a database in a folder and start a server on it, with a random password of root. Raises `NoMySQL` if it
    cannot be fetched or does not start."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "data").mkdir()
    server = Server(folder, free_port(), secrets.token_hex(16))
    if os.geteuid() == 0:
        account = pwd.getpwnam("nobody")
        for path in (folder, folder / "data"):
            os.chown(path, account.pw_uid, account.pw_gid)
    # root comes from localhost by its name only, and without looking names up that is no 127.0.0.1.
    (folder / "init.sql").write_text(
        f"CREATE USER 'root'@'127.0.0.1' IDENTIFIED BY '{server.password}';\n"
        "GRANT ALL PRIVILEGES ON *.* TO 'root'@'127.0.0.1' WITH GRANT OPTION;\n"
        "DROP USER 'root'@'localhost';\n"
    )
    made = subprocess.run(
        [*_command(folder, server.port), "--initialize-insecure", f"--init-file={folder / 'init.sql'}"],
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if made.returncode:
        raise NoMySQL(f"mysqld --initialize: {(folder / 'log').read_text()[-2000:]}")
    (folder / "init.sql").unlink()
    server.start()
    return server


def _command(folder: Path, port: int) -> list[str]:
    root = programs()
    loader = next(p for p in sorted(root.glob("usr/lib*/**/ld-linux*.so*")))
    libraries = sorted({str(p.parent) for p in root.glob("usr/lib/*/*.so*")})
    return [
        *(str(loader), "--library-path", os.pathsep.join(libraries), str(root / "usr" / "sbin" / "mysqld")),
        "--no-defaults",
        *(["--user=nobody"] if os.geteuid() == 0 else []),
        f"--datadir={folder / 'data'}",
        f"--socket={folder / 's.sock'}",
        f"--pid-file={folder / 'pid'}",
        f"--log-error={folder / 'log'}",
        f"--port={port}",
        "--bind-address=127.0.0.1",
        "--mysqlx=OFF",
        "--skip-name-resolve",
        "--secure-file-priv=NULL",
        f"--lc-messages-dir={root / 'usr' / 'share' / 'mysql'}",
        f"--character-sets-dir={root / 'usr' / 'share' / 'mysql' / 'charsets'}",
        "--character-set-server=utf8mb4",
        "--collation-server=utf8mb4_bin",
        "--max-allowed-packet=1G",
        "--innodb-buffer-pool-size=256M",
        "--performance-schema=OFF",
    ]


@contextlib.contextmanager
def running(folder: Path) -> Iterator[Server]:
    """Start a server in a folder; end it after."""
    server = start(folder)
    try:
        yield server
    finally:
        server.stop()
