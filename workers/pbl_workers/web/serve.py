"""Runs the page until Ctrl-C: on this machine, opened by links that it prints; elsewhere, by accounts and TLS."""

from __future__ import annotations

import contextlib
import dataclasses
import ipaddress
import logging
import signal
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import click
import uvicorn

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError, suppress_codes
from pbl_pipeline.names import check_label

from .access import Sessions, host_name
from .accounts import Accounts
from .app import create_app
from .connections import Connection
from .folder import ResultsFolder
from .site import Options

#: Addresses of this machine alone, and those that mean all of its addresses.
LOOPBACK, EVERYWHERE = ("127.0.0.1", "::1", "localhost"), ("0.0.0.0", "::", "")  # noqa: S104
#: Connections at a time, those of one address, and seconds that an idle one is kept.
_CONNECTIONS, _OF_ONE, _IDLE_S = 200, 100, 10


@dataclasses.dataclass(frozen=True)
class Where:
    """Address and names of the page.

    tls_cert, tls_key: files (PEM) of the server's certificate and key. behind_proxy: address, or network, of a proxy of
    one's own that ends TLS before the page; its statement of the client is trusted, and no one else is answered.
    hostnames: the names under which browsers reach the page. Port 0: a free one.
    """

    host: str = "127.0.0.1"
    port: int = 8484
    tls_cert: Path | None = None
    tls_key: Path | None = None
    behind_proxy: str = ""
    hostnames: tuple[str, ...] = ()

    @property
    def by_accounts(self) -> bool:
        """True if people sign in: unless the page serves this machine alone."""
        return self.host not in LOOPBACK or bool(self.behind_proxy) or self.tls_cert is not None

    @property
    def names(self) -> frozenset[str]:
        """The names in a Host header that are answered."""
        own = {*LOOPBACK} if self.host in LOOPBACK and not self.by_accounts else {self.host} - {*EVERYWHERE}
        return frozenset(map(host_name, (*self.hostnames, *own)))

    def addresses(self, port: int) -> list[str]:
        """Return the addresses under which browsers reach the page."""
        scheme = "https://" if self.tls_cert is not None else ""
        shown = (f"[{name}]" if ":" in name else name for name in sorted(self.names))
        return [f"{scheme}{name}:{port}" if scheme else name for name in shown]

    def tls(self) -> ssl.SSLContext | None:
        """Return the TLS context; None without TLS. Raises OSError."""
        if self.tls_cert is None:
            return None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(self.tls_cert, self.tls_key)
        return context

    def check(self) -> None:
        """Raise `PblError` where this cannot be served safely: WEB_TLS; USAGE for what does not belong together."""
        if (self.tls_cert is None) != (self.tls_key is None) or (self.tls_cert is not None and self.behind_proxy):
            found = "--tls-cert without --tls-key, or the other way round, or beside --behind-proxy"
            expected = "both files where the page itself speaks TLS, or --behind-proxy where a proxy does"
            raise PblError("USAGE", found, expected, "name both or neither")
        if self.host not in LOOPBACK and self.tls_cert is None and not self.behind_proxy:
            raise PblError(
                "WEB_TLS",
                found=f"--host {self.host} without TLS",
                expected="an encrypted way from the browser: passwords and videos of people go along it",
                next_step="add --tls-cert FILE --tls-key FILE; or --behind-proxy ADDRESS where a proxy of your own "
                "ends TLS; or leave --host out and open the page through a tunnel: "
                "ssh -L 8484:127.0.0.1:8484 THIS_MACHINE",
            )
        try:
            _ = ipaddress.ip_network(self.behind_proxy or "127.0.0.1", strict=False)
        except ValueError as error:
            found = f"--behind-proxy {self.behind_proxy}"
            expected = "an address such as 127.0.0.1, or a network such as 172.18.0.0/16"
            raise PblError("USAGE", found, expected, "write the address from which the proxy connects") from error
        if self.by_accounts and not self.names - {*LOOPBACK}:
            found = "no name under which browsers reach the page"
            expected = "--hostname NAME, as often as there are names; requests under another name are refused"
            raise PblError("USAGE", found, expected, "add --hostname, such as --hostname gait.example.org")
        if self.tls_cert is not None:
            try:
                self.tls()
            except (OSError, ssl.SSLError) as error:
                raise PblError(
                    "WEB_TLS",
                    found=f"{self.tls_cert}, {self.tls_key}: {error.strerror or type(error).__name__}",
                    expected="a certificate and its key as PEM, readable by this account, the key without a password",
                    next_step="check both files: openssl x509 -in CERT -noout -dates",
                ) from error


def serve(
    where: Where,
    name: str = "",
    roles: tuple[str, ...] = ("reviewer", "operator"),
    visit: int | None = None,
    accounts: Accounts | None = None,
    folder: ResultsFolder | None = None,
) -> None:
    """Serve the page. On this machine alone a one-time link is printed, after its use the next one; elsewhere people
    sign in with accounts (`pbl web account`).

    Raises what `Where.check` raises; USAGE for a name that cannot be printed, and for a folder that more
    than this machine may see; WEB_ACCOUNT if people sign in and there are no accounts; WEB_PORT if the port is
    taken.

    Parameters
    ----------
    where
        Address, TLS, names.
    name, roles
        Of who opens a link: what decisions carry, and what may be done (`access.RIGHTS`).
    visit
        session_id of the visit that the link opens; None: the first page.
    accounts
        None: those of this machine.
    folder
        Results of `pbl run` that are shown instead of the tables, on this machine alone.
    """
    where.check()
    check_label("--name", name, 64)
    if folder is not None and settings.audit_looks():
        found = "--folder with PBL_AUDIT_LOOKS"
        next_step = "`pbl ingest` the recordings; or unset PBL_AUDIT_LOOKS if it is not required"
        raise PblError("USAGE", found, "tables, in which each look at a recording leaves a row", next_step)
    if folder is not None and where.by_accounts:
        expected = "a folder of results on this machine alone: nothing says there who may see whom"
        next_step = "leave out --host, --tls-cert and --behind-proxy, or bring the recordings into tables"
        raise PblError("USAGE", "--folder for more than this machine", expected, next_step)
    if where.by_accounts:
        accounts = accounts or Accounts()
        if not accounts.all():
            expected = "at least one, with which a person can sign in"
            raise PblError("WEB_ACCOUNT", "no accounts", expected, "pbl web account add NAME --role reviewer")
    listening = _listen(where.host, where.port)
    port = listening.getsockname()[1]
    if where.by_accounts:
        options = Options(hosts=where.names, accounts=accounts, secure=True)
    else:
        roles = roles if folder is None else ("reader",)
        options = Options(hosts=where.names, name=name, roles=roles, folder=folder)
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    signal.signal(signal.SIGTERM, _end)  # uvicorn raises the signal again when it has ended, and the database ends too
    needed = database() if folder is None else contextlib.nullcontext()
    # An address is printed once it can be answered: not beside a refusal of the tables.
    with contextlib.closing(listening), needed, contextlib.suppress(KeyboardInterrupt):
        if where.by_accounts:
            app = create_app(options)
            shown = ", ".join(where.addresses(port))
            click.echo(f"Serving on {where.host}:{port} for {shown}, to those who have an account")
        else:
            app = _opened_by_links(where, port, options, visit)
        click.echo("The page ends with Ctrl-C.")
        threading.Thread(target=_warm, daemon=True).start()
        uvicorn.Server(config(app, where)).run(sockets=[listening])


def config(app: object, where: Where) -> uvicorn.Config:
    proxy = ipaddress.ip_network(where.behind_proxy, strict=False) if where.behind_proxy else None
    limits = {"per_address": None if proxy else _OF_ONE, "only_from": proxy, "tls": where.tls()}
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        http=type("Connection", (Connection,), limits),
        ws="none",
        # Addresses are not logged: the link's key would be among them.
        access_log=False,
        log_level="warning",
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_keep_alive=_IDLE_S,
        timeout_graceful_shutdown=5,
        h11_max_incomplete_event_size=16_384,
        # The client according to the proxy; these headers of anyone else are ignored.
        proxy_headers=bool(where.behind_proxy),
        forwarded_allow_ips=where.behind_proxy or None,
    )


def _opened_by_links(where: Where, port: int, options: Options, visit: int | None) -> object:
    shown = f"[{where.host}]" if ":" in where.host else where.host
    to = f"&to=/visits/{visit}" if visit is not None else ""
    link = f"open once: http://{shown}:{port}/enter?key="

    def used(key: str) -> None:
        click.echo(f"The link was used. For another browser:\n{link}{key}{to}")

    sessions = Sessions()
    app = create_app(dataclasses.replace(options, on_entry=used), sessions)
    click.echo(f"{link}{sessions.new_link(options.name, *options.roles)}{to}")
    return app


@contextlib.contextmanager
def database() -> Iterator[None]:
    """The embedded database, started where it is used and not running, and stopped again then. Tables of another
    version are refused; of a database that is away the pages say so, until it answers."""
    import pbl_schemas
    from pbl_schemas import connection
    from pbl_schemas.operations import catalog, embedded

    started = connection.external() is None and not embedded.status().running
    if started:
        embedded.start(say=click.echo)
    try:
        with suppress_codes("DB_NOT_RUNNING"):
            connection.connect()
            if not catalog.schemas():
                click.echo("Creating the tables and the method rows of this version")
            pbl_schemas.activate(methods=False)
        yield
    finally:
        if started:
            embedded.stop(say=click.echo)


def _end(*_: object) -> None:
    raise SystemExit(0)


def _warm() -> None:
    """Load what draws a body (JAX, MuJoCo: seconds) before the first recording is opened."""
    from pbl_pipeline import gait, render  # noqa: F401


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen()  # a browser that is quicker than the database waits, instead of being refused
    except OSError as error:
        listening.close()
        next_step = "pass another --port, or 0 for a free one; another `pbl web` may be running"
        raise PblError("WEB_PORT", f"{host}:{port}: {error.strerror or error}", "a free port", next_step) from error
    return listening
