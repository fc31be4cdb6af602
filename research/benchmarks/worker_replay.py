"""The database's own limit: the statements of real jobs, recorded once and sent again without Python's part of them.

The statements of each step of a worker are recorded as the driver got them. After the tables are as they were before,
processes send them again through the driver alone, as fast as the server answers. They change the same rows again, so
the tables tell whether the database did all of the work.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from typing import Any

import pymysql

#: A statement and its values, as DataJoint hands them to the driver.
Statement = tuple[str, tuple]
#: Where a step begins again after a deadlock: what opens a transaction.
_OPENS = ("SET TRANSACTION", "START TRANSACTION")


def record(tables: Sequence[Any]) -> list[list[Statement]]:
    """Do the queued jobs of these tables in this process; the statements of each step that found any."""
    from pbl_workers.heartbeat import Silent
    from pbl_workers.loop import Worker

    worker = Worker(tables, Silent())
    steps: list[list[Statement]] = []
    with _listening(tables[0].connection) as heard:
        while worker.step():
            steps.append(heard.copy())
            heard.clear()
    return steps


@contextlib.contextmanager
def _listening(connection: Any) -> Iterator[list[Statement]]:
    heard: list[Statement] = []
    real = connection.query

    def query(text: str, args: Any = (), **options: Any) -> Any:
        heard.append((text, tuple(args)))
        return real(text, args, **options)

    connection.query = query
    try:
        yield heard
    finally:
        del connection.query


def replay(steps: Sequence[Sequence[Statement]], connections: int) -> tuple[float, int]:
    """Send the steps again through so many connections, each of a process; seconds, and steps repeated after a
    deadlock. The steps are dealt out before, one to each in turn."""
    context = multiprocessing.get_context("spawn")
    ready, answers = context.Barrier(connections + 1), context.SimpleQueue()
    dealt = [list(steps[i::connections]) for i in range(connections)]
    processes = [context.Process(target=_send, args=(mine, ready, answers)) for mine in dealt]
    for process in processes:
        process.start()
    ready.wait()
    start = time.monotonic()
    repeated = sum(answers.get() for _ in processes)
    seconds = time.monotonic() - start
    for process in processes:
        process.join()
    return seconds, repeated


def _send(steps: Sequence[Sequence[Statement]], ready: Any, answers: Any) -> None:
    from pbl_schemas.connection import plain_connection

    repeated = 0
    with contextlib.closing(plain_connection()) as server, server.cursor() as cursor:
        ready.wait()
        for step in steps:
            repeated += _send_step(server, cursor, step)
    answers.put(repeated)


def _send_step(server: Any, cursor: Any, step: Sequence[Statement]) -> int:
    at = opened = repeated = 0
    while at < len(step):
        text, args = step[at]
        if text.startswith(_OPENS) and not step[at - 1][0].startswith(_OPENS):
            opened = at
        try:
            cursor.execute(text, args)
            cursor.fetchall()
            at += 1
        except pymysql.err.OperationalError as error:
            if error.args[0] not in (1205, 1213):
                raise
            server.rollback()
            at, repeated = opened, repeated + 1
    return repeated
