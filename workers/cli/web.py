"""`pbl web`: the review page."""

from __future__ import annotations

import getpass

import click


@click.command(epilog="Example: pbl web --visit 3")
@click.option("--port", type=click.IntRange(0, 65535), default=8484, show_default=True, help="0: a free one.")
@click.option("--host", default="127.0.0.1", show_default=True, help="An address of this machine.")
@click.option("--visit", type=click.IntRange(min=1), metavar="NUMBER", help="Open this visit (`pbl list visits`).")
@click.option("--name", metavar="WHO", help="Whose name decisions carry (default: your account's).")
@click.option(
    "--role", "roles", type=click.Choice(["reader", "reviewer", "operator"]), multiple=True,
    default=("reviewer", "operator"), show_default=True,
    help="What may be done: look; also decide and enter; see queues and try errors again. Can be repeated.",
)  # fmt: skip
def web(port: int, host: str, visit: int | None, name: str | None, roles: tuple[str, ...]) -> None:
    """Find visits, look at recordings with the fitted body, and decide, in a browser on this machine.

    Prints a link that opens one browser, once; docs/web.md describes the page and how it is protected. An embedded
    database that is not running is started, and stopped at the end.
    """
    from workers.web import serve

    serve(host, port, (name or getpass.getuser())[:64], roles, visit)
