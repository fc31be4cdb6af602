"""What the tables on the server lack against their declarations, and the statements that add it.

Only what cannot lose or falsify a row gets a statement: new tables, columns that may be null or have a default, types
that become wider, indexes, comments. Everything else is named and needs a migration of its own.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Any

from . import connection
from ._activate import STAGES, modules
from ._base import dj

#: Integer types, from narrow to wide.
_INTEGERS = ("tinyint", "smallint", "mediumint", "int", "bigint")


@dataclasses.dataclass(frozen=True)
class Difference:
    """One difference. `statement` is None where it needs a migration of its own, "" where DataJoint itself adds it.

    column: what it is about, "" for the table as a whole.
    """

    table: str
    column: str
    what: str
    statement: str | None

    def text(self) -> str:
        """In words."""
        return f"{self.table}{'.' if self.column else ''}{self.column}: {self.what}"


@dataclasses.dataclass(frozen=True)
class _Column:
    """A column of the server. type: as the server prints it."""

    type: str
    nullable: bool
    default: str | None
    comment: str


def bind_all(create: bool) -> list[Difference]:
    """Bind the table classes to the server's tables; with `create` what is missing is made, else returned."""
    conn = connection.connect()
    missing = []
    for stage, module in zip(STAGES, modules(), strict=True):
        if not create and not _schema_exists(conn, connection.schema_name(stage)):
            missing.append(Difference(connection.schema_name(stage), "", "the schema is created", ""))
            continue
        before = conn._config["database.create_tables"]
        conn._config["database.create_tables"] = create
        try:
            connection.bind(stage, module.schema)
            if create:  # bound already, perhaps, and without what was missing then
                for cls, context in module.schema.declare_list:
                    module.schema._decorate_master(cls, context)
        finally:
            conn._config["database.create_tables"] = before
    return missing


def rebind(schemas: set[str]) -> None:
    """Read the headings of these schemas' tables anew, and what DataJoint keeps of where their columns come from."""
    from .table_map import tables

    for cls in tables().values():
        if cls.database in schemas:
            cls._heading = type(cls._heading)(table_info=cls._heading.table_info)
            cls()._refresh_lineage(cls.declaration_context)


def differences() -> list[Difference]:
    """All differences of the tables that are bound (`bind_all` before), in the order of dependency."""
    from .table_map import tables

    conn = connection.connect()
    return [d for cls in tables().values() if cls.database for d in _of_table(conn, cls())]


def _of_table(conn: Any, table: Any) -> Iterator[Difference]:
    name = table.full_table_name
    columns = server_columns(conn, table.database, table.table_name)
    if not columns:
        yield Difference(name, "", "the table is created", "")
        return
    try:
        key, declared, foreign_keys, indexes = declaration(conn, table)
    except dj.DataJointError as error:
        yield Difference(name, "", f"it refers to what is still to be created ({error}): look again afterwards", "")
        return
    empty = not conn.query(f"SELECT 1 FROM {name} LIMIT 1").fetchone()  # noqa: S608  a name of DataJoint's own
    yield from _columns(conn, name, key, declared, columns, empty)
    yield from _constraints(conn, table, foreign_keys, indexes)


def declaration(conn: Any, table: Any) -> tuple[list[str], dict[str, str], list[str], list[str]]:
    """Key, columns (name: SQL), foreign keys and indexes (SQL) of a table as this version of the code declares them."""
    _, key, attributes, foreign_keys, indexes, *_ = dj.declare.prepare_declare(
        table.definition, table.declaration_context, conn.adapter, table_name=table.table_name, config=conn._config
    )
    return key, {sql.split("`")[1]: sql for sql in attributes}, foreign_keys, indexes


def _columns(
    conn: Any, name: str, key: list[str], declared: Mapping[str, str], found: Mapping[str, _Column], empty: bool
) -> Iterator[Difference]:
    for column, sql in declared.items():
        wanted = parse(sql)
        if column not in found:
            can = wanted.nullable or wanted.default is not None or empty
            if column in key:
                yield Difference(name, column, "the column is new and in the key", None)
            elif can:
                yield Difference(name, column, "the column is added", f"ALTER TABLE {name} ADD COLUMN {sql}")
            else:
                yield Difference(name, column, "the column is new, without a default, and there are rows", None)
            continue
        have = found[column]
        modify = f"ALTER TABLE {name} MODIFY COLUMN {sql}"
        if plain_type(wanted.type) != plain_type(have.type):
            if column not in key and wider(have.type, wanted.type):
                yield Difference(name, column, f"{have.type} becomes {wanted.type}", modify)
            else:
                yield Difference(name, column, f"{have.type} is declared as {wanted.type}", None)
        elif wanted.nullable and not have.nullable:
            yield Difference(name, column, "it may be null now", modify)
        elif have.nullable and not wanted.nullable:
            nulls = conn.query(f"SELECT 1 FROM {name} WHERE `{column}` IS NULL LIMIT 1").fetchone()  # noqa: S608
            what = "it may not be null any more" + (", and there are rows where it is" if nulls else "")
            yield Difference(name, column, what, None if nulls else modify)
        elif wanted.comment != have.comment and column not in key and have.comment:
            yield Difference(name, column, "the comment is changed", modify)
    for column in found:
        if column not in declared and not found[column].nullable and found[column].default is None:
            loosen = f"ALTER TABLE {name} MODIFY COLUMN `{column}` {found[column].type} NULL"
            what = "it is no longer declared: it may be null now, its values stay"
            yield Difference(name, column, what, None if column in key else loosen)


def _constraints(conn: Any, table: Any, foreign_keys: list[str], indexes: list[str]) -> Iterator[Difference]:
    name = table.full_table_name
    have = _foreign_keys(conn, table.database, table.table_name)
    for sql in foreign_keys:
        match = re.match(r"FOREIGN KEY \((.+?)\) REFERENCES (\S+?) \(", sql)
        assert match is not None
        columns = tuple(re.findall(r"`(\w+)`", match.group(1)))
        if (columns, match.group(2)) not in have:
            yield Difference(name, ",".join(columns), f"it refers to {match.group(2)}", f"ALTER TABLE {name} ADD {sql}")
    known = _indexes(conn, table.database, table.table_name)
    for sql in indexes:
        columns = tuple(re.findall(r"`(\w+)`", sql))
        unique = sql.lower().startswith("unique")
        if (columns, unique) not in known:
            what = f"a{' unique' if unique else 'n'} index is added"
            yield Difference(name, ",".join(columns), what, f"ALTER TABLE {name} ADD {sql}")


# ------------------------------------------------------------------------------------------------- what the server has
def server_columns(conn: Any, schema: str, table: str) -> dict[str, _Column]:
    """The columns of a table on the server, empty where it does not exist."""
    rows = conn.query(
        "SELECT column_name, column_type, is_nullable, column_default, column_comment FROM information_schema.columns "
        "WHERE table_schema = %s AND table_name = %s ORDER BY ordinal_position",
        args=(schema, table),
    ).fetchall()
    # MariaDB says the word NULL where there is no default.
    return {r[0]: _Column(_text(r[1]), r[2] == "YES", None if r[3] in (None, "NULL") else r[3], r[4]) for r in rows}


def _foreign_keys(conn: Any, schema: str, table: str) -> set[tuple[tuple[str, ...], str]]:
    rows = conn.query(
        "SELECT constraint_name, column_name, referenced_table_schema, referenced_table_name "
        "FROM information_schema.key_column_usage WHERE table_schema = %s AND table_name = %s "
        "AND referenced_table_name IS NOT NULL ORDER BY constraint_name, ordinal_position",
        args=(schema, table),
    ).fetchall()
    by_name: dict[str, tuple[tuple[str, ...], str]] = {}
    for constraint, column, to_schema, to_table in rows:
        columns, _ = by_name.get(constraint, ((), ""))
        by_name[constraint] = ((*columns, column), f"`{to_schema}`.`{to_table}`")
    return set(by_name.values())


def _indexes(conn: Any, schema: str, table: str) -> set[tuple[tuple[str, ...], bool]]:
    rows = conn.query(
        "SELECT index_name, column_name, non_unique FROM information_schema.statistics "
        "WHERE table_schema = %s AND table_name = %s ORDER BY index_name, seq_in_index",
        args=(schema, table),
    ).fetchall()
    by_name: dict[str, tuple[tuple[str, ...], bool]] = {}
    for index, column, non_unique in rows:
        columns, _ = by_name.get(index, ((), False))
        by_name[index] = ((*columns, column), not int(non_unique))
    return set(by_name.values())


def _schema_exists(conn: Any, schema: str) -> bool:
    found = conn.query("SELECT 1 FROM information_schema.schemata WHERE schema_name = %s", args=(schema,))
    return found.fetchone() is not None


# --------------------------------------------------------------------------------------------------------------- types
def parse(sql: str) -> _Column:
    """A column as DataJoint's declaration states it: `` `fps` float DEFAULT NULL COMMENT "..." ``."""
    match = re.match(
        r"`\w+`\s+(?P<type>\w+(?:\((?:[^()']|'(?:[^']|'')*')*\))?(?:\s+unsigned)?)(?P<rest>.*)$", sql, re.DOTALL
    )
    if match is None:
        raise ValueError(f"no column declaration: {sql}")
    rest, _, comment = match["rest"].partition(' COMMENT "')
    default = re.search(r"DEFAULT\s+(.+?)\s*$", rest)
    given = default.group(1).strip() if default else None
    nullable = "NOT NULL" not in rest.upper()
    return _Column(match["type"], nullable, None if given in (None, "NULL") else given, comment.removesuffix('"'))


def plain_type(text: str) -> str:
    """A type so that both spellings of it are equal: display widths of integers and spaces in lists do not count."""
    text = re.sub(r"\s*,\s*(?=')", ",", text.strip())
    head, bracket, rest = text.partition("(")
    head = head.lower()
    if head in _INTEGERS:
        return head + (" unsigned" if rest.lower().endswith("unsigned") else "")
    # MariaDB's json is longtext with a check.
    return {"json": "longtext"}.get(head, head) + bracket + rest


def wider(have: str, wanted: str) -> bool:
    """True when every value of the one type is a value of the other."""
    have, wanted = plain_type(have), plain_type(wanted)
    if have in _INTEGERS and wanted in _INTEGERS:
        return _INTEGERS.index(wanted) >= _INTEGERS.index(have)
    if (have, wanted) == ("float", "double"):
        return True
    kinds = have.split("(")[0], wanted.split("(")[0]
    if kinds == ("enum", "enum"):
        return set(_values(have)) <= set(_values(wanted))
    if kinds in (("varchar", "varchar"), ("char", "varchar"), ("char", "char"), ("datetime", "datetime")):
        return _length(have) <= _length(wanted)
    return kinds == ("varchar", "longtext")


def _values(text: str) -> list[str]:
    return re.findall(r"'((?:[^']|'')*)'", text)


def _length(text: str) -> int:
    match = re.search(r"\((\d+)\)", text)
    return int(match.group(1)) if match else 0


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
