"""One measured run of probe, tracking and keypoints in a separate process: `python -m pbl_pipeline.bench.detect_case
JSON`. The JSON names the video, the person, the number of repetitions and the file for the result."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .machine import peak_rss, write_result

T = TypeVar("T")
_SAMPLE_S = 0.5


def main() -> None:
    """Measure the case of the command line and write its result."""
    spec = json.loads(sys.argv[1])
    video, person = Path(spec["video"]), spec["person"]
    write_result(spec["result"], lambda: measure(video, person, spec["repeat"], spec["keypoints"]))


def measure(video: Path, person: int | None, repeat: int, keypoints: str | None) -> dict[str, Any]:
    """Return the figures of docs/benchmarks.md, section detect: of the fastest of `repeat` runs; memory over all."""
    runs = [_run(video, person, keypoints) for _ in range(repeat)]
    best = min(runs, key=lambda r: r["seconds"])
    return best | {"runs_seconds": [r["seconds"] for r in runs], "host_bytes": peak_rss()}


def _run(video: Path, person: int | None, keypoints: str | None) -> dict[str, Any]:
    from pbl_pipeline.keypoints import detect_keypoints
    from pbl_pipeline.tracking import choose_subject, time_in_view_s, track_people
    from pbl_pipeline.video import frames_kept, guess_camera, probe

    stages: dict[str, dict[str, Any]] = {}
    with frames_kept():
        info = _timed(stages, "decode", lambda: probe(video))
        tracking = _timed(stages, "tracking", lambda: track_people(video, info=info))
        subject = choose_subject(tracking, override=person).person_id
        if subject is None and tracking.persons:  # without a clear subject: the person in view for longest
            subject = max(tracking.persons, key=lambda p: time_in_view_s(p, tracking.time_s)).person_id
        # Without a person ID 0 raises the error.
        camera = guess_camera(info)
        found = _timed(
            stages, "keypoints", lambda: detect_keypoints(video, tracking, subject or 0, camera, params=keypoints)
        )
    return {
        "frames": info.n_frames,
        "frames_in_view": int((found.confidence.max(axis=1) > 0).sum()),
        "persons": len(tracking.persons),
        "width_px": info.width_px,
        "height_px": info.height_px,
        "codec": info.codec,
        "video_seconds": info.duration_s,
        "mbit_per_s": 8e-6 * info.size_bytes / info.duration_s,
        "seconds": sum(s["seconds"] for s in stages.values()),
        "cpu_seconds": sum(s["cpu_seconds"] for s in stages.values()),
        "stages": stages,
    }


def _timed(stages: dict[str, dict[str, Any]], name: str, call: Callable[[], T]) -> T:
    """Run a stage and keep its wall and CPU time, and its memory twice a second."""
    samples: list[int] = []
    done = threading.Event()

    def sample() -> None:
        while True:
            samples.append(resident_bytes() or 0)
            if done.wait(_SAMPLE_S):
                return

    watcher = threading.Thread(target=sample, daemon=True)
    begin, cpu = time.perf_counter(), _cpu_seconds()
    watcher.start()
    try:
        result = call()
    finally:
        seconds, cpu = time.perf_counter() - begin, _cpu_seconds() - cpu
        done.set()
        watcher.join()
    known = np.array([s for s in samples if s])
    stages[name] = {
        "seconds": seconds,
        "cpu_seconds": cpu,
        "host_bytes": int(known.max()) if len(known) else None,
        "growth_bytes": growth(known),
    }
    return result


def growth(samples: np.ndarray) -> int | None:
    """Difference in memory between the last quarter of a stage and the second one (medians); None for a short stage.
    One as large as a video's frames shows that frames accumulate."""
    quarter = len(samples) // 4
    if quarter < 4:
        return None
    return int(np.median(samples[-quarter:]) - np.median(samples[quarter : 2 * quarter]))


def resident_bytes() -> int | None:
    """Memory of this process now; None if the system does not state it."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None


def _cpu_seconds() -> float:
    spent = os.times()
    return spent.user + spent.system


if __name__ == "__main__":
    main()
