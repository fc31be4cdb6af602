"""Processor time of a process by what it does: read from the clocks and stacks of its threads, fifty times a second."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

#: Interval of the samples (s).
EVERY_S = 0.02
#: What a thread does, by the innermost frame of its stack that matches: part of the file's path, beginning of the
#: function's name.
KINDS = (
    ("start, imports", "<frozen importlib", ""),
    ("programs of JAX", "/jax/_src/", ("trace_to_jaxpr", "_infer_params", "lower_jaxpr", "compile_or_get_cached")),
    ("crops", "/pbl_pipeline/video/", ("cut", "_cut", "warp")),
    ("decode", "/pbl_pipeline/video/", ""),
    ("networks", "/pbl_pipeline/models/", ""),
    ("people, points", "/pbl_pipeline/tracking/", ""),
    ("people, points", "/pbl_pipeline/keypoints/", ""),
    ("fit", "/pbl_pipeline/fit/", ""),
    ("forces", "/pbl_pipeline/kinetics/", ""),
    ("events, measures", "/pbl_pipeline/gait/", ""),
    ("tables, queue", "/pbl_schemas/", ""),
    ("tables, queue", "/pbl_workers/", ""),
)


def kind_of(frame: FrameType | None) -> str:
    """Return what a thread with this innermost frame does; "other" where nothing matches."""
    # Of a thread that goes on meanwhile, Python 3.11 at times returns another object than the frame before.
    while (code := getattr(frame, "f_code", None)) is not None and frame is not None:
        for kind, path, name in KINDS:
            if path in code.co_filename and code.co_name.startswith(name):
                return kind
        frame = frame.f_back
    return "other"


@contextlib.contextmanager
def profiled(folder: str) -> Iterator[Callable[[str], None]]:
    """Write seconds of processor time by stage and kind, since the process began, to a file of `folder` ("": nothing);
    yields the function that names the stage from now on.

    Threads without Python's stack, such as those of XLA, count as what the main thread does or waits for.
    """
    found, stage, ended = defaultdict[tuple[str, str], float](float), ["-"], threading.Event()
    found["-", "start, imports"] = time.process_time()
    sampler = threading.Thread(target=_sample, args=(found, stage, ended), daemon=True)
    if folder:
        sampler.start()
    try:
        yield lambda name: stage.__setitem__(0, name)
    finally:
        if folder:
            ended.set()
            sampler.join()
            rows = [(*where, seconds) for where, seconds in found.items()]
            (Path(folder) / f"{os.getpid()}.json").write_text(json.dumps(rows), encoding="utf-8")


def _sample(found: defaultdict[tuple[str, str], float], stage: list[str], ended: threading.Event) -> None:
    main, before, all_before = threading.main_thread().ident, _clocks(), time.process_time()
    while not ended.wait(EVERY_S):
        spent, all_now = defaultdict[str, float](float), time.process_time()
        frames, clocks = sys._current_frames(), _clocks()
        for thread, now in clocks.items():
            last = before.get(thread, 0.0)  # of an earlier thread of that number if it is later than now
            spent[kind_of(frames.get(thread))] += now - last if now >= last else now
        spent[kind_of(frames.get(main or 0))] += max(0.0, all_now - all_before - sum(spent.values()))
        before, all_before = clocks, all_now
        for kind, seconds in spent.items():
            found[stage[0], kind] += seconds


def _clocks() -> dict[int, float]:
    """Processor time (s) of each thread that has a Python stack."""
    found = {}
    for thread in sys._current_frames():
        with contextlib.suppress(OSError):  # it has ended
            found[thread] = time.clock_gettime(time.pthread_getcpuclockid(thread))
    return found
