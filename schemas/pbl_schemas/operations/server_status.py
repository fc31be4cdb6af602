"""Status of the database server, for `pbl db status` and the review page."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_schemas import connection, store

from . import embedded


def database_status() -> dict[str, Any]:
    """Return the kind of the server (external or embedded), whether it runs, and its details."""
    if (address := connection.external()) is not None:
        version = connection.connect().query("SELECT VERSION()").fetchone()[0]
        return {"kind": "external", "running": True, "address": address, "version": version}
    return {"kind": "embedded", **dataclasses.asdict(embedded.status()), "store": store.describe()}
