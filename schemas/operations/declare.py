"""Everything declared at once: what an account without the right to create tables relies on."""

from __future__ import annotations

import logging

from .. import connection, store
from .._activate import activate
from ..chain import computed_tables
from ..jobs import jobs_of


def declare_all() -> None:
    """Create the store, all tables with their method rows, and the queue of every computed table.

    DataJoint declares a queue when it is first used, which a worker's account may not. Safe to repeat.

    Raises what `schemas.activate` raises, STORE_UNAVAILABLE.
    """
    activate()
    log = logging.getLogger("datajoint")
    level = log.level
    log.setLevel(logging.ERROR)  # it warns of the types that it takes itself for the keys of a queue
    try:
        for table in computed_tables():
            jobs_of(table)  # declares it
    finally:
        log.setLevel(level)
    store.check_store(connection.store_backend(), create=True)
