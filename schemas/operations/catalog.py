"""Schemas, tables and columns of this installation on the server, and their names in SQL."""

from __future__ import annotations

import dataclasses
import re

from schemas import connection

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


def tables() -> dict[tuple[str, str], list[Column]]:
    """Return (schema, table) -> columns for every table under the prefix, including DataJoint's own (`~...`)."""
    rows = connection.connect().query(
        "SELECT c.table_schema, c.table_name, c.column_name, c.data_type, c.column_comment "
        "FROM information_schema.columns c JOIN information_schema.tables t USING (table_schema, table_name) "
        "WHERE c.table_schema LIKE %s AND t.table_type = 'BASE TABLE' AND c.extra NOT LIKE '%%GENERATED%%' "
        "ORDER BY c.table_schema, c.table_name, c.ordinal_position",
        args=(f"{pattern()}%",),
    )
    found: dict[tuple[str, str], list[Column]] = {}
    for schema, table, name, kind, comment in rows.fetchall():
        found.setdefault((schema, table), []).append(Column(name, kind.lower(), comment))
    return found


def pattern() -> str:
    r"""Return the beginning of the schemas' names for LIKE and GRANT (`pbl\_`); an unescaped `_` is any character."""
    return f"{connection.prefix()}_".replace("_", r"\_")


def quote(*names: str) -> str:
    """Return a name quoted for SQL: `quote("pbl_lab", "subject")` returns `` `pbl_lab`.`subject` ``."""
    return ".".join("`" + name.replace("`", "``") + "`" for name in names)
