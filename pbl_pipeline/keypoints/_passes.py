"""Two looks at each frame in one reading of the video, shared out to the cores.

The second look at a frame needs what the first found up to `reach_s` later, so the frames of that time wait in memory
(not converted, 3 MB each at 1080p) and the video is decoded once. Decoding, converting and the network all leave
Python's lock, so they run side by side: one detector per core, each with one thread, is faster than one detector with
several.
"""

from __future__ import annotations

import collections
import os
import queue
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

import numpy as np

from pbl_pipeline.video import Camera, Frame

from ._protocol import CropDetector, KeypointDetector, PersonKeypoints

#: More detectors than this bring little and cost memory.
_MAX_WORKERS = 8


def n_workers() -> int:
    """Detectors to run side by side: the cores this process may use, at most 8."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MAX_WORKERS)


class Looker(Protocol):
    """Whoever takes the looks: `Looks`, or one that gathers them for a detector that wants many at once."""

    n_detectors: int

    def at(self, frame: Frame, roi_px: np.ndarray, *, quick: bool) -> Future[PersonKeypoints]: ...


class Looks:
    """Detectors at work in threads, one in each. Use as a context: leaving it drops what has not begun."""

    def __init__(self, detectors: Sequence[KeypointDetector], camera: Camera) -> None:
        self._idle: queue.SimpleQueue[KeypointDetector] = queue.SimpleQueue()
        for detector in detectors:
            self._idle.put(detector)
        self._camera = camera
        self._pool = ThreadPoolExecutor(len(detectors), "keypoints")
        self.n_detectors = len(detectors)

    def __enter__(self) -> Looks:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def at(self, frame: Frame, roi_px: np.ndarray, *, quick: bool) -> Future[PersonKeypoints]:
        """Look at the region `roi_px` (4,) of a frame as soon as a detector is idle, in the order of the calls."""
        return self._pool.submit(self._look, frame, roi_px, quick)

    def _look(self, frame: Frame, roi_px: np.ndarray, quick: bool) -> PersonKeypoints:
        detector = self._idle.get()
        try:
            if isinstance(detector, CropDetector):
                crop = frame.cut(*detector.crop_of(roi_px))
                return detector.detect_crop(crop, roi_px, self._camera, quick=quick)
            return detector.detect(frame.image, roi_px, self._camera, quick=quick)
        finally:
            self._idle.put(detector)


def look_twice(
    frames: Iterable[Frame],
    looks: Looker,
    time_s: np.ndarray,
    reach_s: float,
    first: dict[int, np.ndarray],
    corrected: Callable[[int, PersonKeypoints], None],
    region: Callable[[int], np.ndarray],
) -> Iterator[tuple[int, PersonKeypoints]]:
    """What the second look saw, frame by frame in order.

    `frames` are the frames to be looked at, of the video with stamps `time_s` (T,). `first` has the regions of those
    that are looked at a first time: for each, `corrected(index, found)` is called. `region(index)` is the region of
    the second look, asked for once all first looks up to `reach_s` after that frame were given to `corrected`. Both
    are called from this thread, in the order of the frames.
    """
    last_needed = np.searchsorted(time_s, time_s + reach_s, side="right") - 1
    waiting: collections.deque[Frame] = collections.deque()
    early: collections.deque[tuple[int, Future[PersonKeypoints]]] = collections.deque()
    late: collections.deque[tuple[int, Future[PersonKeypoints]]] = collections.deque()

    def second(frame: Frame) -> None:
        while early and early[0][0] <= last_needed[frame.index]:
            index, future = early.popleft()
            corrected(index, future.result())
        late.append((frame.index, looks.at(frame, region(frame.index), quick=False)))

    for frame in frames:
        waiting.append(frame)
        if frame.index in first:
            early.append((frame.index, looks.at(frame, first[frame.index], quick=True)))
        while waiting and last_needed[waiting[0].index] <= frame.index:
            second(waiting.popleft())
        # So many looks may be under way that no detector waits, and no more: each holds its frame.
        while len(late) > 2 * looks.n_detectors:
            index, future = late.popleft()
            yield index, future.result()
    while waiting:
        second(waiting.popleft())
    while late:
        index, future = late.popleft()
        yield index, future.result()
