"""All rows of the database as statements, one a line, and back: what `pbl db backup` and `pbl db restore` rest on.

Written here and not with mysqldump because that needs the clients' package on every machine, and because it writes
single-precision numbers with six digits, which are other numbers afterwards. The file is plain SQL:
`zcat database.sql.gz | mariadb -h HOST -u USER -p` restores it without us.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pymysql
from pymysql.converters import escape_string
from pymysql.cursors import SSCursor

#: A statement of inserts is ended when it is longer than this (characters); the server takes far more.
STATEMENT = 1_000_000
_FETCH = 500
#: Marks a column whose values name files of the store, in the comment that DataJoint gives it.
STORED = re.compile(r"^:<(object|npy|blob|attach|hash)@")
#: Types whose values are bytes; everything else comes as text, exactly as the server prints it.
_BYTES = {"binary", "varbinary", "tinyblob", "blob", "mediumblob", "longblob", "bit"}
_FLOAT = "float"

HEADER = (
    "SET NAMES utf8mb4",
    "SET SESSION time_zone = '+00:00'",
    "SET SESSION foreign_key_checks = 0",
    "SET SESSION unique_checks = 0",
    "SET SESSION sql_mode = 'STRICT_ALL_TABLES,NO_AUTO_VALUE_ON_ZERO'",
)


def tables_of(server: pymysql.Connection[Any], prefix: str) -> list[tuple[str, str]]:
    """Schema and name of every table under a prefix, also DataJoint's own that begin with `~`, in order."""
    with server.cursor() as cursor:
        cursor.execute(
            "SELECT table_schema, table_name FROM information_schema.tables "
            "WHERE table_schema LIKE %s AND table_type = 'BASE TABLE' ORDER BY table_schema, table_name",
            (like(prefix),),
        )
        return [(row[0], row[1]) for row in cursor.fetchall()]


def schemas_of(server: pymysql.Connection[Any], prefix: str) -> list[str]:
    """The schemas under a prefix, also empty ones."""
    with server.cursor() as cursor:
        cursor.execute(
            "SELECT schema_name FROM information_schema.schemata WHERE schema_name LIKE %s ORDER BY schema_name",
            (like(prefix),),
        )
        return [row[0] for row in cursor.fetchall()]


def like(prefix: str) -> str:
    """The pattern of the schemas' names: in it an underscore stands for any character unless escaped."""
    return f"{prefix}_%".replace("_", r"\_")


def quote(name: str) -> str:
    """A name as a statement has it."""
    return "`" + name.replace("`", "``") + "`"


def columns_of(server: pymysql.Connection[Any], schema: str, table: str) -> list[tuple[str, str, str]]:
    """Name, type and comment of the columns of a table that hold values of their own (none that are generated)."""
    with server.cursor() as cursor:
        cursor.execute(
            "SELECT column_name, data_type, column_comment FROM information_schema.columns "
            "WHERE table_schema = %s AND table_name = %s AND extra NOT LIKE '%%GENERATED%%' ORDER BY ordinal_position",
            (schema, table),
        )
        return [(row[0], row[1].lower(), row[2]) for row in cursor.fetchall()]


def create_statement(server: pymysql.Connection[Any], schema: str, table: str) -> str:
    """The statement that makes the table, on one line (comments have their line breaks written out already)."""
    with server.cursor() as cursor:
        cursor.execute(f"SHOW CREATE TABLE {quote(schema)}.{quote(table)}")
        row = cursor.fetchone()
    assert row is not None
    text = row[1].decode() if isinstance(row[1], bytes) else row[1]
    return re.sub(r"\n\s*", " ", text)


def rows_of(
    server: pymysql.Connection[Any], schema: str, table: str, columns: Sequence[tuple[str, str, str]]
) -> Iterator[tuple]:
    """The rows of a table in the order of its primary key, read from the server as they are needed.

    The connection must have been opened with `conv={}`: values are text as the server prints it, or bytes.
    """
    # A single-precision number is printed with six digits; as double precision it is printed to the last one.
    chosen = ", ".join(f"{quote(c)} + 0e0" if kind == _FLOAT else quote(c) for c, kind, _ in columns)
    with server.cursor(SSCursor) as cursor:
        cursor.execute(f"SELECT {chosen} FROM {quote(schema)}.{quote(table)}")  # noqa: S608  names of the server's own
        while rows := cursor.fetchmany(_FETCH):
            yield from rows


def literal(value: Any, kind: str) -> str:
    """A value as a statement has it."""
    if value is None:
        return "NULL"
    if kind in _BYTES:
        raw = value if isinstance(value, bytes) else str(value).encode("latin1")
        return f"X'{raw.hex()}'"
    return f"'{escape_string(value.decode() if isinstance(value, bytes) else str(value))}'"


def inserts(schema: str, table: str, columns: Sequence[tuple[str, str, str]], rows: Iterator[tuple]) -> Iterator[str]:
    """Statements that insert the rows, each of about a megabyte at most."""
    names = ", ".join(quote(c) for c, _, _ in columns)
    head = f"INSERT INTO {quote(schema)}.{quote(table)} ({names}) VALUES "  # noqa: S608  values are escaped above
    kinds = [kind for _, kind, _ in columns]
    parts: list[str] = []
    size = 0
    for row in rows:
        text = "(" + ",".join(literal(v, k) for v, k in zip(row, kinds, strict=True)) + ")"
        if parts and size + len(text) > STATEMENT:
            yield head + ",".join(parts)
            parts, size = [], 0
        parts.append(text)
        size += len(text) + 1
    if parts:
        yield head + ",".join(parts)


def write_line(out: gzip.GzipFile, statement: str) -> None:
    """One statement on one line. Raises ValueError where it would not stay one."""
    if "\n" in statement or "\r" in statement:
        raise ValueError("a statement with a line break in it")
    out.write(statement.encode() + b";\n")


def read_lines(path: Path) -> Iterator[str]:
    """The statements of a file that `write_line` wrote."""
    with gzip.open(path, "rb") as lines:
        for line in lines:
            yield line.decode().rstrip("\n").removesuffix(";")
