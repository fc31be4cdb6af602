"""Tracking: what looking only where it is needed costs in accuracy and saves in time, and its memory over a long video.

    python -m research.benchmarks.tracking accuracy
    python -m research.benchmarks.tracking memory --minutes 10

`accuracy` runs on the demo recording, the two phone clips and the four cameras of `../shared/data/real` (what is absent
is left out). It compares three ways of detecting with the region that the landmark network shows in each frame, which
none of them knows: `watch` is what the pipeline does, `often` the same in every frame, `throughout` the whole
frame and all tiles in every frame. Printed are the overlap of the body boxes (median and 5th percentile of the frames),
the distance of the centres in body heights (median, 95th percentile), the share of the frames in which the person is
tracked, the person's number, detector calls a second and processor time a frame (decoding included).

`memory` repeats the demo recording at 1080p and prints the resident memory of this process as tracking goes on.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.bench.detect import demo_clip
from pbl_pipeline.keypoints import BlazePoseLandmarks
from pbl_pipeline.keypoints.crops import smooth_rois
from pbl_pipeline.models import box_iou
from pbl_pipeline.tracking import (
    METHODS,
    BlazePoseWindows,
    Detection,
    PersonTrack,
    Tracking,
    TrackingParams,
    body_box,
    track_people,
)
from pbl_pipeline.tracking import track as tracks
from pbl_pipeline.video import VideoInfo, find_camera, probe, read_frames
from research.benchmarks.longer_video import repeated
from research.paths import SHARED

REAL = SHARED / "real"
SMOOTH_S = 0.1
USUAL = METHODS.find().params
WAYS = {
    "watch": USUAL,
    "often": dataclasses.replace(
        USUAL,
        watch=dataclasses.replace(USUAL.watch, follow_interval_s=0.0, rest_interval_s=0.0, close_interval_s=0.0),
    ),
    "throughout": dataclasses.replace(
        USUAL,
        watch=dataclasses.replace(
            USUAL.watch,
            follow_interval_s=0.0,
            rest_interval_s=0.0,
            close_interval_s=0.0,
            search_interval_s=0.0,
            search_windows=99,
        ),
    ),
}


class Counted(BlazePoseWindows):
    """The detector of `USUAL`, counting its calls."""

    def __init__(self) -> None:
        super().__init__(assets.fetch("blazepose_detector"), USUAL.min_score)
        self.calls = 0

    def detect(self, image: np.ndarray) -> list[Detection]:
        self.calls += 1
        return super().detect(image)


def clips(frames: int) -> Iterator[tuple[str, Path, int]]:
    """Name, file and frames to take of every clip that is there."""
    yield "demo", assets.fetch("demo_video"), frames
    for name in ("walk", "STS"):
        yield name, REAL / "video_mocap" / name / "video.mp4", frames
    for number in (1, 2, 3, 4):
        yield f"cam0{number}", REAL / "multiview" / f"cam0{number}.mp4", frames


def shown_circles(path: Path, info: VideoInfo, track: PersonTrack, n: int) -> np.ndarray:
    """Body circles (T, 4) that the landmark network shows when it looks twice, the second time where it saw a body."""
    landmarks = BlazePoseLandmarks(assets.fetch("blazepose_landmarks"))
    camera = find_camera(info, None)
    start = smooth_rois(track.roi_px, info.time_s, SMOOTH_S)
    out = np.full((info.n_frames, 4), np.nan)
    for frame in read_frames(path, stop=n):
        roi = start[frame.index]
        for _ in range(2):
            if not np.isfinite(roi).all():
                break
            found = landmarks.detect(frame.image, roi, camera, quick=True)
            roi = found.roi_px if found.presence > 0.5 else np.full(4, np.nan)
        out[frame.index] = roi
    return smooth_rois(out, info.time_s, SMOOTH_S)


def agreement(tracking: Tracking, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return for the track that overlaps most with one true person: overlap and distance in the common frames, their
    share of the person's, and the number of the track."""
    known = np.isfinite(truth[:, 0])
    best: tuple[float, tuple[np.ndarray, np.ndarray, float, int]] | None = None
    for person in tracking.persons:
        circles = smooth_rois(person.roi_px, tracking.time_s, SMOOTH_S)
        both = np.flatnonzero(known & np.isfinite(circles[:, 0]))
        if not len(both):
            continue
        boxes = body_box(circles), body_box(truth)
        overlap = np.array([box_iou(boxes[1][i], boxes[0][i : i + 1])[0] for i in both])
        apart = np.hypot(*(circles[both, :2] - truth[both, :2]).T) / truth[both, 2]
        if best is None or overlap.sum() > best[0]:
            best = float(overlap.sum()), (overlap, apart, len(both) / known.sum(), person.person_id)
    assert best is not None
    return best[1]


@click.group()
def main() -> None:
    """Benchmarks of tracking."""


@main.command()
@click.option("--frames", default=240, show_default=True, help="Take so many frames of each clip.")
def accuracy(frames: int) -> None:
    """Compare looking where it is needed with looking everywhere."""
    detector = Counted()
    click.echo(
        f"{'clip':<7}{'way':<12}{'people':>7}{'person':>7}{'overlap':>9}{'5 %':>7}{'apart':>8}{'95 %':>7}{'frames':>8}"
        f"{'calls/s':>9}{'ms/frame':>10}"
    )
    for name, path, most in clips(frames):
        if not path.is_file():
            click.echo(f"{name:<7}not here")
            continue
        info = probe(path)
        n = min(most, info.n_frames)
        part = dataclasses.replace(info, n_frames=n, time_s=info.time_s[:n])
        results = {way: _timed(path, part, params, detector) for way, params in WAYS.items()}
        # Those who are in view for a second or more when everything is searched.
        for person in results["throughout"][0].persons:
            if np.isfinite(person.box_px[:, 0]).sum() < info.fps:
                continue
            truth = shown_circles(path, part, person, n)
            for way, (tracking, calls, seconds) in results.items():
                overlap, apart, share, number = agreement(tracking, truth)
                click.echo(
                    f"{name:<7}{way:<12}{len(tracking.persons):>7}{number:>7}{np.median(overlap):>9.2f}"
                    f"{np.percentile(overlap, 5):>7.2f}{np.median(apart):>8.3f}{np.percentile(apart, 95):>7.3f}"
                    f"{share:>8.0%}{calls / part.time_s[-1]:>9.1f}{1e3 * seconds / n:>10.1f}"
                )


def _timed(path: Path, part: VideoInfo, params: TrackingParams, detector: Counted) -> tuple[Tracking, int, float]:
    before, start = detector.calls, time.process_time()
    whole: Callable = tracks.read_frames
    # Only the first frames: the tracker reads to the end of what was probed.
    tracks.read_frames = lambda p, start=0, stop=None: whole(p, start, min(stop or part.n_frames, part.n_frames))
    try:
        tracking = track_people(path, params, detector, part)
    finally:
        tracks.read_frames = whole
    return tracking, detector.calls - before, time.process_time() - start


@main.command()
@click.option("--minutes", default=10.0, show_default=True)
@click.option("--every", default=1800, show_default=True, help="Print after so many frames.")
def memory(minutes: float, every: int) -> None:
    """Track a long 1080p video and print the memory on the way."""
    with tempfile.TemporaryDirectory(prefix="pbl-bench-") as name:
        path = repeated(demo_clip(Path(name) / "clip.mp4"), Path(name) / "long.mp4", 60 * minutes)
        info = probe(path)
        click.echo(f"{info.n_frames} frames of {info.width_px}x{info.height_px}, {info.duration_s:.0f} s")
        start, processor = time.monotonic(), time.process_time()
        whole: Callable = tracks.read_frames

        def told(p: Path, *part: int) -> Iterator:
            for frame in whole(p, *part):
                if frame.index % every == 0:
                    click.echo(f"  frame {frame.index:>6}: {_resident_mb():.0f} MB")
                yield frame

        tracks.read_frames = told
        try:
            tracking = track_people(path, info=info)
        finally:
            tracks.read_frames = whole
        seconds, processor = time.monotonic() - start, time.process_time() - processor
        click.echo(f"  at the end:   {_resident_mb():.0f} MB")
        click.echo(
            f"{len(tracking.persons)} people; {info.n_frames / seconds:.1f} frames/s, "
            f"{1e3 * processor / info.n_frames:.1f} ms of processor time a frame, decoding included"
        )


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    main()
