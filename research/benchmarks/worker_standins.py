"""The processes of a worker for measuring the queue: heavy stages give a recorded result, the others are real."""

from __future__ import annotations

import dataclasses
import functools
import os
import re
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

import pbl_pipeline.fit
import pbl_pipeline.keypoints
import pbl_pipeline.tracking
import pbl_pipeline.video
import pbl_schemas.video
from pbl_workers import heartbeat, loop, process, selftest
from pbl_workers.process import Options
from tests.integration import chain

#: Variable that names the recording whose probe every video gives.
RECORDED = "PBL_BENCH_RECORDED"
#: Seconds that a probe takes, where a fault should meet jobs in hand.
SLEEP = "PBL_BENCH_SLEEP"
#: Frames of a video that tracking and keypoints read in a second; not set: they take no time.
RATE = "PBL_BENCH_RATE"
#: The same of a real detector, on a core that does other work as well.
REAL_RATE = 20.0
#: Frames of a video whose path does not say how many (6 s at 30 frames/s).
FRAMES = 180


def frames_of(path: Path | str) -> int:
    """Frames of a video, as the stem of its path says: `7_216000frames`."""
    found = re.search(r"_(\d+)frames$", Path(path).stem)
    return int(found[1]) if found else FRAMES


def install(patch: pytest.MonkeyPatch) -> None:
    """Replace the heavy stages by recorded results; no video is opened."""
    chain.install(patch)
    probe = functools.cache(pbl_pipeline.video.probe)
    recorded, pause = Path(os.environ[RECORDED]), float(os.environ.get(SLEEP, "0"))

    def given(path: Path):
        time.sleep(pause)
        return dataclasses.replace(probe(recorded), path=str(path), n_frames=frames_of(path))

    patch.setattr(pbl_pipeline.video, "probe", given)
    first = functools.cache(lambda: [*pbl_pipeline.video.read_frames(recorded, stop=1)])
    patch.setattr(chain, "probe", lambda _: probe(recorded))
    patch.setattr(chain, "read_frames", lambda _, stop: first()[:stop])
    patch.setattr(pbl_schemas.video, "registered_file", lambda path, sha256, key: Path(path))
    if RATE in os.environ:
        rate = float(os.environ[RATE])
        patch.setattr(loop, "IDLE_S", tuple(s * REAL_RATE / rate for s in loop.IDLE_S))  # pauses are shorter as well
        for module, name in ((pbl_pipeline.tracking, "track_people"), (pbl_pipeline.keypoints, "detect_keypoints")):
            patch.setattr(module, name, _timed(getattr(module, name), rate))


def _timed(detect: Callable[..., Any], rate: float) -> Callable[..., Any]:
    def timed(path: Path, *more: Any, **named: Any) -> Any:
        time.sleep(frames_of(path) / rate)
        return detect(path, *more, **named)

    return timed


def work(options: Options, pipe: Connection) -> None:
    """`pbl_workers.process.work` with recorded results; the self-test, where it is asked for, is the real one."""
    check, fit_session = selftest.check, pbl_pipeline.fit.fit_session

    def real_check(tables: Sequence[Any]) -> None:
        with pytest.MonkeyPatch.context() as real:
            real.setattr(pbl_pipeline.fit, "fit_session", fit_session)
            check(tables)

    patch = pytest.MonkeyPatch()
    install(patch)
    patch.setattr(selftest, "check", real_check)
    heartbeat.PERIOD_S = 1.0
    process.work(options, pipe)
