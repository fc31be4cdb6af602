"""Working processes with their heartbeats, and their throughput by the minute."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .datajoint_setup import dj

schema = dj.Schema()
#: `worker_resource` of rows of regular work, one for each kind of `pbl cron`: worker_seen is its last sign of life,
#: worker_stopped when it last succeeded, worker_doing how the last pass failed ("": it did not).
CRON = "cron"
#: `worker_resource` of a worker's supervisor, which takes no job: worker_doing names its processes that wait after they
#: died.
SUPERVISOR = "supervisor"


@schema
class Worker(dj.Manual):
    definition = """
    # a process that computes; its heartbeat tells a live reservation from a dead one
    worker          : char(16)                 # random
    ---
    worker_host     : varchar(255)
    worker_pid      : int32
    worker_resource : varchar(64)              # resource classes it serves
    worker_version  : varchar(64)              # version and commit of pbl-pipeline
    worker_started  : datetime(3)              # clock of the database server
    worker_seen     : datetime(3)              # last heartbeat, clock of the database server
    worker_stopped=null : datetime(3)          # when it ended in order
    worker_doing    : varchar(500)             # table and key in hand, or why it waits
    worker_gpus=null : json                    # of a supervisor: use of the GPUs of its machine; null: not known
    """


@schema
class Throughput(dj.Manual):
    definition = """
    # what a worker finished in a minute
    -> Worker
    stage           : varchar(64)              # computed table
    minute          : datetime                 # begin, clock of the database server
    ---
    n_done          : int32
    n_failed        : int32
    busy            : float64                  # (s) spent on these jobs
    """


@schema
class Look(dj.Manual):
    definition = """
    # when somebody last looked at all tables for what can be computed
    look        : enum('recent', 'all')        # of all rows; looks at recent recordings are no longer noted
    ---
    look_time   : datetime(3)                  # clock of the database server
    """


@schema
class Turn(dj.Manual):
    definition = """
    # work that one process of the installation does at a time, and whose turn it is
    work            : varchar(32)
    ---
    turn_lock       : char(32)                 # random name of a lock of the server
    turn_connection : int64                    # connection whose turn it is while it has that lock
    """


@contextmanager
def installation_lock(work: str, server: Any) -> Iterator[bool]:
    """Hold an installation-wide lock for some work: only one process on any machine has it.

    Yields whether it was obtained; never waits. It ends with the process or its connection, as the server's named locks
    do. Anyone can take those, also an analyst; so one counts only together with a row that names it and its
    connection, which takes the right to write.
    """
    lock, table = secrets.token_hex(16), Turn.full_table_name
    server.query("SELECT GET_LOCK(%s, 0)", args=(lock,))
    try:
        server.query(f"INSERT IGNORE INTO {table} VALUES (%s, '-', 0)", args=(work,))  # noqa: S608
        mine = server.query(
            f"UPDATE {table} SET turn_lock=%s, turn_connection=CONNECTION_ID()"  # noqa: S608
            " WHERE work=%s AND NOT (IS_USED_LOCK(turn_lock) <=> turn_connection)",
            args=(lock, work),
        )
        yield mine.rowcount == 1
    finally:
        try:
            server.query(f"DELETE FROM {table} WHERE work=%s AND turn_lock=%s", args=(work, lock))  # noqa: S608
        finally:  # a full disk refuses the first, and this connection may live for months
            server.query("SELECT RELEASE_LOCK(%s)", args=(lock,))
