"""The system account the server runs as: the user's own, or an unprivileged one when the user is root (never root)."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError

#: Accounts root drops to, in this order. `nobody` exists on every Debian; `mysql` only where its packages made it.
UNPRIVILEGED = ("mysql", "nobody")


@dataclass(frozen=True)
class Account:
    """A system account: its name, user and group number."""

    name: str
    uid: int
    gid: int

    def popen(self) -> dict[str, Any]:
        """Arguments of `subprocess` that run a child as this account; nothing when it is the caller's own."""
        if self.uid == os.geteuid():
            return {}
        return {"user": self.uid, "group": self.gid, "extra_groups": []}

    def own(self, path: Path) -> None:
        """Give `path` to this account (only root can, and only root has to)."""
        if self.uid != os.geteuid():
            os.chown(path, self.uid, self.gid)


def server_account(data: Path) -> Account:
    """The account for the server process: never root.

    Raises `PblError` DB_UNAVAILABLE when the caller is root and the system has no unprivileged account to drop to.

    Parameters
    ----------
    data
        The data folder. When root meets one that exists, its owner goes on running it, whoever that is.
    """
    import pwd  # here: Windows has none, and this module is imported there too

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
    """Make sure `account` can enter `folder`, by trying as that account (permission bits alone do not decide).

    Raises `PblError` DB_UNAVAILABLE naming the first folder on the way that is closed, and the remedy.
    """
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
    except KeyError:  # a container may run under a number that has no name
        return str(uid)
