"""Keypoints of video files in many processes at once, on a GPU if one is visible: research/reports.

    python -m research.benchmarks.many_videos                      # the demo recording at 1080p, 64 times
    python -m research.benchmarks.many_videos VIDEO ... --copies 8 --processes 2 --device cpu

Each process probes, tracks and detects one video after the other with its share of the cores, as those of `pbl worker`
do. A first round, of one video a process, loads the networks and is not counted.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import numpy as np

from pbl_pipeline.bench.detect import demo_clip
from pbl_pipeline.bench.detect_case import measure
from pbl_pipeline.keypoints import METHODS, Keypoints
from pbl_pipeline.resources import cores, shared_cores
from pbl_pipeline.temporary import new_folder
from pbl_pipeline.video import frames_kept
from research.clip_keypoints import clip_keypoints

#: Points that a detector is less sure of are not compared.
SURE = 0.5


#: Contexts that stay open until the process ends.
_OPEN = contextlib.ExitStack()


def keep_frames() -> None:
    """Keep pictures, and their memory from one video to the next, as a worker does until its process ends."""
    _OPEN.enter_context(frames_kept())


def keypoints_of(video: Path, folder: Path, method: str, device: str) -> Keypoints:
    """Return the keypoints of a video's subject, all networks computed on a device."""
    os.environ["PBL_ONNX_DEVICE"] = device
    return clip_keypoints(video, folder / f"{device}.jpg", METHODS.find(method))


def differences(a: Keypoints, b: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of points that both hold for sure: in the picture (px), and of their 3D positions (mm)."""
    sure = (a.confidence > SURE) & (b.confidence > SURE)
    apart = [np.linalg.norm(x - y, axis=-1)[sure] for x, y in ((a.xy_px, b.xy_px), (a.xyz_cam_m, b.xyz_cam_m))]
    return apart[0], 1e3 * apart[1]


def rate(videos: Sequence[Path], method: str, processes: int) -> tuple[float, float, list[dict[str, Any]]]:
    """Return frames a second over all videos, the seconds of the first round, and the figures of each video."""
    measured = functools.partial(measure, person=None, repeat=1, keypoints=method)
    with shared_cores(processes), ProcessPoolExecutor(processes, get_context("spawn"), keep_frames) as pool:
        begin = time.perf_counter()
        list(pool.map(measured, videos[:processes]))
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        done = list(pool.map(measured, videos))
        return sum(d["frames"] for d in done) / (time.perf_counter() - begin), first, done


@click.command()
@click.argument("videos", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--copies", type=click.IntRange(1), default=64, show_default=True, help="How often each video is taken.")
@click.option("--processes", type=click.IntRange(1), help="At once; default: as many as cores.")
@click.option("--method", default="blazepose-heavy", show_default=True, help="Of the keypoints.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True)
@click.option("--against-cpu", is_flag=True, help="Compare the first video's keypoints with those computed on the CPU.")
def main(
    videos: tuple[Path, ...], copies: int, processes: int | None, method: str, device: str, against_cpu: bool
) -> None:
    """Print frames a second from video files to keypoints, and how far the devices' keypoints are apart."""
    os.environ["PBL_ONNX_DEVICE"] = device
    with new_folder() as folder:
        of = list(videos) or [demo_clip(folder / "demo1080.mp4")]
        some = processes or cores()
        found, first, done = rate(of * copies, method, some)
        click.echo(f"{len(of) * copies} videos, {some} processes: {found:.0f} frames/s; first round {first:.1f} s")
        for stage in done[0]["stages"]:
            passed, spent = (np.mean([d["stages"][stage][k] for d in done]) for k in ("seconds", "cpu_seconds"))
            click.echo(f"{stage} of a video: {passed:.2f} s, of which {spent:.2f} s in its process")
        if against_cpu:
            with ProcessPoolExecutor(2, get_context("spawn")) as pool:
                two = list(pool.map(keypoints_of, [of[0]] * 2, [folder] * 2, [method] * 2, [device, "cpu"]))
            for unit, apart in zip(("px", "mm"), differences(*two), strict=True):
                median, most = np.percentile(apart, [50, 99])
                click.echo(f"from the CPU's: median {median:.4f} {unit}, 99th percentile {most:.4f} {unit}")


if __name__ == "__main__":
    main()
