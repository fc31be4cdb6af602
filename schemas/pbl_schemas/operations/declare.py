"""Declare all tables and queues at once, for accounts without the right to create them."""

from __future__ import annotations

from .. import connection, queues, store
from .._activate import activate


def declare_all() -> None:
    """Create the store, all tables with their method rows, and the queue of every computed table. Safe to repeat.

    Raises what `pbl_schemas.activate` raises, STORE_UNAVAILABLE.
    """
    activate()
    queues.declare()
    store.check_store(connection.store_backend(), create=True)
