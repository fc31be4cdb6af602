"""One configured DataJoint connection, to the server DJ_HOST names or else to the embedded one.

Importing a module of tables connects to nothing: `pbl_schemas.activate()` connects and binds the schemas. Until then
the classes exist and can be imported; using one raises DataJoint's "schema is not activated".
"""

from __future__ import annotations

import os
import socket
import warnings
from typing import Any

import pymysql

from pbl_pipeline.errors import PblError

from . import job_errors  # noqa: F401  codes what the driver raises, wherever that is
from .datajoint_setup import UTC, LostConnectionError, backend_of, datajoint, dj
from .datajoint_setup import DuplicateError as DuplicateError  # these four for the workers
from .datajoint_setup import IntegrityError as IntegrityError
from .datajoint_setup import inserting as inserting
from .operations import embedded
from .operations.embedded import APP_USER, HOST, Folder, not_running
from .operations.folders import secret
from .store import further_stores, store_spec

#: How long a server may take to answer before it counts as not running.
CONNECT_TIMEOUT_S = 4.0
#: Name of the store that holds the arrays. Write it out, `<npy@arrays>`: DataJoint 2.3.5 finds no default for `<npy@>`.
STORE = "arrays"

#: Parts of a target by which it is connected to.
_LOGIN = ("host", "port", "user", "password")
#: The process's connection, once there is one.
_current: datajoint.Connection | None = None


def connect(start: bool = False) -> datajoint.Connection:
    """Return the process's connection, made on first use and again when the server has moved.

    Raises `PblError` DB_NOT_RUNNING when nothing answers within a few seconds, DB_REFUSED when the login is refused,
    DB_UNAVAILABLE when `start` fails.

    `start`: start the embedded server if it is not running (never if DJ_HOST names a server). After `pbl demo` has
    stopped it, any connection does.
    """
    target = _target(start)
    configure(target)
    global _current
    current = _current
    if current is not None and _same(current, target) and _alive(current):
        return current
    _check_answers(target)
    try:
        if current is None:
            with warnings.catch_warnings():
                # MariaDB is supported here, by the repairs of `datajoint_setup`.
                warnings.filterwarnings("ignore", message="MariaDB is not officially supported")
                # Passed although they are configured: without them DataJoint ignores use_tls.
                login = {name: target[name] for name in ("host", "user", "password")}
                current = _current = dj.conn(**login, use_tls=target["use_tls"])
        else:
            # The server was restarted, perhaps on another port. The tables keep this object, so it is redirected.
            info = {name: target[name] for name in ("host", "port", "user")}
            tls = {"ssl": True if target["use_tls"] is None else target["use_tls"], "ssl_input": target["use_tls"]}
            current.conn_info.update(info, passwd=target["password"], **tls)
            current.connect()
            current.cancel_transaction()  # DataJoint does not notice that an open one was lost with the server
    except pymysql.err.OperationalError as error:
        raise _login_error(target, error) from error
    except RuntimeError as error:  # of the driver, which does not support the server's authentication
        raise _no_answer(target, str(error)) from error
    if target["embedded"]:
        embedded.allow_prefix(prefix())
    return current


def another() -> datajoint.Connection:
    """Return a separate connection to the same server, for a thread: DataJoint's serves one only."""
    target = _target(start=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="MariaDB is not officially supported")
        return datajoint.Connection(
            target["host"], target["user"], target["password"], port=target["port"], use_tls=target["use_tls"]
        )


def prefix() -> str:
    """Return the beginning of the schemas' names (PBL_DB_PREFIX, default `pbl`)."""
    return os.environ.get("PBL_DB_PREFIX") or "pbl"


def schema_name(stage: str) -> str:
    """Return the name of a stage's schema on the server: `lab` -> `pbl_lab`."""
    return f"{prefix()}_{stage}"


def bind(stage: str, schema: datajoint.Schema, create_tables: bool = True) -> None:
    """Create the missing schema and tables of a stage, and bind the classes to them.

    Call it in the order of dependency: a table can only refer to tables that are bound. `create_tables`: False creates
    none, True those that DataJoint's configuration allows.
    """
    server = connect()
    try:
        schema.activate(schema_name(stage), connection=server, create_tables=None if create_tables else False)
    except Exception:
        schema.database = None  # otherwise DataJoint would consider it bound
        raise


def external() -> str | None:
    """Return `host:port` of the server that DJ_HOST names; None for the embedded database."""
    if not os.environ.get("DJ_HOST"):
        return None
    target = _target(start=False)
    return f"{target['host']}:{target['port']}"


def configure(target: dict[str, Any] | None = None) -> None:
    """Set DataJoint's configuration: server, store, job bookkeeping. `connect()` calls it."""
    if target is not None:
        for name in _LOGIN:
            dj.config[f"database.{name}"] = target[name]
        dj.config["database.use_tls"] = None if target["use_tls"] is None else bool(target["use_tls"])
    dj.config["database.reconnect"] = True
    dj.config["loglevel"] = os.environ["DJ_LOG_LEVEL"]
    dj.config.stores.clear()
    dj.config.stores.update({"default": STORE, **further_stores(STORE), STORE: store_spec()})
    dj.config.jobs.auto_refresh = True
    dj.config.jobs.keep_completed = False  # a result row says that a job is done; queues stay as small as their work
    dj.config.jobs.add_job_metadata = False  # origin columns say duration, time and version
    dj.config.jobs.version_method = None  # "git" forks three times a make; the code version is a column of ours


def _target(start: bool) -> dict[str, Any]:
    """Return server and login: DJ_* if DJ_HOST is set, else those of the embedded server."""
    host = os.environ.get("DJ_HOST")
    if host:
        user, password = os.environ.get("DJ_USER"), secret("DJ_PASS")
        if not user or password is None:
            raise PblError(
                "DB_REFUSED",
                key=f"DJ_HOST={host}",
                found="DJ_HOST names a server, but DJ_USER or DJ_PASS is not set",
                expected="all three (the password in DJ_PASS, or in the file that DJ_PASS_FILE names)",
                next_step="set DJ_USER and DJ_PASS, or unset DJ_HOST to use the embedded database",
            )
        name, _, in_host = host.partition(":")
        if in_host and not in_host.isdecimal():
            raise PblError(
                "USAGE", found=f"DJ_HOST={host}", expected="HOST or HOST:PORT", next_step="correct the variable"
            )
        return {
            "host": name,
            "port": int(in_host or os.environ.get("DJ_PORT") or 3306),
            "user": user,
            "password": password,
            "use_tls": _tls(),
            "embedded": False,
        }
    folder = Folder.default()
    if start or embedded.starts_on_demand(folder):
        embedded.start()
    login = {"host": HOST, "user": APP_USER, "password": folder.credentials().app_password}
    return {**login, "port": int(folder.state().get("port") or 0), "use_tls": False, "embedded": True}


def _tls() -> bool | dict[str, Any] | None:
    """Return the encryption of the connection: None if the server supports it, False never, a dict for the driver
    always.

    DJ_TLS_CA names the file of the authority that signed the server's certificate: name and certificate are checked
    then. Without it DJ_USE_TLS=1 encrypts, but does not detect another server in between. A plain True is not used:
    DataJoint passes it on as "encrypt if possible", so that a server without TLS would be used unencrypted.
    """
    wanted, authority = os.environ.get("DJ_USE_TLS", "").lower(), os.environ.get("DJ_TLS_CA")
    if wanted and wanted not in ("1", "true", "yes"):
        return False
    if not authority:
        return {"verify_mode": "none"} if wanted else None
    if not os.access(authority, os.R_OK):
        raise PblError(
            "FILE_MISSING",
            key=f"DJ_TLS_CA={authority}",
            found="no such file, or it cannot be read",
            expected="the certificate (PEM) of the authority that signed the server's",
            next_step="correct the variable, or mount the file there",
        )
    return {"ca": authority, "check_hostname": True}


def plain_connection(**options: Any) -> pymysql.Connection[Any]:
    """Return a connection of the driver with the login of the tables, for statements that are not queries of a table.
    Raises what `connect` raises."""
    target = _target(start=False)
    _check_answers(target)
    tls: dict[str, Any] = {"ssl_disabled": True} if target["use_tls"] is False else {"ssl": target["use_tls"]}
    login = {name: target[name] for name in _LOGIN}
    try:
        return pymysql.connect(**login, **tls, charset="utf8mb4", autocommit=True, init_command=UTC, **options)
    except pymysql.err.OperationalError as error:
        raise _login_error(target, error) from error


def store_backend() -> Any:
    """Return DataJoint's access to the store of arrays. `connect()` or `configure()` must have been called."""
    return backend_of(STORE)


def store_root() -> str:
    """Return the folder of the store in which DataJoint files by schema, table and key."""
    return str(dj.config.get_store_spec(STORE)["schema_prefix"]).strip("/")


def _check_answers(target: dict[str, Any]) -> None:
    """Fail within seconds when nothing sends a greeting; the driver itself would wait three times ten."""
    try:
        with socket.create_connection((target["host"], target["port"]), timeout=CONNECT_TIMEOUT_S) as probe:
            probe.settimeout(CONNECT_TIMEOUT_S)
            if not probe.recv(4):
                raise _no_answer(target, "the connection is closed at once, without a greeting")
    except OSError as error:
        address = f"{target['host']}:{target['port']}"
        raise _no_answer(target, f"nothing answers at {address} ({error.strerror or error})") from error


def _login_error(target: dict[str, Any], error: pymysql.err.OperationalError) -> PblError:
    number, text = error.args[0], str(error.args[-1])
    # Access denied in its forms: to a schema, wrong password, host not allowed, plugin, account locked.
    if number not in (1044, 1045, 1130, 1251, 1698, 3118, 4151):
        return _no_answer(target, text)
    own = "these passwords are not this server's: pbl db stop, then pbl db start; else restore credentials.json"
    return PblError(
        "DB_REFUSED",
        key=f"{target['user']}@{target['host']}:{target['port']}",
        found=text,
        expected="a login the server accepts",
        next_step=own if target["embedded"] else "check DJ_USER and DJ_PASS, and that this user may come from here",
    )


def _no_answer(target: dict[str, Any], found: str) -> PblError:
    if target["embedded"]:
        return not_running(Folder.default(), found)
    return PblError(
        "DB_NOT_RUNNING",
        key=f"DJ_HOST={target['host']}, DJ_PORT={target['port']}",
        found=found,
        expected="a MySQL or MariaDB server",
        next_step="start that server, or unset DJ_HOST and run: pbl db start",
    )


def _alive(connection: datajoint.Connection) -> bool:
    # Not `connection.is_connected`: in DataJoint 2.3.5 it stays True after the server has gone.
    try:
        connection.query("SELECT 1", reconnect=False)
    except (LostConnectionError, pymysql.err.Error):
        return False
    return True


def _same(connection: datajoint.Connection, target: dict[str, Any]) -> bool:
    info = connection.conn_info
    return [info[name] for name in ("host", "port", "user", "passwd")] == [target[name] for name in _LOGIN]
