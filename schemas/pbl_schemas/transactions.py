"""Transactions that are run again where another process was in the way, and numbers that are given once."""

from __future__ import annotations

import contextlib
import functools
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import pymysql

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError, said

from . import lab
from .datajoint_setup import REPEAT, DuplicateError, dj
from .store import CLIENTS, store_error, unkept

T = TypeVar("T")
Arguments = ParamSpec("Arguments")

_ATTEMPTS = 20
#: Longest pause before a transaction is begun again (s): random, so that two do not meet again.
_PAUSE_S = 0.1


#: Calls that wait until the open transaction is committed.
_waiting: list[Callable[[], object]] = []


def _inside() -> bool:
    return lab.schema.connection is not None and lab.schema.connection.in_transaction


def after_commit(call: Callable[[], object]) -> None:
    """Call once the open transaction, of a `repeated` function, is committed; immediately if none is open. Where it
    fails that function raises `PblError` NOT_QUEUED: what it wrote stays."""
    _waiting.append(call) if _inside() else _follow(call)


def _follow(call: Callable[[], object]) -> None:
    try:
        call()
    except Exception as error:
        raise PblError(
            "NOT_QUEUED",
            found=said("it is stored, but what follows from it is not queued yet ({why})", why=type(error).__name__),
            expected="jobs for what is to be computed",
            next_step="do not send it again: workers look for it by themselves, within an hour at the latest",
        ) from error


def repeated(work: Callable[Arguments, T]) -> Callable[Arguments, T]:
    """Decorator of a function that is one transaction: begin it again where the server broke it off for another one's
    sake (deadlock, lock wait). Inside a transaction that is open the error propagates to whoever opened it."""

    @functools.wraps(work)
    def wrapper(*arguments: Arguments.args, **named: Arguments.kwargs) -> T:
        for attempt in range(_ATTEMPTS):
            if not _inside():
                _waiting.clear()
            try:
                done = work(*arguments, **named)
            except pymysql.err.OperationalError as error:
                if error.args[0] not in REPEAT or _inside() or attempt == _ATTEMPTS - 1:
                    raise
                time.sleep(random.uniform(0.0, _PAUSE_S))  # noqa: S311
                continue
            if not _inside():
                calls, _waiting[:] = _waiting.copy(), []  # a call may be a transaction itself
                with contextlib.ExitStack() as all_of_them:
                    for call in reversed(calls):
                        all_of_them.callback(_follow, call)
            return done
        raise AssertionError("unreachable")

    return wrapper


#: Statement after which the next transaction, and no other, sees what others have committed until each of its queries.
READ_COMMITTED = "SET TRANSACTION ISOLATION LEVEL READ COMMITTED"


@contextmanager
def read_committed(connection: Any) -> Iterator[None]:
    """A transaction in which every query sees what others have committed, and not the state before a lock that it waits
    for; without locks on what it reads."""
    connection.query(READ_COMMITTED)
    with connection.transaction:
        yield


@repeated
def in_transaction(work: Callable[[], T], until: Callable[[], bool] = lambda: False, *, fresh: bool = False) -> T:
    """Run `work` in a transaction; again where another process inserted the same at that moment, unless `until` holds
    then. `fresh`: one that is `read_committed`."""
    for attempt in range(_ATTEMPTS):
        try:
            connection: Any = lab.schema.connection
            with read_committed(connection) if fresh else connection.transaction:
                return work()
        except DuplicateError:
            if until() or attempt == _ATTEMPTS - 1:
                raise
    raise AssertionError("unreachable")


def keep_files(work: Callable[[], T], until: Callable[[], bool] = lambda: False) -> T:
    """Run `work`, which puts files into the store, as `in_transaction` that is `fresh`. Raises `PblError` FILE_MISSING,
    MACHINE_SHORT for one of these files, else STORE_FULL, STORE_UNAVAILABLE; errors of the database as they are."""
    try:
        return in_transaction(work, until, fresh=True)
    except Exception as error:
        if not isinstance(error, OSError) and type(error).__module__.partition(".")[0] not in CLIENTS:
            raise
        name = getattr(error, "filename", None)  # an object store's client has others, or a number
        of_file = isinstance(name, (str, Path)) and not Path(name).absolute().is_relative_to(settings.store_dir())
        raise unkept(error) if of_file and isinstance(error, OSError) else store_error(error) from error


def next_id(table: Any, attribute: str, n: int = 1) -> int:
    """The first of n numbers that no row of the table has or has had. Inside a transaction others wait for its end."""
    highest = dj.U().aggr(table, highest=f"max({attribute})").fetch1("highest") or 0
    table.connection.query(
        f"INSERT INTO {lab.Numbered.full_table_name} VALUES (%s, %s)"  # noqa: S608
        " ON DUPLICATE KEY UPDATE numbered_last = GREATEST(numbered_last, %s) + %s",
        args=(attribute, int(highest) + n, int(highest), n),
    )
    return int((lab.Numbered & {"numbered": attribute}).fetch1("numbered_last")) - n + 1
