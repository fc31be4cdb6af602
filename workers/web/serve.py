"""Runs the page until Ctrl-C, and prints the links that open it."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Iterator, Sequence

import click
import uvicorn

from pbl_pipeline.errors import PblError

from .access import Sessions
from .app import Options, create_app

#: Addresses of this machine alone.
LOOPBACK = ("127.0.0.1", "::1", "localhost")
#: Connections at a time, and seconds that an idle one is kept.
_CONNECTIONS, _IDLE_S = 200, 10


def serve(host: str, port: int, name: str, roles: Sequence[str], visit: int | None = None) -> None:
    """Serve the page at an address of this machine and print a one-time link; after its use, the next one.

    Parameters
    ----------
    host, port
        Where. Port 0: a free one.
    name, roles
        What decisions carry, and what may be done (`access.RIGHTS`).
    visit
        session_id of the visit that the link opens; None: the list.

    Raises
    ------
    PblError
        USAGE for an address that other machines reach; WEB_PORT where the port is taken.
    """
    if host not in LOOPBACK:
        raise PblError(
            "USAGE",
            found=f"--host {host}",
            expected=f"an address of this machine alone ({', '.join(LOOPBACK)}): there are no accounts yet",
            next_step="leave --host out and open the page through a tunnel: ssh -L 8484:127.0.0.1:8484 THIS_MACHINE",
        )
    listening = _listen(host, port)
    port = listening.getsockname()[1]
    shown = f"[{host}]" if ":" in host else host
    to = f"&to=/visits/{visit}" if visit is not None else ""

    def say(key: str) -> None:
        click.echo(f"open once: http://{shown}:{port}/enter?key={key}{to}")

    def used(key: str) -> None:
        click.echo("The link was used. For another browser:")
        say(key)

    sessions = Sessions()
    app = create_app(Options(name=name, roles=tuple(roles), on_entry=used), sessions)
    say(sessions.new_link(name, *roles))
    click.echo("The page ends with Ctrl-C.")
    # Addresses are not logged: the link's key would be among them.
    config = uvicorn.Config(
        app,
        access_log=False,
        log_level="warning",
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_keep_alive=_IDLE_S,
        timeout_graceful_shutdown=5,
        h11_max_incomplete_event_size=16_384,
    )
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    threading.Thread(target=_warm, daemon=True).start()
    with database(), contextlib.closing(listening), contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])


@contextlib.contextmanager
def database() -> Iterator[None]:
    """The embedded database, started where it is used and not running, and stopped again then."""
    from schemas import connection, embedded

    started = connection.external() is None and not embedded.status().running
    if started:
        embedded.start(say=click.echo)
    try:
        yield
    finally:
        if started:
            embedded.stop(say=click.echo)


def _warm() -> None:
    """Load what draws a body (JAX, MuJoCo: seconds) before the first recording is opened."""
    from pbl_pipeline import gait, render  # noqa: F401


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise PblError(
            "WEB_PORT",
            found=f"{host}:{port}: {error.strerror or error}",
            expected="a port that nobody listens on",
            next_step="pass another --port, or 0 for a free one; another `pbl web` may be running",
        ) from error
    return listening
