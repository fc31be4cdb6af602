"""How long who films waits for a verdict and an index, while other recordings are being computed: docs/capture.md.

    python -m research.benchmarks.phone_waits                    # 1,000 recordings wait, two processes, five by phone
    python -m research.benchmarks.phone_waits --videos 20 --phones 1

A separate database holds as many recordings as `--videos`: different files with the demo's walk, 7 s at 1080p.
`pbl worker` computes them for real. Once it detects keypoints, recordings are registered as the page of a phone does
when its upload has ended, one after the other; each is of another visit.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.bench.detect import demo_clip, numbered
from research.benchmarks.workers import _PBL, say
from tests.database import installation

#: Seconds between two questions to the database, and after which a recording that has no answer counts as none.
_ASK_S, _MOST_S = 0.25, 600.0


def copy_of(clip: Path, number: int) -> Path:
    """Return another file with the same pictures."""
    path = clip.with_name(f"{number:05d}.mp4")
    path.write_bytes(numbered(clip.read_bytes(), number))
    return path


def wait_for(known: Callable[[], bool], begin: float) -> float:
    """Return the seconds from `begin` until something is known; NaN where it never is."""
    while not known():
        if time.monotonic() - begin > _MOST_S:
            return float("nan")
        time.sleep(_ASK_S)
    return time.monotonic() - begin


@click.command()
@click.option("--videos", default=1000, show_default=True, help="Recordings that wait.")
@click.option("--processes", default=2, show_default=True, help="Of the worker.")
@click.option("--phones", default=5, show_default=True, help="Recordings that come from a phone meanwhile.")
def main(videos: int, processes: int, phones: int) -> None:
    """Print the seconds from the end of an upload to the verdict and to the index, medians and the longest."""
    import schemas
    from schemas import gdi, keypoints, video
    from schemas.intake import VisitRecord, register
    from schemas.intake.videos import OneCamera
    from schemas.reading.usable import PENDING, usable
    from workers import queue, refresh
    from workers.registry import FIRST

    with installation() as home, contextlib.ExitStack() as end:
        schemas.activate()
        clip = demo_clip(home / "clip.mp4")
        register(OneCamera(copy_of(clip, i), VisitRecord(f"B{i:05d}", "1")) for i in range(videos))
        refresh.refresh()
        command = [sys.executable, "-c", _PBL, "worker", "--processes", str(processes), "--no-selftest"]
        worker = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end.callback(worker.wait)
        end.callback(worker.terminate)
        wait_for(lambda: bool(keypoints.Keypoints.jobs.reserved), time.monotonic())
        verdicts, indices = [], []
        for i in range(phones):
            (one,) = register([OneCamera(copy_of(clip, videos + i), VisitRecord(f"P{i:05d}", "1"))])
            assert one.video_id is not None, one.error
            key = {"video_id": one.video_id}
            queue.fill(video.VideoInfo, [key], FIRST)
            begin = time.monotonic()
            verdicts.append(wait_for(lambda one=key["video_id"]: usable(one).state != PENDING, begin))
            visit = {"session_id": (video.Video & key).fetch1("session_id")}
            indices.append(wait_for(lambda of=visit: bool(gdi.SessionGdi & of), begin))
            click.echo(f"{usable(key['video_id']).state}: {verdicts[-1]:.1f} s, index {indices[-1]:.1f} s", err=True)
        left = videos + phones - len(keypoints.Keypoints())
    click.echo(f"{videos} recordings, {left} of all still without keypoints at the end; {processes} processes")
    say("verdict: median", float(np.median(verdicts)), "s", "bar 20")
    say("verdict: longest", max(verdicts), "s")
    say("index: median", float(np.median(indices)), "s", "bar 60")
    say("index: longest", max(indices), "s")


if __name__ == "__main__":
    main()
