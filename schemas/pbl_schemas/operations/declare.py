"""Declare all tables and queues at once, for accounts without the right to create them."""

from __future__ import annotations

import logging

from .. import connection, store
from .._activate import activate
from ..chain import computed_tables
from ..jobs import jobs_of


def declare_all() -> None:
    """Create the store, all tables with their method rows, and the queue of every computed table.

    DataJoint declares a queue when it is first used, which a worker's account may not. Safe to repeat.

    Raises what `pbl_schemas.activate` raises, STORE_UNAVAILABLE.
    """
    activate()
    log = logging.getLogger("datajoint")
    level = log.level
    log.setLevel(logging.ERROR)  # it warns of types that it chooses itself for the keys of a queue
    try:
        for table in computed_tables():
            jobs_of(table)  # declares it
    finally:
        log.setLevel(level)
    store.check_store(connection.store_backend(), create=True)
