"""Connect, declare the tables in the order of dependency, insert the method rows."""

from __future__ import annotations

from .stages import STAGES, modules

_methods_done: set[str] = set()


def activate(start: bool = False, methods: bool = True) -> None:
    """Bind all tables to the database; safe to call again.

    Raises what `pbl_schemas.connection.connect` raises; DB_MIGRATION for tables of another version, older or
    newer.

    `start`: start the embedded server when it is not running. `methods`: insert the method, body and norm rows of this
    version of the code (loads the numerical libraries, a few seconds). Commands that only look leave it out.
    """
    from . import connection, fit, plan, tables_version

    connection.connect(start=start)
    tables_version.check_version()
    for stage, module in zip(STAGES, modules(), strict=True):
        connection.bind(stage, module.schema)
    fit.SessionFit.plan = staticmethod(plan.plan_fit_sets)
    if connection.prefix() in _methods_done:
        return
    from .methods import add_instruments, insert_all

    if methods:
        insert_all()
        _methods_done.add(connection.prefix())
    else:
        add_instruments()
