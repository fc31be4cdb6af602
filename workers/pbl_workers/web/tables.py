"""The page's way to the tables, by one thread because DataJoint's connection serves one thread only; and to files."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

import pymysql

from pbl_pipeline.errors import os_errors_as

T = TypeVar("T")


class Asks(Protocol):
    """Executor of questions, away from the loop that answers browsers."""

    async def ask(self, question: Callable[..., T], *args: Any) -> T:
        """The answer of a function that reads or writes."""
        ...

    def close(self) -> None:
        """Accept no further questions."""


class Files(Asks):
    """Asks questions of files, several at a time."""

    async def ask(self, question: Callable[..., T], *args: Any) -> T:
        return await asyncio.to_thread(question, *args)


async def on_disk(next_step: str, work: Callable[..., T], *args: Any) -> T:
    """Return what a function returns that reads or writes the archive. Raises the error of the function;
    FILE_UNWRITABLE, with `next_step`, for its OSError."""
    with os_errors_as("FILE_UNWRITABLE", "room and rights in the archive of the server", next_step):
        return await asyncio.to_thread(work, *args)


class Tables:
    """Asks questions of the tables one after the other, away from the loop that answers browsers."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="tables")
        self._declared = False

    async def ask(self, question: Callable[..., T], *args: Any) -> T:
        """The answer of a function that reads or writes tables. Raises what the function raises; DB_NOT_RUNNING
        if the database is away, DB_REFUSED with the server's words for its other errors, STORE_FULL."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, self._answer, question, args)

    def _answer(self, question: Callable[..., T], args: tuple[Any, ...]) -> T:
        import pbl_schemas
        from pbl_schemas import connection, tables_version
        from pbl_schemas.job_errors import of_server, store_full

        try:
            if not self._declared:
                pbl_schemas.activate(methods=False)
                self._declared = True
            else:
                connection.connect()  # a server that was started again is found again
                tables_version.refuse_newer()  # migrated while the page was served
            return question(*args)
        except (pymysql.err.Error, connection.LostConnectionError) as error:
            raise of_server(error) from error
        except OSError as error:
            if (full := store_full(error)) is not None:
                raise full from error
            raise

    def close(self) -> None:
        """Wait for the current question and accept no further ones."""
        self._thread.shutdown(cancel_futures=True)
