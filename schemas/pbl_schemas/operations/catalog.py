"""Schemas, tables and columns of this installation on the server, and their names in SQL."""

from __future__ import annotations

import dataclasses
import re
from contextlib import closing

from pbl_schemas import connection

#: The comment that DataJoint gives a column whose values name files of the store.
_STORED = re.compile(r":<(object|npy|blob|attach|hash)@")


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a table that is not computed from others by the server."""

    name: str
    type: str  # `information_schema.columns.data_type` in small letters
    comment: str

    @property
    def names_files(self) -> bool:
        """True if values are JSON whose `path` names a file or folder of the store."""
        return _STORED.match(self.comment) is not None


def schemas() -> list[str]:
    """Return the schemas under the prefix, including empty ones."""
    rows = connection.connect().query(
        "SELECT schema_name FROM information_schema.schemata WHERE schema_name LIKE %s ORDER BY schema_name",
        args=(f"{pattern()}%",),
    )
    return [str(row[0]) for row in rows.fetchall()]


def names() -> list[tuple[str, str]]:
    """Return (schema, table) of every table under the prefix, including DataJoint's own (`~...`)."""
    rows = connection.connect().query(
        "SELECT table_schema, table_name FROM information_schema.tables "
        "WHERE table_schema LIKE %s AND table_type = 'BASE TABLE' ORDER BY table_schema, table_name",
        args=(f"{pattern()}%",),
    )
    return [(str(schema), str(table)) for schema, table in rows.fetchall()]


def tables() -> dict[tuple[str, str], list[Column]]:
    """Return (schema, table) -> columns for every table under the prefix, including DataJoint's own (`~...`)."""
    found: dict[tuple[str, str], list[Column]] = {name: [] for name in names()}
    # Asked separately: joined with the query of the names it takes the server five times as long.
    rows = connection.connect().query(
        "SELECT table_schema, table_name, column_name, data_type, column_comment FROM information_schema.columns "
        "WHERE table_schema LIKE %s AND extra NOT LIKE '%%GENERATED%%' "
        "ORDER BY table_schema, table_name, ordinal_position",
        args=(f"{pattern()}%",),
    )
    for schema, table, name, kind, comment in rows.fetchall():
        if (schema, table) in found:  # neither a view nor made meanwhile
            found[schema, table].append(Column(name, kind.lower(), comment))
    return found


def analyse() -> None:
    """Have the server count the rows of all tables after many came at once: until it does so by itself, it plans its
    queries for tables as small as before."""
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("ANALYZE LOCAL TABLE " + ", ".join(quote(*name) for name in names()))


def pattern() -> str:
    r"""Return the beginning of the schemas' names for LIKE and GRANT (`pbl\_`); an unescaped `_` is any character."""
    return f"{connection.prefix()}_".replace("_", r"\_")


def quote(*names: str) -> str:
    """Return a name quoted for SQL: `quote("pbl_lab", "subject")` returns `` `pbl_lab`.`subject` ``."""
    return ".".join("`" + name.replace("`", "``") + "`" for name in names)
