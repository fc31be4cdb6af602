"""All rows of the database as SQL statements, one per line, and back: the basis of `pbl db backup` and `restore`.

By hand, and not with mariadb-dump or mysqldump, for three reasons. A backup counts the rows and collects the files that
they name in the transaction that reads them; a dump program has a snapshot of its own, so that a row deleted in between
would be restored without its file. mariadb-dump 10.11 writes the single-precision number 0.12345679 as 0.123457. And it
is in no package that the embedded server needs (Debian: mariadb-client, 63 MB with Perl), nor in the workers' image.

The file is plain SQL: `zcat database.sql.gz | mariadb -h HOST -u USER -p` restores it without this module.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pymysql
from pymysql.converters import escape_string
from pymysql.cursors import SSCursor

from .catalog import Column, quote

#: A statement of inserts is ended when it is longer than this (characters); the server takes far more.
STATEMENT = 1_000_000
_FETCH = 500
HEADER = (
    "SET NAMES utf8mb4",
    "SET SESSION time_zone = '+00:00'",
    "SET SESSION foreign_key_checks = 0",
    "SET SESSION unique_checks = 0",
    "SET SESSION sql_mode = 'STRICT_ALL_TABLES,NO_AUTO_VALUE_ON_ZERO'",
)


def create_statement(server: pymysql.Connection[Any], schema: str, table: str) -> str:
    """The statement that makes the table, on one line (comments have their line breaks written out already)."""
    with server.cursor() as cursor:
        cursor.execute(f"SHOW CREATE TABLE {quote(schema, table)}")
        row = cursor.fetchone()
    assert row is not None
    text = row[1].decode() if isinstance(row[1], bytes) else row[1]
    return re.sub(r"\n\s*", " ", text)


def rows_of(server: pymysql.Connection[Any], schema: str, table: str, columns: Sequence[Column]) -> Iterator[tuple]:
    """The rows of a table, read from the server as they are needed.

    The connection must have been opened with `conv={}`: values are text as the server prints it, or bytes.
    """
    # A single-precision number is printed with six digits; as double precision it is printed to the last one.
    chosen = ", ".join(f"{quote(c.name)} + 0e0" if c.type == "float" else quote(c.name) for c in columns)
    with server.cursor(SSCursor) as cursor:
        cursor.execute(f"SELECT {chosen} FROM {quote(schema, table)}")  # noqa: S608  names of the server's own
        while rows := cursor.fetchmany(_FETCH):
            yield from rows


def save_table(
    server: pymysql.Connection[Any], schema: str, table: str, columns: Sequence[Column], out: gzip.GzipFile
) -> tuple[int, set[str]]:
    """Write the statements that make a table and insert its rows; returns how many rows, and the files they name."""
    stored = [i for i, column in enumerate(columns) if column.names_files]
    write_line(out, f"USE {quote(schema)}")
    write_line(out, create_statement(server, schema, table))
    names = ", ".join(quote(c.name) for c in columns)
    head = f"INSERT INTO {quote(schema, table)} ({names}) VALUES "  # noqa: S608  values are escaped
    n, size, files = 0, 0, set()
    parts: list[str] = []
    for row in rows_of(server, schema, table, columns):
        n += 1
        files.update(json.loads(row[i])["path"] for i in stored if row[i] is not None)
        parts.append("(" + ",".join(map(literal, row)) + ")")
        size += len(parts[-1])
        if size > STATEMENT:
            write_line(out, head + ",".join(parts))
            parts, size = [], 0
    if parts:
        write_line(out, head + ",".join(parts))
    return n, files


def literal(value: str | bytes | None) -> str:
    """A value as a statement has it."""
    if value is None:
        return "NULL"
    return f"X'{value.hex()}'" if isinstance(value, bytes) else f"'{escape_string(value)}'"


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
