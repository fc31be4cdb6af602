"""First set-up of the data folder: system tables and accounts, before the server ever listens."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from pbl_pipeline.errors import PblError

from .account import Account
from .binaries import Binaries
from .folder import ADMIN_USER, APP_USER, Credentials, Folder, indent
from .port import HOST, free_port
from .process import LOG_SIZE

SETUP_TIMEOUT_S = 300.0
#: An empty database takes 290 MB, nearly all of it the log that is laid out in advance.
NEEDED_MB = 500

#: The installation leaves up to four root accounts without a password (localhost, the machine's name, 127.0.0.1, ::1).
#: All go: the only administrator has a random password. mariadb.sys owns system views and is locked, PUBLIC is a role.
DROP_EVERY_ACCOUNT = (
    "BEGIN NOT ATOMIC FOR a IN (SELECT User, Host FROM mysql.global_priv WHERE User NOT IN ('mariadb.sys', 'PUBLIC')) "
    "DO EXECUTE IMMEDIATE CONCAT('DROP USER ', QUOTE(a.User), '@', QUOTE(a.Host)); END FOR; END;"
)


def initialise(folder: Folder, binaries: Binaries, account: Account) -> None:
    """Fill `folder.data` and write the credentials, which mark the set-up as complete.

    Raises `PblError` DB_UNAVAILABLE when there is too little space, or with what the program that failed said.
    """
    free_mb = shutil.disk_usage(folder.path).free // 2**20
    if free_mb < NEEDED_MB:
        raise PblError(
            "DB_UNAVAILABLE",
            key=folder.path,
            found=f"{free_mb} MB are free on this disk",
            expected=f"at least {NEEDED_MB} MB for an empty database",
            next_step="free some space, or set PBL_HOME to a folder on another local disk",
        )
    # The remains of an interrupted first start are not a database: nothing was ever stored in it.
    shutil.rmtree(folder.data, ignore_errors=True)
    folder.create(account)
    where = [f"--datadir={folder.data}", f"--basedir={binaries.basedir}", f"--tmpdir={folder.tmp}", LOG_SIZE]
    # "--force": a machine whose own name does not resolve (a bare container) does not matter; the accounts that
    # carry the name are dropped below.
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


def grant(prefix: str) -> str:
    r"""The statement that lets the application do everything in the schemas `<prefix>_...`, and nothing elsewhere.

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
    # The installer ends with a page of general advice; the lines that say why stand before it.
    lines = [line for line in said.splitlines() if "ERROR" in line] or said.splitlines()
    raise PblError(
        "DB_UNAVAILABLE",
        key=folder.path,
        found=f"{Path(command[0]).name} failed (code {code}):\n" + indent("\n".join(lines[-8:])),
        expected="an empty database",
        next_step="free some space if the disk is full, see that the folder is on a local disk, then: pbl db start",
    )
