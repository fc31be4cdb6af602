"""Find the MariaDB server on this machine, or get its Debian packages.

By hand, because apt installs for root only; for other users its packages are downloaded and unpacked into a folder.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError

#: The bare programs: no service, no system user, nothing started.
PACKAGES = ("mariadb-server-core", "mariadb-client-core")
TIMEOUT_S = 600.0
#: Without it `apt-get update` ends with code 0 where no list could be fetched (apt 2.6; known since 2.1).
_STRICT = ("-o", "APT::Update::Error-Mode=any")

Say = Callable[[str], None]


def install(say: Say) -> str | None:
    """Install the packages on the system, as root or by sudo without a password; return why they are not, else None."""
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if prefix and _run([*prefix, "true"])[0] is not None:
        return "you are not root and sudo asks for a password"
    # A fresh machine may be installing its own updates: wait for the lock.
    command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-q", "-o", "DPkg::Lock::Timeout=120"]
    add = [*command, "install", "-y", "--no-install-recommends", *PACKAGES]
    say(f"  {' '.join([*prefix, 'apt-get install --no-install-recommends', *PACKAGES])}")
    failure, _ = _run(add)
    if failure is None:
        return None
    say(f"  the package list may be missing or old ({failure}): apt-get update")
    stale, failure = _run([*command, *_STRICT, "update"])[0], _run(add)[0]
    return failure and (stale or failure)


def unpack(folder: Path, say: Say) -> str | None:
    """Download the packages and the libraries that the system lacks, and unpack them without root.

    `folder` becomes the root of the unpacked tree (`folder/usr/sbin/mariadbd`). Returns why it failed, else None.
    """
    work = folder.with_name(folder.name + ".tmp")
    try:
        shutil.rmtree(work, ignore_errors=True)
        (work / "lists" / "partial").mkdir(parents=True)
        (work / "archives" / "partial").mkdir(parents=True)
        failure = _download(work, say)
        if failure is not None:
            say("  fetching a separate package list")
            lists = f"Dir::State::Lists={work / 'lists'}"
            own = ("-o", lists, "-o", f"Dir::Cache={work}", "-o", "Debug::NoLocking=1")
            stale, failure = _run(["apt-get", *own, *_STRICT, "-q", "update"])[0], _download(work, say, own)
            failure = failure and (stale or failure)
        for package in sorted((work / "archives").glob("*.deb")):
            failure = failure or _run(["dpkg", "-x", str(package), str(work / "root")])[0]
        if failure is None:
            shutil.rmtree(folder, ignore_errors=True)
            (work / "root").rename(folder)
        return failure
    except OSError as error:
        return f"{error.strerror or error} ({error.filename or work})"
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _download(work: Path, say: Say, options: Sequence[str] = ()) -> str | None:
    """Download the packages that an installation would add: ours and the libraries that the system lacks."""
    failure, said = _run(["apt-get", *options, "-s", "-q", "install", "--no-install-recommends", *PACKAGES])
    if failure is not None:
        return failure
    missing = [line.split()[1] for line in said.splitlines() if line.startswith("Inst ")]
    wanted = sorted({*missing, *PACKAGES})
    say(f"  downloading {', '.join(wanted)}")
    return _run(["apt-get", *options, "-q", "download", *wanted], work / "archives")[0]


def _run(command: Sequence[str], cwd: Path | None = None) -> tuple[str | None, str]:
    """Run a program to its end; return why it failed, None on success, and its output."""
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"},  # the output is read here
            cwd=cwd,
            timeout=TIMEOUT_S,
            check=False,
        )
    except FileNotFoundError:
        return f"{command[0]} is not installed", ""
    except subprocess.TimeoutExpired:
        return f"{command[0]} took more than {TIMEOUT_S:.0f} s", ""
    if done.returncode == 0:
        return None, done.stdout
    # The reason: apt's first error (E: ...), else the last line. A list that is a web page is "not signed" first.
    lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    errors = sorted((line for line in lines if line.startswith("E: ")), key=lambda e: "Failed to fetch" not in e)
    return next(iter([*errors, *lines[-1:]]), f"{command[0]} ended with code {done.returncode}"), done.stdout


#: Further folders of the server (Debian, Fedora, Homebrew).
PLACES = ("/usr/sbin", "/usr/local/sbin", "/usr/libexec", "/opt/homebrew/bin", "/usr/local/bin")

_ABSENT = "there is no MariaDB server on this machine"


def silent(_: str) -> None:
    """Print nothing: the default of every `say`."""


@dataclass(frozen=True)
class Binaries:
    """The programs of one MariaDB installation and the environment they need."""

    server: Path
    install_db: Path
    basedir: Path
    env: dict[str, str] = field(default_factory=dict)

    def environment(self) -> dict[str, str]:
        """Return the environment of a child without the caller's variables, which may hold passwords."""
        kept = {name: os.environ[name] for name in ("LANG", "TZ") if name in os.environ}
        # UMASK is a variable of MariaDB: its files are readable by its account only.
        return {"PATH": f"{os.defpath}:/usr/sbin:/sbin", "UMASK": "0600", "UMASK_DIR": "0700", **kept, **self.env}


def find_server() -> Binaries | None:
    """Return the MariaDB server of this machine, or the one in `settings.home_dir()/server`; None without either."""
    ours = _unpack_folder()
    for place in (*os.environ.get("PATH", os.defpath).split(os.pathsep), *PLACES, ours / "usr" / "sbin"):
        server = Path(place) / "mariadbd"
        basedir = server.parent.parent
        for script in (basedir / "bin" / "mariadb-install-db", basedir / "scripts" / "mariadb-install-db"):
            if os.access(server, os.X_OK) and os.access(script, os.X_OK):
                libraries = sorted(
                    {str(p.parent) for p in ours.glob("**/lib/**/*.so*")} if basedir == ours / "usr" else ()
                )
                env = {"LD_LIBRARY_PATH": os.pathsep.join(libraries)} if libraries else {}
                return Binaries(server, script, basedir, env)
    return None


def check_obtainable() -> None:
    """Check that the server can be started or fetched; nothing is made or fetched. Raises `PblError` DB_UNAVAILABLE
    with the reason and alternatives."""
    if not hasattr(os, "geteuid"):
        raise _unavailable("the embedded database needs the accounts and file locks of Linux or macOS", install=False)
    if find_server() is not None:
        return
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        raise _unavailable(f"{_ABSENT}, and no apt to get it with")
    if settings.offline():
        raise _unavailable(f"{_ABSENT}, and PBL_OFFLINE forbids to fetch it")


def get_server(say: Say = silent) -> Binaries:
    """Return the server of this machine, fetched with apt if it is absent. Raises `PblError` DB_UNAVAILABLE with the
    reason and the remedy."""
    found = find_server()
    if found:
        return found
    check_obtainable()
    say("The tables need a database server and this machine has none: getting MariaDB (8 MB, no service is started).")
    failure = install(say)
    if failure is not None:
        say(f"  not as a system package ({failure}); unpacking it into {_unpack_folder()} instead")
        failure = unpack(_unpack_folder(), say)
    found = find_server()
    if found is None:
        raise _unavailable(f"{_ABSENT}; getting it with apt failed: {failure or 'the package holds no mariadbd'}")
    return found


def _unpack_folder() -> Path:
    return settings.home_dir() / "server"


def _unavailable(found: str, install: bool = True) -> PblError:
    own = (
        "install MariaDB, which is then found and started here (Debian: apt-get install mariadb-server-core "
        "mariadb-client-core; Fedora: dnf install mariadb-server; macOS: brew install mariadb); or "
    )
    return PblError(
        "DB_UNAVAILABLE",
        found=found,
        expected="mariadbd on this machine, or apt with its archive in reach, or a server named in DJ_HOST",
        next_step=f"{own if install else ''}start a server with `docker compose up -d db`, or use one that your "
        "institution runs (MySQL 8, MariaDB), and set DJ_HOST, DJ_PORT, DJ_USER and DJ_PASS. `pbl run` and "
        "`pbl demo --no-database` need none",
    )
