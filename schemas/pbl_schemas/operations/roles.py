"""Accounts on the database server with only the rights that their work needs.

| role | may |
|---|---|
| admin | everything in the schemas of this prefix: create and change tables, back up, restore; nothing elsewhere |
| worker | read, insert, change and delete rows; no table is created, changed or dropped |
| analyst | read |

Each may read the schemas that PBL_LINKING_MODULE links; the admin may refer to them.

The statements are the same on MySQL 8 and MariaDB. DataJoint creates tables on first use, so an admin declares all of
them before (`pbl db init`, `pbl db migrate`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import secrets
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pymysql
from pymysql.converters import escape_string

from pbl_pipeline.errors import PblError, os_errors_as
from pbl_schemas import connection, linking
from pbl_schemas.stages import STAGES

from . import embedded
from .catalog import pattern

#: Role -> rights in the schemas of the prefix.
ROLES: dict[str, tuple[str, ...]] = {
    "admin": ("ALL PRIVILEGES",),
    "worker": ("SELECT", "INSERT", "UPDATE", "DELETE"),
    "analyst": ("SELECT", "SHOW VIEW"),
}

#: Role -> rights in the schemas of a linked laboratory (`pbl_schemas.linking`).
_OF_LINKED = {"admin": "SELECT, REFERENCES", "worker": "SELECT", "analyst": "SELECT"}
#: Role -> end of the default account's name, after the prefix. The embedded server has its own `pbl_admin`.
_ENDINGS = {"admin": "owner", "worker": "worker", "analyst": "analyst"}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")
#: Names of custom schemas of a lab, after the prefix.
_SCHEMA = re.compile(r"[a-z][a-z0-9_]{0,39}")
_HOST = re.compile(r"[A-Za-z0-9%_.:/-]{1,255}")


@dataclasses.dataclass(frozen=True)
class Account:
    """An account of a role."""

    role: str
    user: str
    host: str  # where it may connect from, as in MySQL: `%` is anywhere
    schemas: tuple[str, ...] = ()  # custom schemas with all rights, without the prefix; `mylab` includes `mylab_...`

    def __post_init__(self) -> None:
        for name in self.schemas:
            ours = name.split("_")[0] in STAGES
            if ours or not _SCHEMA.fullmatch(name):
                raise PblError(
                    "USAGE",
                    key=name,
                    found="a schema of the package" if ours else "a name that no schema can have",
                    expected="at most 40 small letters, digits and '_', a letter first, no name of the package",
                    next_step=f"choose another name; it becomes {connection.prefix()}_NAME on the server",
                )
        if self.role not in ROLES or not _NAME.fullmatch(self.user) or not _HOST.fullmatch(self.host):
            raise PblError(
                "USAGE",
                key=f"{self.role} {self.user}@{self.host}",
                found="a role, name or host that cannot be",
                expected=f"one of {', '.join(ROLES)}; a name of at most 32 letters, digits, '_', '.', '-'; a host or %",
                next_step="correct it",
            )
        if self.user in (embedded.APP_USER, embedded.ADMIN_USER, "root", "mysql.sys", "mariadb.sys"):
            raise PblError(
                "USAGE",
                key=self.user,
                found="an account that the server or the embedded database needs as it is",
                expected="another name",
                next_step="choose another name with --user",
            )

    @property
    def name(self) -> str:
        """`'user'@'host'`, quoted for a statement."""
        return f"'{escape_string(self.user)}'@'{escape_string(self.host)}'"


def default_account(role: str, host: str) -> Account:
    """Return the account of a role by its usual name: `pbl_worker`, `pbl_analyst`, `pbl_owner` (admin)."""
    return Account(role, f"{connection.prefix()}_{_ENDINGS.get(role, role)}", host)


def statements(account: Account, password: str, require_tls: bool = False) -> list[str]:
    """Return the SQL that creates the account with this password and exactly the rights of its role. Safe to repeat."""
    literal = f"'{escape_string(password)}'"
    own = [p for name in account.schemas for p in (_own(name), _own(name) + r"\_%")]
    # A foreign key to a table of the package needs an additional right on MySQL.
    more = [f"GRANT REFERENCES ON `{pattern()}%`.* TO {account.name}"] if own else []
    return [
        f"CREATE USER IF NOT EXISTS {account.name} IDENTIFIED BY {literal}",
        f"ALTER USER {account.name} IDENTIFIED BY {literal} REQUIRE {'SSL' if require_tls else 'NONE'}",
        f"REVOKE ALL PRIVILEGES, GRANT OPTION FROM {account.name}",
        f"GRANT {', '.join(ROLES[account.role])} ON `{pattern()}%`.* TO {account.name}",
        *more,
        *(f"GRANT ALL PRIVILEGES ON `{p}`.* TO {account.name}" for p in own),
        *(f"GRANT {_OF_LINKED[account.role]} ON `{p}`.* TO {account.name}" for p in map(_escaped, linking.schemas())),
    ]


def _own(name: str) -> str:
    """Return the name of a custom schema for GRANT."""
    return pattern() + _escaped(name)


def _escaped(name: str) -> str:
    return name.replace("_", r"\_")


def password_file(folder: Path, account: Account) -> Path:
    """Return the file with the account's password; a missing one is made, with 192 random bits (mode 0600). Raises
    `PblError` FILE_UNWRITABLE, FILE_MISSING."""
    path = folder / account.user
    expected, next_step = "a folder for passwords that you may write to", "pass another folder with --secrets"
    with os_errors_as("FILE_UNWRITABLE", expected, next_step, path), contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as out:
            out.write(secrets.token_hex(24))
    return path


def read_password(path: Path) -> str:
    """Return the password in a file. Raises FILE_MISSING for none, or for one too short to be a secret."""
    try:
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        text = ""
    if len(text) < 12:
        raise PblError(
            "FILE_MISSING",
            key=path,
            found="no file that can be read, or fewer than 12 characters in it",
            expected="a password",
            next_step="delete the file to have a random one made, or write one into it",
        )
    return text


def apply(accounts: Sequence[tuple[Account, str]], require_tls: bool = False) -> None:
    """Create the accounts or bring them to these passwords and the rights of their roles. Raises `PblError` DB_REFUSED
    when the login (DJ_USER) may not manage accounts; what `connection.connect` raises."""
    _run([s for account, password in accounts for s in statements(account, password, require_tls)])


def drop(account: Account) -> None:
    """Remove an account; its connections end when they next ask for something. Safe to repeat."""
    _run([f"DROP USER IF EXISTS {account.name}"])


def _run(commands: Sequence[str]) -> None:
    with closing(_server_admin()) as server, server.cursor() as cursor:
        for command in commands:
            try:
                cursor.execute(command)
            except pymysql.err.Error as error:
                # The statement is not repeated: it may hold a password.
                raise PblError(
                    "DB_REFUSED",
                    key=command.split("'@'")[0].split(" IDENTIFIED")[0] + "'",
                    found=str(error.args[-1]),
                    expected="a login that may create accounts and grant rights",
                    next_step="run it with DJ_USER=root (or another such account) and its password",
                ) from None


def _server_admin() -> pymysql.Connection[Any]:
    """Return a connection that may manage accounts: the embedded server's administrator, or the login of DJ_USER."""
    if connection.external() is None:
        connection.connect()
        return embedded.admin(embedded.Folder.default())
    return connection.plain_connection()
