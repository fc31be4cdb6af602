"""`pbl web`: the review page, and the accounts of those who sign in to it."""

from __future__ import annotations

import getpass
from pathlib import Path

import click

_FILE = click.Path(path_type=Path, dir_okay=False)
_ROLE = click.Choice(["reader", "reviewer", "operator"])


@click.group(invoke_without_command=True, epilog="Example: pbl web --visit 3")
@click.option("--port", type=click.IntRange(0, 65535), default=8484, show_default=True, help="0: a free one.")
@click.option("--host", metavar="ADDRESS", help="Address to listen on (default: 127.0.0.1, all with --tls).")
@click.option("--visit", type=click.IntRange(min=1), metavar="NUMBER", help="Open this visit (`pbl list visits`).")
@click.option(
    "--folder", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
    help="Show what `pbl run` wrote into this folder, or into folders in it, without a database.",
)  # fmt: skip
@click.option(
    "--videos", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
    help="With --folder: where the recordings are (default: beside their results).",
)  # fmt: skip
@click.option("--name", metavar="WHO", help="Whose name decisions carry (default: your account's).")
@click.option(
    "--role", "roles", type=_ROLE, multiple=True, default=("reviewer", "operator"), show_default=True,
    help="What may be done: look; also decide and enter; see queues and try errors again. Can be repeated.",
)  # fmt: skip
@click.option(
    "--tls", is_flag=True,
    help="Serve phones and other machines of this network by a certificate of the laboratory's own authority, made "
    "once, which they are told to trust (docs/capture.md).",
)  # fmt: skip
@click.option("--tls-cert", type=_FILE, metavar="FILE", help="Certificate (PEM), to serve more than this machine.")
@click.option("--tls-key", type=_FILE, metavar="FILE", help="Its key (PEM).")
@click.option(
    "--behind-proxy", default="", metavar="ADDRESS",
    help="Address or network of a proxy of your own that ends TLS; it has to pass the Host header on.",
)  # fmt: skip
@click.option(
    "--hostname", "hostnames", multiple=True, help="Name under which browsers reach the page. Can be repeated."
)
@click.pass_context
def web(
    context: click.Context,
    port: int,
    host: str | None,
    visit: int | None,
    folder: Path | None,
    videos: Path | None,
    name: str | None,
    roles: tuple[str, ...],
    tls: bool,
    tls_cert: Path | None,
    tls_key: Path | None,
    behind_proxy: str,
    hostnames: tuple[str, ...],
) -> None:
    """Find visits, look at recordings with the fitted body, compare, decide and enter, in a browser.

    On this machine alone it prints a link that opens one browser, once. With --host, TLS or a proxy people sign in with
    accounts (`pbl web account add`). docs/web.md describes the page and how it is protected. An embedded database that
    is not running is started, and stopped at the end.
    """
    if context.invoked_subcommand is not None:
        return
    from pbl_workers.web import ResultsFolder, Where, serve

    if videos is not None and folder is None:
        raise click.UsageError("--videos goes with --folder.")
    shown = None if folder is None else ResultsFolder(folder, videos)

    if tls:
        if tls_cert is not None or behind_proxy:
            raise click.UsageError("--tls makes a certificate: it goes without --tls-cert and --behind-proxy.")
        from pbl_workers.web import certificates

        host, hostnames = host or "0.0.0.0", hostnames or certificates.own_names()  # noqa: S104
        tls_cert, tls_key = certificates.server_certificate(sorted(Where(host, hostnames=hostnames).names))
        click.echo(f"Phones trust this page once they have {certificates.authority()}: docs/capture.md")
    where = Where(host or "127.0.0.1", port, tls_cert, tls_key, behind_proxy, hostnames)
    serve(where, name or getpass.getuser(), roles, visit, folder=shown)


@web.group(epilog="Example: pbl web account add R.Viewer --role reviewer")
def account() -> None:
    """People who may sign in to `pbl web` from other machines: a file of this machine (PBL_HOME/web/accounts.json)."""


@account.command(epilog="Example: pbl web account add R.Viewer --role reviewer --role operator")
@click.argument("name")
@click.option("--role", "roles", type=_ROLE, multiple=True, required=True, help="What may be done. Can be repeated.")
def add(name: str, roles: tuple[str, ...]) -> None:
    """Add an account; its password is asked for, twice. Decisions carry NAME."""
    from pbl_workers.web.accounts import Accounts

    Accounts().add(name, roles, _password())
    click.echo(f"{name} may sign in: {', '.join(roles)}")


@account.command(epilog="Example: pbl web account password R.Viewer")
@click.argument("name")
def password(name: str) -> None:
    """Give an account another password. Its sessions end."""
    from pbl_workers.web.accounts import Accounts

    Accounts().set_password(name, _password())
    click.echo(f"{name} has another password; sessions with the old one have ended")


@account.command(epilog="Example: pbl web account remove R.Viewer")
@click.argument("name")
def remove(name: str) -> None:
    """Remove an account. Its sessions end; its decisions stay."""
    from pbl_workers.web.accounts import Accounts

    Accounts().remove(name)
    click.echo(f"{name} may not sign in any more")


@account.command("list", epilog="Example: pbl web account list")
def list_() -> None:
    """Print names, roles, and when each was last changed."""
    from pbl_workers.web.accounts import Accounts

    for one in sorted(Accounts().all().values(), key=lambda a: a.name):
        click.echo(f"{one.name:<32} {', '.join(one.roles):<28} {one.changed[:19]} UTC")


def _password() -> str:
    """Ask for a password at the terminal: an argument would be visible among the processes."""
    return click.prompt("Password (15 characters or more)", hide_input=True, confirmation_prompt=True)
