"""`pbl db`: the embedded database, its accounts, its configuration and migrations."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import click

from pbl_pipeline.errors import PblError

from .db_backup import backup, restore


@click.command()
@click.option(
    "--role",
    "names",
    type=click.Choice(["admin", "worker", "analyst"]),
    multiple=True,
    help="Only this role; may be given several times (default: all three).",
)
@click.option("--user", help="Name of the account, with one --role (default: pbl_worker, pbl_analyst, pbl_owner).")
@click.option(
    "--schema",
    "own",
    multiple=True,
    metavar="NAME",
    help="With --user: a custom schema (pbl_NAME on the server) for tables that refer to ours; may be repeated.",
)
@click.option("--from", "host", metavar="HOST", help="Where it may come from; % is anywhere (default: this machine).")
@click.option(
    "--secrets",
    "folder",
    type=click.Path(path_type=Path),
    default="secrets",
    show_default=True,
    metavar="DIR",
    help="Folder with one file per account that holds its password; made where missing.",
)
@click.option("--require-tls", is_flag=True, help="Refuse connections of these accounts that are not encrypted.")
@click.option("--drop", "remove", is_flag=True, help="Remove the account instead (with --role).")
@click.option("--dry-run", is_flag=True, help="Print the statements, without passwords, and do nothing.")
def roles(
    names: tuple[str, ...],
    user: str | None,
    own: tuple[str, ...],
    host: str | None,
    folder: Path,
    require_tls: bool,
    remove: bool,
    dry_run: bool,
) -> None:
    """Create the accounts admin, worker and analyst, or bring them back to exactly their rights. Safe to repeat.

    Needs a login that may create accounts: the embedded database has one, elsewhere DJ_USER=root. Passwords are read
    from files in DIR, and made there (random, readable by you only) where they are missing; none is printed.

    \b
    Example: pbl db roles
    Example: DJ_HOST=db DJ_USER=root DJ_PASS_FILE=secrets/mysql_root pbl db roles --from %
    Example: pbl db roles --role analyst --user maria --from %
    Example: pbl db roles --role analyst --user maria --from % --schema mylab
    """
    from pbl_schemas import connection
    from pbl_schemas.operations import roles as lib

    if (user or remove) and len(names) != 1:
        raise PblError(
            "USAGE",
            found=f"--user or --drop with {len(names) or 'no'} roles",
            expected="one --role",
            next_step="name the role of that account",
        )
    if own and not user:
        raise PblError(
            "USAGE",
            found="--schema without --user",
            expected="the account that may use it",
            next_step="add --role analyst --user NAME",
        )
    where = host or ("localhost" if connection.external() else "127.0.0.1")
    chosen = names or tuple(lib.ROLES)
    accounts = [lib.Account(r, user, where, own) if user else lib.default_account(r, where) for r in chosen]
    if remove:
        lib.drop(accounts[0])
        click.echo(f"{accounts[0].user} from {where} is removed; its password file, if any, stays")
        return
    if dry_run:
        for account in accounts:
            for line in lib.statements(account, "********", require_tls):
                click.echo(f"{line};")
        return
    files = [lib.password_file(folder, account) for account in accounts]
    lib.apply([(a, lib.read_password(f)) for a, f in zip(accounts, files, strict=True)], require_tls)
    for account, file in zip(accounts, files, strict=True):
        rights = ", ".join(lib.ROLES[account.role]).lower()
        also = "".join(f", all on {connection.prefix()}_{name}" for name in account.schemas)
        click.echo(f"{account.role:<8} {account.user} from {where}: {rights} on {connection.prefix()}_*{also}; {file}")


@click.command()
@click.option("--dry-run", is_flag=True, help="Print what would be done, change nothing. Exit code 1: more is needed.")
@click.option("--force", is_flag=True, help="Go on beside running workers of another version.")
def migrate(dry_run: bool, force: bool) -> None:
    """Bring the tables on the server to their definitions in this version: create what is missing, apply numbered
    migrations, then compare. Safe to repeat.

    Rows stay as they are. Make a backup first, and use an account that may alter tables. Running workers of another
    version are named, and refused without --force.

    \b
    Example: pbl db migrate --dry-run
    Example: pbl db backup /backup/before && pbl db migrate
    """
    from pbl_schemas import migrations
    from pbl_schemas.reading.comparison import changed_defaults

    known = migrations.applied()
    click.echo(f"{len(known)} migrations applied so far" + (f", last {known[-1].when} UTC" if known else ""))
    for line in migrations.workers_of_other_versions():
        click.echo(f"  still running: {line}")
    outcome = migrations.migrate(dry_run, click.echo, force)
    for line in (*outcome.created, *(outcome.touched if dry_run else ())):  # else they were said before it was done
        click.echo(f"  {line}")
    for title, statements in outcome.steps:
        click.echo(f"{title}: {len(statements)} statements")
        for statement in statements if dry_run else ():
            click.echo(f"  {statement};")
    for line in outcome.open:
        click.echo(f"  needs its own migration: {line}")
    if outcome.open:
        raise click.exceptions.Exit(1)
    for line in changed_defaults():
        click.echo(line)
    done = not outcome.created and not any(s for _, s in outcome.steps)
    click.echo("The tables are as this version defines them." if done or not dry_run else "Nothing was changed.")


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("."),
    show_default=True,
    help="Folder of the notebooks or programs; programs in folders below find the files as well.",
)
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier call (the port may have changed).")
def config(out: Path, overwrite: bool) -> None:
    """Write datajoint.json and .secrets/ of the database in use, so that plain `import datajoint` connects to it.

    The login is the one of this call: DJ_USER's, or the embedded database's. .secrets/ is readable for you alone and
    keeps itself out of git. DataJoint continues asking before it deletes (safemode). Prints which custom schemas the
    account may create; on the embedded database this call allows those that begin with your user name.

    Example: pbl db config --out notebooks
    """
    from pbl_schemas.operations.client_config import AGGREGATE, is_mariadb, own_schemas, write_config

    for path in write_config(out, overwrite):
        click.echo(path)
    if is_mariadb():
        click.echo(
            "The server is MariaDB, where A.aggr(B) of plain DataJoint fails (error 1055). After each connect:\n"
            f"{AGGREGATE}"
        )
    click.echo(own_schemas())


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

    Safe to repeat. The server continues running until `pbl db stop`, or until the machine is switched off.

    Example: pbl db start
    """
    if _uses_external():
        return
    from pbl_schemas.operations import embedded

    embedded.start(click.echo)


@db.command()
def stop() -> None:
    """Stop the embedded database in good order. Safe to repeat.

    Example: pbl db stop
    """
    from pbl_schemas.operations import embedded

    embedded.stop(click.echo)


@db.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of a table.")
def status(as_json: bool) -> None:
    """Show whether the database answers, where it is and how large it is. Exit code 1 when it does not.

    Example: pbl db status --json
    """
    from pbl_schemas.operations import embedded
    from pbl_schemas.operations.server_status import database_status

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
    from pbl_schemas import store
    from pbl_schemas.operations import catalog
    from pbl_schemas.operations.declare import declare_all

    if not _uses_external():
        from pbl_schemas.operations import embedded

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
    from pbl_schemas import connection

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
