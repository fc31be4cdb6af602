"""Who works on the queues: processes with their heartbeats, what they did by the minute, jobs that killed them."""

from __future__ import annotations

from ._datajoint import dj

schema = dj.Schema()


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
class Crash(dj.Manual):
    definition = """
    # jobs in whose hands a worker process died or was ended at its time limit; too often makes an error row
    stage           : varchar(64)              # computed table
    job_hash        : char(16)                 # of the job's key
    ---
    job_key         : json
    crash_n         : int16                    # how often
    crash_reason    : varchar(255)             # of the last time
    crash_time      : datetime                 # of the last time, UTC
    """


@schema
class Look(dj.Manual):
    definition = """
    # when somebody last looked at all tables for what can be computed
    look        : enum('recent', 'all')        # of all rows; looks at recent recordings are no longer noted
    ---
    look_time   : datetime(3)                  # clock of the database server
    """
