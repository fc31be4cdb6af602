"""`pbl db roles`: accounts that have only the rights their work needs."""

from __future__ import annotations

from pathlib import Path

import click

from pbl_pipeline.errors import PblError


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
    from schemas import connection
    from schemas.operations import roles as lib

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
