"""`pbl db`: the embedded database."""

from __future__ import annotations

import json
import os
from collections import Counter
from typing import Any

import click

from ._db_config import config
from ._db_migrate import migrate
from ._db_roles import roles
from .db_backup import backup, restore

# Each command imports what it needs: `pbl db --help` should not wait for the table engine.


@click.group()
def db() -> None:
    """The database: a private server in the folder PBL_HOME, not a system service.

    With DJ_HOST, DJ_PORT, DJ_USER and DJ_PASS set, that server is used and nothing is started here.

    Example: pbl db init && pbl db status
    """


for command in (backup, config, restore, migrate, roles):
    db.add_command(command)


@db.command()
def start() -> None:
    """Start the database; get the server and create the folder first where they are missing.

    Safe to repeat. The server goes on running until `pbl db stop`, or until the machine is switched off.

    Example: pbl db start
    """
    if _uses_external():
        return
    from schemas.operations import embedded

    embedded.start(click.echo)


@db.command()
def stop() -> None:
    """Stop the embedded database in good order. Safe to repeat.

    Example: pbl db stop
    """
    from schemas.operations import embedded

    embedded.stop(click.echo)


@db.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of a table.")
def status(as_json: bool) -> None:
    """Show whether the database answers, where it is and how large it is. Exit code 1 when it does not.

    Example: pbl db status --json
    """
    from schemas.operations import embedded
    from schemas.operations.server_status import database_status

    known = database_status()
    _print(known, as_json)
    if not known["running"]:
        found = "there is no database yet" if not known["initialised"] else "it is not running"
        if known["pid"] is not None:
            found = f"process {known['pid']} runs but does not answer: see run/server.log in the folder"
        raise embedded.not_running(embedded.Folder.default(), found)


@db.command()
def init() -> None:
    """Start the database and create all tables. Safe to repeat: what exists is kept.

    Example: pbl db init
    """
    from schemas import store
    from schemas.operations import catalog
    from schemas.operations.declare import declare_all

    if not _uses_external():
        from schemas.operations import embedded

        embedded.start(click.echo)
    click.echo("Creating the tables as far as they are missing, and the method rows of this version")
    declare_all()
    # Names that begin with ~ are DataJoint's own bookkeeping.
    tables = Counter(schema for schema, table in catalog.tables() if not table.startswith("~"))
    for schema, count in tables.items():
        click.echo(f"  {schema:<24} {count:>3} table{'' if count == 1 else 's'}")
    click.echo(f"Arrays are kept in {store.describe()}")
    click.echo("Next: pbl ingest VIDEO --subject CODE, or pbl demo")


def _uses_external() -> bool:
    if not os.environ.get("DJ_HOST"):
        return False
    from schemas import connection

    connection.connect()
    click.echo(f"DJ_HOST names the server {connection.external()}, which answers: nothing to start.")
    return True


def _print(values: dict[str, Any], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(values))
        return
    units = {"uptime_s": "s", "data_mb": "MB"}
    for name, value in values.items():
        if value is not None:
            shown = {True: "yes", False: "no"}.get(value, value) if isinstance(value, bool) else value
            click.echo(f"{name.removesuffix('_s').removesuffix('_mb'):<12} {shown} {units.get(name, '')}".rstrip())
