"""Finding the MariaDB server on this machine, or getting it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError

from .apt import install, unpack

#: Where the server lies when it is not on PATH (Debian, Fedora, Homebrew).
PLACES = ("/usr/sbin", "/usr/local/sbin", "/usr/libexec", "/opt/homebrew/bin", "/usr/local/bin")

Say = Callable[[str], None]
_ABSENT = "there is no MariaDB server on this machine"


def silent(_: str) -> None:
    """The default of every `say`: prints nothing."""


@dataclass(frozen=True)
class Binaries:
    """The programs of one MariaDB installation and the environment they need."""

    server: Path
    install_db: Path
    basedir: Path
    env: dict[str, str] = field(default_factory=dict)

    def environment(self) -> dict[str, str]:
        """The whole environment of a child: small, for the caller's variables may hold passwords."""
        kept = {name: os.environ[name] for name in ("LANG", "TZ") if name in os.environ}
        # UMASK is MariaDB's own variable: the files it makes are for its account only.
        return {"PATH": f"{os.defpath}:/usr/sbin:/sbin", "UMASK": "0600", "UMASK_DIR": "0700", **kept, **self.env}


def find_server() -> Binaries | None:
    """The MariaDB server of this machine, or the one unpacked into `settings.home_dir()/server`; None when absent."""
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
    """Return where the server can be started or fetched; nothing is made or fetched.

    Raises `PblError` DB_UNAVAILABLE with the reason and the other ways to a database.
    """
    if not hasattr(os, "geteuid"):
        raise _unavailable("the embedded database needs the accounts and file locks of Linux or macOS", install=False)
    if find_server() is not None:
        return
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        raise _unavailable(f"{_ABSENT}, and no apt to get it with")
    if settings.offline():
        raise _unavailable(f"{_ABSENT}, and PBL_OFFLINE forbids to fetch it")


def get_server(say: Say = silent) -> Binaries:
    """The server of this machine, fetched with apt when it is absent.

    Raises `PblError` DB_UNAVAILABLE with the reason and the remedy.
    """
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
