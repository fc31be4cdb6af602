"""Which tables on the server differ from their definitions. Nothing is changed."""

from __future__ import annotations

import dataclasses
from typing import Any

from schemas import connection
from schemas.chain import tables
from schemas.datajoint_setup import dj


@dataclasses.dataclass(frozen=True)
class Difference:
    """What a table lacks or has beyond its definition. table: its full name on the server. known: False where the
    definition refers to what the server does not have, so that the rest is unknown."""

    table: str
    what: str
    known: bool = True

    def text(self) -> str:
        """As one line."""
        return f"{self.table}: {self.what}"


def differences() -> list[Difference]:
    """Differences of all tables that exist, by DataJoint's own comparison; the schemas must be bound."""
    conn = connection.connect()
    conn.dependencies.load()
    return [d for cls in tables().values() if cls.database and cls().is_declared for d in _compare(conn, cls)]


def _compare(conn: Any, cls: Any) -> list[Difference]:
    name, context = cls.full_table_name, cls.declaration_context
    try:
        # FreeTable reads the columns anew; the class keeps those from before a migration.
        on_server = dj.FreeTable(conn, name).describe(context=context)
        return [
            Difference(name, what) for what in dj.declare.alter(cls.definition, on_server, context, conn.adapter)[0]
        ]
    except NotImplementedError as error:  # DataJoint compares keys, foreign keys and indexes, but does not list them
        return [Difference(name, f"its key, foreign keys or indexes differ ({error})")]
    except dj.DataJointError as error:
        return [Difference(name, f"it cannot be compared ({error})", known=False)]
