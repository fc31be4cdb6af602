"""Plan and apply migrations."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import re
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pymysql

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from schemas import connection
from schemas.chain import tables
from schemas.datajoint_setup import dj, read_heading_again
from schemas.declare import declare_all
from schemas.operations import catalog
from schemas.rows import utc_now
from schemas.stages import STAGES, modules

from ._differences import differences

_NAME = re.compile(r"(\d{4})_(\w+)")
Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Migration:
    """A module of migrations/. `statements(conn)` returns what is still to be done."""

    number: int
    name: str
    statements: Callable[[Any], list[str]]


@dataclasses.dataclass(frozen=True)
class Applied:
    """A row of the table `~migrations`."""

    number: int
    name: str
    version: str
    when: str


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a run did, or (dry run) would do. open: differences that no migration removes, as text."""

    steps: list[tuple[str, list[str]]]
    created: list[str]
    open: list[str]


def available() -> list[Migration]:
    """All migrations, in the order of their numbers.

    Raises
    ------
    ValueError
        A number that is missing or used twice: a mistake in the code.
    """
    found, package = [], importlib.import_module("schemas.migrations")
    for module in pkgutil.iter_modules(package.__path__):
        match = _NAME.fullmatch(module.name)
        if match:
            loaded = importlib.import_module(f"{package.__name__}.{module.name}")
            found.append(Migration(int(match[1]), match[2], loaded.statements))
    found.sort(key=lambda m: m.number)
    if [m.number for m in found] != list(range(1, len(found) + 1)):
        raise ValueError(f"migrations must be numbered 1, 2, 3 ...: {[m.number for m in found]}")
    return found


def applied() -> list[Applied]:
    """The migrations that this database has seen; empty for one from before there were any."""
    conn = connection.connect()
    lab = connection.schema_name("lab")
    if (lab, "~migrations") not in catalog.tables():
        return []
    rows = conn.query(f"SELECT number, name, code_version, applied FROM `{lab}`.`~migrations` ORDER BY id")  # noqa: S608
    return [Applied(int(r[0]), r[1], r[2], str(r[3])) for r in rows.fetchall()]


def migrate(dry_run: bool = False, say: Say = lambda _: None) -> Outcome:
    """Bring the tables on the server to their definitions in this version of the code. Safe to repeat.

    Needs an account that may create and alter tables. Stop the workers before.

    Parameters
    ----------
    dry_run
        Change nothing, return what would be done.
    say
        Called with each statement before it is executed.

    Raises
    ------
    PblError
        DB_MIGRATION when differences remain that no migration removes (what could be done is done then), when the
        database has seen a newer version of the code, or when another process is migrating it; DB_REFUSED when the
        account may not alter tables.
    """
    _refuse_newer()
    if dry_run:
        return _plan()
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT GET_LOCK(%s, 5)", (f"{connection.prefix()}_migrate",))
        if (cursor.fetchone() or (0,))[0] != 1:
            raise _error("another process is migrating this database", "one at a time", "wait until it has ended")
        created = _bind(create=True)
        steps = _apply(cursor, say)
    if any(statements for _, statements in steps):
        _reread()
    left = [d.text() for d in differences()]
    if left:
        raise _error(
            f"{len(left)} differences that no migration removes: {'; '.join(left[:8])}",
            "tables as this version defines them",
            "they need a migration: see docs/deployment.md, section Upgrade",
        )
    declare_all()
    return Outcome(steps, created, [])


def _refuse_newer() -> None:
    numbers = {m.number for m in available()}
    newer = [a for a in applied() if a.number not in numbers]
    if newer:
        raise _error(
            f"migration {newer[-1].number:04d} ({newer[-1].name}) of pbl-pipeline {newer[-1].version} was applied",
            f"a database that pbl-pipeline {code_version()} knows",
            f"use the pbl-pipeline that applied it ({newer[-1].version}) or a newer one",
        )


def _bind(create: bool) -> list[str]:
    """Bind the classes to the server's tables; returns what is missing, and creates it if `create`."""
    there, absent = catalog.schemas(), []
    with dj.config.override(database__create_tables=False):
        for stage, module in zip(STAGES, modules(), strict=True):
            name = connection.schema_name(stage)
            if name not in there:
                absent.append(f"{name}: the schema is created")
                if not create:
                    continue
            connection.bind(stage, module.schema)
    for cls in tables().values():
        if cls.database and not cls().is_declared:
            absent.append(f"{cls.full_table_name}: the table is created")
            if create:
                cls().declare(cls.declaration_context)
    return absent


def _reread() -> None:
    """Read the tables' columns anew, and where they come from: DataJoint keeps both from before the migrations."""
    for module in modules():
        module.schema.rebuild_lineage()
    for cls in tables().values():
        read_heading_again(cls)


def _plan() -> Outcome:
    conn, created = connection.connect(), _bind(create=False)
    done = {a.number for a in applied()}
    steps = [(_title(m), m.statements(conn)) for m in available() if m.number not in done]
    planned = " ".join(s for _, statements in steps for s in statements)
    # What a planned statement changes, and what refers to a table that is still to be created, is compared afterwards.
    left = [d.text() for d in differences() if d.table not in planned and (d.known or not created)]
    return Outcome(steps, created, left)


def _apply(cursor: Any, say: Say) -> list[tuple[str, list[str]]]:
    conn, table = connection.connect(), f"`{connection.schema_name('lab')}`.`~migrations`"
    done = {a.number for a in applied()}
    steps = []
    for migration in available():
        if migration.number in done:
            continue
        statements = migration.statements(conn)
        for statement in statements:
            say(f"  {statement}")
            try:
                cursor.execute(statement)
            except pymysql.err.Error as error:
                raise PblError(
                    "DB_REFUSED",
                    key=f"{_title(migration)}: {statement[:200]}",
                    found=str(error.args[-1]),
                    expected="an account that may alter the tables, and tables that nobody uses at the moment",
                    next_step="stop the workers, use the account pbl_owner (pbl db roles), then repeat: it goes on",
                ) from error
        _record(cursor, table, migration, statements)
        steps.append((_title(migration), statements))
    return steps


def _record(cursor: Any, table: str, migration: Migration, statements: list[str]) -> None:
    cursor.execute(
        f"CREATE TABLE IF NOT EXISTS {table} (id INT NOT NULL AUTO_INCREMENT PRIMARY KEY, number INT NOT NULL, "
        "name VARCHAR(64) NOT NULL, code_version VARCHAR(32) NOT NULL, applied DATETIME NOT NULL, statements LONGTEXT)"
    )
    cursor.execute(
        f"INSERT INTO {table} (number, name, code_version, applied, statements) VALUES (%s, %s, %s, %s, %s)",  # noqa: S608
        (migration.number, migration.name, code_version(), utc_now(), ";\n".join(statements)),
    )


def _title(migration: Migration) -> str:
    return f"{migration.number:04d} {migration.name}"


def _error(found: str, expected: str, next_step: str) -> PblError:
    return PblError("DB_MIGRATION", found=found, expected=expected, next_step=next_step)
