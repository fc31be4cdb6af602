"""Working processes that end as the name of their GPU says."""

import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

from pbl_workers.process import DEVICE_FAILED, SELFTEST_FAILED, Options


def work(options: Options, pipe: Connection) -> None:
    """Note the start in the folder `options.profile`; `full` and `wrong` end with an error, `idle` ends in order, any
    other waits to be told."""
    name = options.gpus[0] if options.gpus else "phones"
    with (Path(options.profile) / name).open("a", encoding="utf-8") as notes:
        notes.write(f"{os.getpid()}\n")
    code = {"full": DEVICE_FAILED, "wrong": SELFTEST_FAILED, "idle": 0}.get(name)
    if code is not None:
        raise SystemExit(code)
    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: told.append(1))
    while not told:
        time.sleep(0.02)
