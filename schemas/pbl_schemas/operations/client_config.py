"""Configuration files by which plain `import datajoint` connects to this database (`pbl db config`)."""

from __future__ import annotations

import contextlib
import getpass
import re
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError, os_errors_as
from pbl_schemas import connection
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.operations import embedded
from pbl_schemas.operations.folders import private_folder, write_json, write_text
from pbl_schemas.tables_version import refuse_other_version

#: Names that DataJoint looks for, in the working directory and above it.
CONFIG, SECRETS = "datajoint.json", ".secrets"
#: Statement without which `A.aggr(B)` of plain DataJoint fails on MariaDB; its configuration cannot hold it.
AGGREGATE = """dj.conn().query("SET SESSION sql_mode = REPLACE(@@SESSION.sql_mode, 'ONLY_FULL_GROUP_BY', '')")"""
#: Attributes of a store that are secret.
_SECRET = ("access_key", "secret_key", "account_key", "connection_string", "token", "password")
_EXPECTED = f"a folder for {CONFIG} and {SECRETS}/"


def write_config(folder: Path, overwrite: bool = False) -> list[Path]:
    """Write `datajoint.json` (server, stores, nothing secret) and `.secrets/` (login, keys of stores; mode 0600).

    Python in that folder, or below it, then connects with plain `import datajoint` as this process does. `safemode`
    stays on: DataJoint asks before it deletes or drops.

    Raises `PblError` FILE_UNWRITABLE: it exists already, or cannot be written; DB_MIGRATION for tables of another
    version; what `connection.connect` raises.

    `folder`: made if it is missing. `overwrite`: replace the files of an earlier call; without it they are left.
    """
    connection.connect()
    refuse_other_version()
    config, here = dj.config, folder / CONFIG
    if not overwrite and (here.exists() or (folder / SECRETS).exists()):
        next_step = "pass --overwrite to replace it and .secrets/, or another --out"
        raise PblError("FILE_UNWRITABLE", "it is there already", _EXPECTED, next_step, here)
    stores, secrets = _without_secrets(dict(config.stores))
    secrets |= {"database.user": config["database.user"], "database.password": config["database.password"]}
    database = {name: config[f"database.{name}"] for name in ("host", "port", "use_tls", "reconnect")}
    content = {
        **{f"database.{name}": value for name, value in database.items() if value is not None},
        "safemode": True,
        "stores": stores,
    }
    with os_errors_as("FILE_UNWRITABLE", _EXPECTED, "pass another place with --out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        kept = private_folder(folder / SECRETS)
        for name, value in {".gitignore": "*\n", **secrets}.items():
            write_text(kept / name, value)  # other files in this folder stay
        write_json(here, content, 0o644)
    return [here, *(kept / name for name in secrets)]


def own_schemas() -> str:
    """Allow the user of the embedded server schemas that begin with the user's name; return, in words, which custom
    schemas the account of `write_config` may create."""
    user = ours = connection.prefix()
    if connection.external():
        grant = f"pbl db roles --role analyst --user {dj.config['database.user']} --schema NAME"
        return f"A custom schema, {ours}_NAME, is granted by the administrator: {grant}"
    with contextlib.suppress(KeyError, OSError):  # an account without a name
        name = re.sub("[^a-z0-9]", "_", getpass.getuser().lower())[:30]
        user = name if name[:1].isalpha() else user
    embedded.allow_prefix(user)
    return (
        f"Your own schemas begin with {user}_ or {ours}_, such as dj.Schema('{user}_mylab'). "
        f"`pbl db backup` saves those with {ours}_, and `pbl forget` removes a person from them."
    )


def is_mariadb() -> bool:
    """Return True for MariaDB, on which plain DataJoint needs a repair (`pbl_schemas.datajoint_setup`)."""
    return "MariaDB" in str(connection.connect().query("SELECT VERSION()").fetchone()[0])


def _without_secrets(stores: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the stores without their secrets, and the secrets by the name of the file that DataJoint reads."""
    plain, secrets = {}, {}
    for name, spec in stores.items():
        if isinstance(spec, dict):
            secrets |= {f"stores.{name}.{k}": str(v) for k, v in spec.items() if k in _SECRET}
            spec = {k: v for k, v in spec.items() if k not in _SECRET}
        plain[name] = spec
    return plain, secrets
