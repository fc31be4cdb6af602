"""Connect, declare the tables in the order of dependency, insert the method rows."""

from __future__ import annotations

import os
from types import ModuleType

from pbl_pipeline.errors import PblError

from .stages import STAGES, modules


def activate(
    prefix: str | None = None,
    *,
    linking_module: ModuleType | str | None = None,
    create_schema: bool = True,
    create_tables: bool = True,
    start: bool = False,
    methods: bool = True,
) -> None:
    """Bind all tables to the database; safe to call again.

    Raises what `pbl_schemas.connection.connect` raises; DB_MIGRATION for tables of another version, older or
    newer; USAGE for a prefix or linking module that cannot be used; DB_NOT_FOUND without a schema; on a new database
    STORE_UNAVAILABLE.

    Parameters
    ----------
    prefix
        Beginning of the schemas' names, for this process and those that it starts (default: PBL_DB_PREFIX, or `pbl`).
    linking_module
        A module with the laboratory's own `Subject` and `Session`, or its name (default: PBL_LINKING_MODULE). It may
        have `subject_code(key)` and `session_label(key)`, which return our names of its rows.
    create_schema
        False: refuse a server without one of the schemas.
    create_tables
        False: create no table and insert nothing.
    start
        Start the embedded server when it is not running.
    methods
        Insert the method, body and norm rows of this version of the code (loads the numerical libraries, a few
        seconds). Commands that only look leave it out: False inserts them only where there are none.
    """
    from . import connection, linking, queues, store, tables_version
    from .methods import insert_if_none, insert_once
    from .operations import catalog, embedded

    if prefix is not None:
        _use(prefix)
    connection.connect(start=start)
    if connection.external() is None:
        embedded.allow_prefix(connection.prefix())  # the connection may be older than the choice of the prefix
    if not create_schema and (absent := {*map(connection.schema_name, STAGES)}.difference(catalog.schemas())):
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no schema {', '.join(sorted(absent))}",
            expected="the schemas of all tables, because none may be created",
            next_step="check the prefix, or leave out create_schema=False",
        )
    new = tables_version.check_version(create_tables)
    for stage, module in zip(STAGES, modules(), strict=True):
        connection.bind(stage, module.schema, create_tables)
    linking.link(linking_module, create_tables)
    if create_tables:
        insert_once() if methods else insert_if_none()
    if new and create_tables:  # as `pbl db init` leaves them, whatever came first
        queues.declare()
        store.check_store(connection.store_backend(), create=True)


def _use(prefix: str) -> None:
    from . import lab
    from .operations import embedded

    embedded.grant(prefix)  # refuses what cannot begin a name
    if lab.schema.database not in (None, f"{prefix}_lab"):
        raise PblError(
            "USAGE",
            found=f"prefix {prefix!r}, while the tables of {lab.schema.database} are bound",
            expected="one prefix in a process",
            next_step="use another process for it",
        )
    os.environ["PBL_DB_PREFIX"] = prefix
