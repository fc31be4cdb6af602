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

from pbl_pipeline import __version__
from pbl_pipeline.errors import PblError
from schemas import connection
from schemas._base import utc_now
from schemas._declare import declare_all
from schemas._differences import Difference, bind_all, differences, rebind
from schemas._methods import insert_all

_NAME = re.compile(r"(\d{4})_(\w+)")
Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Migration:
    """A module of migrations/. `statements(conn)` returns what is still to be done."""

    number: int
    name: str
    about: str
    repeats: bool
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
    """What a run did, or (dry run) would do. open: differences that no migration removes, in words."""

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
    import schemas.migrations as package

    found = []
    for module in pkgutil.iter_modules(package.__path__):
        match = _NAME.fullmatch(module.name)
        if match:
            loaded = importlib.import_module(f"{package.__name__}.{module.name}")
            about = (loaded.__doc__ or "").splitlines()[0]
            repeats = getattr(loaded, "REPEATS", False)
            found.append(Migration(int(match[1]), match[2], about, repeats, loaded.statements))
    found.sort(key=lambda m: m.number)
    if [m.number for m in found] != list(range(1, len(found) + 1)):
        raise ValueError(f"migrations must be numbered 1, 2, 3 ...: {[m.number for m in found]}")
    return found


def applied() -> list[Applied]:
    """The migrations that this database has seen; empty for one from before there were any."""
    conn = connection.connect()
    lab = connection.schema_name("lab")
    known = conn.query(
        "SELECT 1 FROM information_schema.tables WHERE table_schema = %s AND table_name = '~migrations'", args=(lab,)
    )
    if known.fetchone() is None:
        return []
    rows = conn.query(f"SELECT number, name, code_version, applied FROM `{lab}`.`~migrations` ORDER BY id")  # noqa: S608
    return [Applied(int(r[0]), r[1], r[2], str(r[3])) for r in rows.fetchall()]


def migrate(dry_run: bool = False, say: Say = lambda _: None) -> Outcome:
    """Bring the tables on the server to their declarations in this version of the code. Safe to repeat.

    Needs an account that may create and alter tables. Stop the workers before.

    Parameters
    ----------
    dry_run
        Change nothing, return what would be done.
    say
        Told in a sentence what is being done.

    Raises
    ------
    PblError
        DB_MIGRATION when differences remain that no migration removes (what could be done is done then), when the
        database has seen a newer version of the code, or when another process is at it; DB_REFUSED when the account
        may not alter tables.
    """
    numbers = {m.number for m in available()}
    newer = [a for a in applied() if a.number not in numbers]
    if newer:
        raise _error(
            f"migration {newer[-1].number:04d} ({newer[-1].name}) of pbl-pipeline {newer[-1].version} was applied",
            f"a database that pbl-pipeline {__version__} knows",
            f"use pbl-pipeline {newer[-1].version} or newer",
        )
    if dry_run:
        return _plan()
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT GET_LOCK(%s, 5)", (f"{connection.prefix()}_migrate",))
        if (cursor.fetchone() or (0,))[0] != 1:
            raise _error("another process is migrating this database", "one at a time", "wait until it has ended")
        created = [d.text() for d in bind_all(create=False)] + [d.text() for d in differences() if d.statement == ""]
        bind_all(create=True)
        steps = _apply(cursor, say)
    rebind({s.split("`.`")[0].split("`")[-1] for _, statements in steps for s in statements})
    insert_all()  # also where this process has done it before: a migration may have moved a method's name
    declare_all()
    left = [d.text() for d in differences()]
    if left:
        raise _error(
            f"{len(left)} differences that no migration removes: {'; '.join(left[:8])}",
            "tables as this version declares them",
            "they need a migration of their own: see docs/deployment.md, section Upgrade",
        )
    return Outcome(steps, created, [])


def _plan() -> Outcome:
    conn = connection.connect()
    missing = bind_all(create=False)
    now = differences()
    done = {a.number for a in applied()}
    steps = [(_title(m), m.statements(conn)) for m in available() if m.repeats or m.number not in done]
    planned = {s for _, statements in steps for s in statements}
    left = [d.text() for d in now if d.statement not in planned and d.statement != "" and not _covered(d, planned)]
    return Outcome(steps, [d.text() for d in missing + now if d.statement == ""], left)


def _covered(difference: Difference, planned: set[str]) -> bool:
    """Whether a migration makes the column, in whatever way."""
    start, column = f"ALTER TABLE {difference.table} ", f" COLUMN `{difference.column}` "
    return any(s.startswith(start) and column in s for s in planned)


def _apply(cursor: Any, say: Say) -> list[tuple[str, list[str]]]:
    conn, table = connection.connect(), f"`{connection.schema_name('lab')}`.`~migrations`"
    done = {a.number for a in applied()}
    steps = []
    for migration in available():
        if migration.number in done and not migration.repeats:
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
        if statements or migration.number not in done:
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
        (migration.number, migration.name, __version__, utc_now(), ";\n".join(statements)),
    )


def _title(migration: Migration) -> str:
    return f"{migration.number:04d} {migration.name}"


def _error(found: str, expected: str, next_step: str) -> PblError:
    return PblError("DB_MIGRATION", found=found, expected=expected, next_step=next_step)
