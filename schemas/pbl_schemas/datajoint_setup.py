"""DataJoint with our configuration, its repairs for MariaDB, and every private name of it that we use.

Everything else in `schemas` and `workers` uses DataJoint's public face only. `tests/unit/test_datajoint_face.py` lists
the private names below and fails where a version of DataJoint has other ones.
"""

from __future__ import annotations

import json
import os
import warnings
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

from pbl_pipeline.errors import INTERRUPTS, PblError

# DataJoint reads its configuration while it is imported. Ours comes from `connection.configure` alone: a datajoint.json
# that happens to lie in the working directory must not point the tables at another server.
os.environ.setdefault("DJ_IGNORE_CONFIG_FILE", "true")
os.environ.setdefault("DJ_LOG_LEVEL", "WARNING")

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="No datajoint.json found")  # on purpose
    try:
        import datajoint
    except ValueError as error:  # it reads the DJ_ variables while it is imported
        raise PblError(
            "USAGE",
            found=str(error).split("For further information")[0].strip(),
            expected="values of the DJ_ variables as DataJoint knows them (DJ_PORT: a number)",
            next_step="correct the variable, or unset it",
        ) from error
import pymysql
from datajoint import table as datajoint_table
from datajoint.adapters import ADAPTERS, MySQLAdapter
from datajoint.codecs import decode_attribute
from datajoint.errors import AccessError, DuplicateError, IntegrityError, LostConnectionError, MissingTableError
from datajoint.hash_registry import get_store_backend
from datajoint.jobs import ERROR_MESSAGE_LENGTH
from datajoint.storage import StorageBackend, build_object_path
from pymysql.converters import escape_string

__all__ = [
    "ERROR_MESSAGE_LENGTH",
    "UTC",
    "AccessError",
    "DuplicateError",
    "IntegrityError",
    "LostConnectionError",
    "MissingTableError",
    "RightMissing",
    "backend_of",
    "build_object_path",
    "columns_read_once",
    "datajoint",
    "decode_attribute",
    "dj",
    "full_path",
    "inserting",
    "read_heading_again",
]

#: DataJoint without its types: its metaclass lends classes the operators of queries, which no type checker can see.
dj: Any = datajoint


# ------------------------------------------------------------------------------------------------------------ MariaDB
#: Statement that makes CURRENT_TIMESTAMP a time that never goes back in autumn.
UTC = "SET SESSION time_zone = '+00:00'"


#: The server's numbers of errors that a repetition mends: row changed since it was read, lock wait, deadlock.
REPEAT = (1020, 1205, 1213)
#: Those that say that the server cannot be reached, and that it is full or read-only.
AWAY = (0, 1040, 1053, 1927, 2002, 2003, 2006, 2013, 2055, 4031)
FULL = (3, 1021, 1026, 1030, 1114, 1290, 1836)
#: That of a text that is longer than its column.
LONGER = (1406,)
#: That which says that it ended a query after `LIMIT_S`.
TOO_LONG = (1969, 3024)
#: Time after which the server ends a query (s), also of a process that was killed meanwhile.
LIMIT_S = 600
#: Rights that accounts of workers have (`pbl_schemas.operations.roles`), as the server names them when it refuses.
_OF_WORKERS = ("SELECT", "INSERT", "UPDATE", "DELETE")


class RightMissing(AccessError, PblError):
    """DB_REFUSED for a statement that the account may not execute; names the account that may. role: end of its name,
    where it is not the least that may execute this statement."""

    def __init__(self, found: str, role: str = "") -> None:
        role = role or ("worker" if found.startswith(_OF_WORKERS) else "owner")
        account = f"{os.environ.get('PBL_DB_PREFIX') or 'pbl'}_{role}"
        PblError.__init__(
            self,
            "DB_REFUSED",
            found=found,
            expected=f"an account that may do this, such as {account}",
            next_step=f"repeat it with DJ_USER={account} and its password (DJ_PASS or DJ_PASS_FILE); `pbl db roles` "
            "makes that account",
        )


#: The driver's connections of this process.
_opened: weakref.WeakSet[Any] = weakref.WeakSet()


class MySQLOrMariaDB(MySQLAdapter):
    """DataJoint's adapter for MySQL, which makes each new connection (also a later one) work on MariaDB too, in UTC.

    Two things differ there. MariaDB does not see that a primary key determines the other columns of its table, so that
    with ONLY_FULL_GROUP_BY `A.aggr(B)` fails with error 1055; and its JSON type is text, for which DataJoint hands a
    bare dict to the driver when it stores the pointer to an object in the store.
    """

    def connect(self, *args: Any, **kwargs: Any) -> Any:
        """The driver's connection in UTC, repaired where the server is MariaDB."""
        connection = super().connect(*args, **kwargs)
        with connection.cursor() as cursor:
            cursor.execute(UTC)
            mariadb = "MariaDB" in connection.get_server_info()
            limit = f"max_statement_time = {LIMIT_S}" if mariadb else f"max_execution_time = {1000 * LIMIT_S}"
            cursor.execute(f"SET SESSION {limit}")
            if mariadb:
                cursor.execute("SET SESSION sql_mode = REPLACE(@@SESSION.sql_mode, 'ONLY_FULL_GROUP_BY', '')")
                connection.encoders = {**connection.encoders, dict: _json_literal}
        _opened.add(connection)
        return connection

    def load_foreign_keys_sql(self, schemas_list: str, like_pattern: str) -> str:
        """DataJoint's query, with the columns of each key in their order: without it MySQL returns them in any, and
        DataJoint takes the index of a key whose columns are in another order for one that no definition has."""
        query = super().load_foreign_keys_sql(schemas_list, like_pattern)
        return f"{query} ORDER BY table_schema, table_name, constraint_name, ordinal_position"

    def translate_error(self, error: Exception, query: str = "") -> Exception:
        """DataJoint's error; of a right that is missing one with a code."""
        translated = super().translate_error(error, query)
        return RightMissing(str(error.args[-1])) if isinstance(translated, AccessError) else translated


def end_queries() -> None:
    """Have the server end the queries in which this process was interrupted."""
    for connection in list(_opened):
        if not connection.open:  # the driver closes one whose answer it no longer waits for
            number = connection.thread_id()
            with suppress(pymysql.err.Error):  # it has ended, or the server cannot be reached
                connection.connect()
                connection.query(f"KILL {number}")


INTERRUPTS.append(end_queries)


def _json_literal(value: dict[str, Any], _mapping: object = None) -> str:
    return "'" + escape_string(json.dumps(value)) + "'"


ADAPTERS["mysql"] = MySQLOrMariaDB


# ------------------------------------------------------------------------------------------------------ private names
def backend_of(name: str) -> StorageBackend:
    """DataJoint's access to a store of the configuration."""
    config: Any = datajoint.config
    return get_store_backend(name, config=config)


def full_path(backend: Any, path: str) -> str:
    """Return the location of an object in a store: a path of the file system, or `bucket/key`."""
    return str(backend._full_path(path))


@contextmanager
def inserting(table: Any) -> Iterator[None]:
    """Let a computed table (instance) take rows, as DataJoint's populate does while it inserts."""
    cls = type(table)
    cls._allow_insert = True
    try:
        yield
    finally:
        cls._allow_insert = False


def read_heading_again(cls: Any) -> None:
    """Read the columns of a table (class) anew: DataJoint keeps those that it read first."""
    cls._heading = type(cls._heading)(table_info=cls._heading.table_info)


#: Columns by the table's full name that `columns_read_once` has read; None outside of it.
_columns: ContextVar[dict[str, Any] | None] = ContextVar("columns", default=None)


class _FreeTable(datajoint_table.FreeTable):
    """A table as DataJoint's cascades make it, anew for each of its parents."""

    def __init__(self, conn: Any, full_table_name: str) -> None:
        super().__init__(conn, full_table_name)
        if (read := _columns.get()) is not None:
            self._heading = read.setdefault(full_table_name, self._heading)


setattr(datajoint_table, "FreeTable", _FreeTable)  # noqa: B010


@contextmanager
def columns_read_once() -> Iterator[None]:
    """Let cascades in this block read the columns of a table once; DataJoint reads them for each foreign key."""
    before = _columns.set({})
    try:
        yield
    finally:
        _columns.reset(before)
