"""What the processes of a worker run in tests: the real one, behind stand-ins for the slow stages.

A recording's name says what it does to the process that probes it: `kills` ends it at once, `hangs` never returns,
`slow` ends soon after its process was told to end. Tracking of an `hour` ends when there is a file of its name and
`.go`. The GPU `full` has no memory.
"""

import os
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

import pbl_pipeline.tracking
import pbl_pipeline.video
from pbl_workers import heartbeat, loop, process
from pbl_workers.process import Options

from . import chain


def work(options: Options, pipe: Connection) -> None:
    """`pbl_workers.process.work` with stand-ins."""
    if options.gpus == ("full",):
        raise SystemExit(process.DEVICE_FAILED)
    patch = pytest.MonkeyPatch()
    chain.install(patch)
    real = pbl_pipeline.video.probe

    def probe(path: Path):
        name = Path(path).stem
        if "kills" in name:
            os.kill(os.getpid(), signal.SIGKILL)
        if "hangs" in name:
            time.sleep(3600)
        if "slow" in name:
            told, told_to_end = threading.Event(), signal.getsignal(signal.SIGTERM)
            assert callable(told_to_end)
            signal.signal(signal.SIGTERM, lambda *given: (told.set(), told_to_end(*given)))
            _note(path, "begun")
            while not told.is_set():
                time.sleep(0.05)
            time.sleep(0.3)
        return real(path)

    def track_people(path: Path, *more: Any, **named: Any) -> Any:
        while "hour" in Path(path).stem and not Path(f"{path}.go").exists():
            time.sleep(0.1)
        return chain.track_people(path, *more, **named)

    patch.setattr(pbl_pipeline.video, "probe", probe)
    patch.setattr(pbl_pipeline.tracking, "track_people", track_people)
    patch.setattr(heartbeat, "PERIOD_S", 0.2)
    # Shorter pauses than in production.
    patch.setattr(loop, "IDLE_S", (0.1, 1.0))
    patch.setattr(loop, "PHONE_S", 0.2)
    patch.setattr(loop, "LONG_EVERY_S", 0.5)
    process.work(options, pipe)


def _note(path: Path, what: str) -> None:
    Path(f"{path}.{what}").touch()
