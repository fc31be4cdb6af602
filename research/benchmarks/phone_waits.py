"""Waiting time for a verdict and an index after filming, while other recordings are being computed.

    python -m research.benchmarks.phone_waits                    # 1,000 recordings wait, two processes, five by phone
    python -m research.benchmarks.phone_waits --videos 20 --phones 1
    python -m research.benchmarks.phone_waits --takes 6          # none wait: what the page films against the same file

A separate database holds as many recordings as `--videos`: different files with the demo's walk, 7 s at 1080p.
`pbl worker` computes them for real. Once it detects keypoints, recordings are registered as the page of a phone does
when its upload has ended, one after the other; each is of another visit.

`--takes` films the walk of `tests/end_to_end/test_phone.py` in Chromium so often instead, a minute or two each on two
idle cores, and prints of each take the index against that of the same clip as a file (bar 1 point), by how much the
page's log is ahead of the pictures and the error of the fit's clock (bar 10 ms), and the frames lost (bar 1 %).
"""

from __future__ import annotations

import contextlib
import os
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


def film(takes: int) -> None:
    """Print index, clocks and lost frames of so many takes."""
    from playwright.sync_api import sync_playwright

    import pbl_schemas
    from pbl_pipeline import assets
    from pbl_schemas import computed_tables, gdi
    from pbl_schemas.capture import PhoneRecording
    from pbl_schemas.jobs import jobs_of
    from tests.end_to_end.test_phone import clocks_s, take, trial_of
    from tests.rows import remove_all

    with installation() as home, sync_playwright() as playwright:
        pbl_schemas.activate()
        for i in range(takes):
            folder = home / f"take-{i}"
            folder.mkdir()
            walked = take(playwright.chromium, Path(assets.fetch("demo_video")), folder)
            about, load = PhoneRecording().fetch1("phone_about"), os.getloadavg()[0]
            lost, whole = about["dropped"], about["frames"] + about["dropped"]
            if len(gdi.SessionGdi & "session_gdi IS NOT NULL") < 2:
                why = [row["error_message"] for t in computed_tables() for row in jobs_of(t).errors.to_dicts()]
                click.echo(f"take {i + 1}, load {load:.1f}: no index, {lost} of {whole} frames lost; {'; '.join(why)}")
                remove_all()
                continue
            phone, file = (trial_of(label) for label in ("2026-01-10", "2026-02-01"))
            ahead, off = (1000 * s for s in clocks_s(walked))
            index, other = phone["session_gdi"], file["session_gdi"]
            click.echo(
                f"take {i + 1}, load {load:.1f}: index {index:.2f}, as a file {other:.2f}: {index - other:+.2f} points "
                f"({phone['session_gdi_n']} and {file['session_gdi_n']} cycles); log {ahead:+.0f} ms ahead of the "
                f"pictures, the fit's clock off by {off:+.1f} ms; {lost} of {whole} frames lost"
            )
            remove_all()


@click.command()
@click.option("--videos", default=1000, show_default=True, help="Recordings that wait.")
@click.option("--processes", default=2, show_default=True, help="Of the worker.")
@click.option("--phones", default=5, show_default=True, help="Recordings that come from a phone meanwhile.")
@click.option("--takes", default=0, show_default=True, help="Takes to film, instead of all that.")
def main(videos: int, processes: int, phones: int, takes: int) -> None:
    """Print the seconds from the end of an upload to the verdict and to the index, medians and the longest."""
    if takes:
        film(takes)
        return
    import pbl_schemas
    from pbl_schemas import gdi, keypoints, video
    from pbl_schemas.intake import VisitRecord, register
    from pbl_schemas.intake.videos import OneCamera
    from pbl_schemas.reading.usable import PENDING, usable
    from pbl_workers import queue, refresh
    from pbl_workers.registry import FIRST

    with installation() as home, contextlib.ExitStack() as end:
        pbl_schemas.activate()
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
