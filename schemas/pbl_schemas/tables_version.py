"""Check that the tables on the server are those of this version of the code: at every start, before anything reads or
writes them.

The table `~migrations` in the schema `lab` has a row for each numbered migration (`pbl_schemas.migrations`) that the
tables have been through. New tables are made as this version defines them, so they get all of its rows when they are
created.
"""

from __future__ import annotations

import dataclasses
import pkgutil
import re
from collections.abc import Callable, Collection
from pathlib import Path

import pymysql

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError

from . import connection
from .chain import tables
from .datajoint_setup import MissingTableError
from .operations import catalog

#: A line of a definition that makes a column of the table's own: its name.
_OWN = re.compile(r"^\s*([a-z]\w*)\s*[:=]", re.MULTILINE)
#: Where the migrations lie.
FOLDERS = [str(Path(__file__).with_name("migrations"))]
_NAME = re.compile(r"(\d{4})_(\w+)")
#: Name of the table that records migrations, in the schema `lab`.
_RECORD = "~migrations"
#: The server's number of "unknown database".
_NO_SCHEMA = 1049


@dataclasses.dataclass(frozen=True)
class Applied:
    """A row of the table `~migrations`."""

    number: int
    name: str
    version: str
    when: str

    @property
    def title(self) -> str:
        """Number and name, as of the module."""
        return title(self.number, self.name)


def title(number: int, name: str) -> str:
    """Number and name of a migration: `0001 what_it_does`."""
    return f"{number:04d} {name}"


def numbered() -> list[tuple[int, str]]:
    """Return number and name of every migration of this version, in the order of their numbers. Raises ValueError for a
    number that is missing or used twice, a mistake in the code."""
    names = (_NAME.fullmatch(module.name) for module in pkgutil.iter_modules(FOLDERS))
    found = sorted((int(match[1]), match[2]) for match in names if match)
    if [number for number, _ in found] != list(range(1, len(found) + 1)):
        raise ValueError(f"migrations must be numbered 1, 2, 3 ...: {[number for number, _ in found]}")
    return found


def applied() -> list[Applied]:
    """Return the migrations that this database has been through; empty for one from before they were recorded."""
    try:
        rows = connection.connect().query(f"SELECT number, name, code_version, applied FROM {_record()} ORDER BY id")  # noqa: S608
    except (MissingTableError, pymysql.err.OperationalError) as error:
        if isinstance(error, pymysql.err.OperationalError) and error.args[0] != _NO_SCHEMA:
            raise
        return []
    return [Applied(int(r[0]), r[1], r[2], str(r[3])) for r in rows.fetchall()]


def record(execute: Callable[..., object], number: int, name: str, statements: Collection[str] = ()) -> None:
    """Record a migration as applied. execute: of a cursor, or a connection's `query`."""
    execute(
        f"CREATE TABLE IF NOT EXISTS {_record()} (id INT NOT NULL AUTO_INCREMENT PRIMARY KEY, number INT NOT NULL, "
        "name VARCHAR(64) NOT NULL, code_version VARCHAR(32) NOT NULL, applied DATETIME NOT NULL, statements LONGTEXT)"
    )
    execute(
        f"INSERT INTO {_record()} (number, name, code_version, applied, statements)"  # noqa: S608
        " VALUES (%s, %s, %s, UTC_TIMESTAMP(), %s)",
        (number, name, code_version()[:32], ";\n".join(statements)),
    )


def check_version(new: bool = True) -> bool:
    """Refuse tables of another version; on a server without any, unless they are not to be created (`new`), record the
    migrations that new ones need not go through. Return True if there were none. Call it before the tables are
    declared. Raises `PblError` DB_MIGRATION."""
    if any(not table.startswith("~") for _, table in catalog.names()):
        refuse_other_version()
        return False
    if new and not applied():
        query = connection.connect().query
        query(f"CREATE DATABASE IF NOT EXISTS `{connection.schema_name('lab')}`")
        for number, name in numbered():
            record(lambda statement, values=(): query(statement, args=values), number, name)
    return True


def refuse_other_version() -> None:
    """Refuse tables of a newer version (a migration was applied that this one lacks) or an older one (a migration, or a
    column of a definition, is missing). A server without tables is neither. Raises `PblError` DB_MIGRATION."""
    have = refuse_newer()
    if not any(not table.startswith("~") for _, table in catalog.names()):
        return
    lacking = [f"migration {title(*m)}" for m in numbered() if m not in have] + missing_columns()
    if lacking:
        more = f" and {len(lacking) - 20} more" if len(lacking) > 20 else ""
        raise PblError(
            "DB_MIGRATION",
            found=f"tables of an older version, without {', '.join(lacking[:20])}{more}",
            expected=f"tables as pbl-pipeline {code_version()} defines them",
            next_step="`pbl db migrate --dry-run` says what will be done, `pbl db migrate` does it; of a database of a "
            "development version it says that no migration does: set PBL_HOME to a new folder, ingest the videos again",
        )


def refuse_newer() -> set[tuple[int, str]]:
    """Refuse tables that went through a migration which this version does not have, by number and name; return those
    that they went through. Raises `PblError` DB_MIGRATION."""
    ours, have = numbered(), applied()
    newer = [a for a in have if (a.number, a.name) not in ours]
    if newer:
        raise PblError(
            "DB_MIGRATION",
            found=f"migration {newer[-1].title} of pbl-pipeline {newer[-1].version} was applied",
            expected=f"tables that pbl-pipeline {code_version()} knows",
            next_step=f"use the pbl-pipeline that applied it ({newer[-1].version}) or a newer one; stop "
            "workers and pages of this version",
        )
    return {(a.number, a.name) for a in have}


def missing_columns() -> list[str]:
    """Columns that tables on the server lack, as `table.column`; tables that are missing do not count.

    One query, for every start: columns that a foreign key brings are left to `migrations.migrate`.
    """
    there = {names: {c.name for c in columns} for names, columns in catalog.tables().items()}
    out = []
    for path, cls in tables().items():
        names = connection.schema_name(path.split(".")[0]), cls.table_name
        out += [f"{names[1]}.{c}" for c in _OWN.findall(cls.definition) if c not in there.get(names, {c})]
    return out


def _record() -> str:
    return f"`{connection.schema_name('lab')}`.`{_RECORD}`"
