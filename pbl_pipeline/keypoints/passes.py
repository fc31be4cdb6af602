"""Two passes over the frames in one reading of the video, distributed over the cores.

The second pass over a frame needs what the first found up to `reach_s` later, so the frames of that time wait in memory
(not converted, 3 MB each at 1080p) and the video is decoded once. Decoding, converting and the network all release
Python's lock, so they run in parallel: one detector per core, each with one thread, is faster than one detector with
several.
"""

from __future__ import annotations

import collections
import queue
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Thread
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.video import Camera, Frame

from .crops import Regions
from .protocol import CropDetector, Inspection, KeypointDetector, MirrorDetector
from .types import PersonKeypoints

_Item = tuple[Frame, np.ndarray, bool, "Future[PersonKeypoints]"]


@runtime_checkable
class BatchDetector(Protocol):
    """A `KeypointDetector` that is fastest with up to `batch` frames at once."""

    batch: int

    def detect_many(
        self, images: Sequence[np.ndarray], rois_px: Sequence[np.ndarray], camera: Camera, *, quick: bool = False
    ) -> list[PersonKeypoints]: ...


class BatchedInference:
    """One detector in one thread, with batches of frames. A context manager: leaving it cancels waiting frames."""

    def __init__(self, detector: BatchDetector, camera: Camera) -> None:
        self._detector, self._camera = detector, camera
        self._waiting: queue.Queue[_Item | None] = queue.Queue()
        self._closed = False
        self._thread = Thread(target=self._work, name="keypoints", daemon=True)
        self._thread.start()
        #: Frames are submitted as if to so many detectors, so that batches fill.
        self.n_detectors = detector.batch

    def __enter__(self) -> BatchedInference:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._waiting.put(None)
        self._thread.join()

    def submit(self, frame: Frame, roi_px: np.ndarray, inspection: Inspection) -> Future[PersonKeypoints]:
        """Detect in the region `roi_px` (4,) of a frame, in the order of the calls."""
        future: Future[PersonKeypoints] = Future()
        self._waiting.put((frame, np.array(roi_px, np.float64), inspection is Inspection.QUICK, future))
        return future

    def _work(self) -> None:
        kept: _Item | None = None
        while True:
            first = kept or self._waiting.get()
            kept = None
            if first is None or self._closed:
                return
            batch = [first]
            while len(batch) < self._detector.batch:
                try:
                    following = self._waiting.get_nowait()
                except queue.Empty:
                    break
                if following is None:
                    self._waiting.put(None)
                    break
                if following[2] != first[2]:
                    kept = following
                    break
                batch.append(following)
            self._detect(batch)

    def _detect(self, batch: list[_Item]) -> None:
        try:
            images, rois = [i[0].image for i in batch], [i[1] for i in batch]
            found = self._detector.detect_many(images, rois, self._camera, quick=batch[0][2])
        except BaseException as error:  # noqa: BLE001 - raised again by `Future.result`
            for item in batch:
                item[3].set_exception(error)
            return
        for item, person in zip(batch, found, strict=True):
            item[3].set_result(person)


class Inference(Protocol):
    """Runs detectors: `ParallelInference`, or `BatchedInference` for a detector of many frames at once."""

    n_detectors: int

    def submit(self, frame: Frame, roi_px: np.ndarray, inspection: Inspection) -> Future[PersonKeypoints]: ...


class ParallelInference:
    """Detectors in threads, one in each. A context manager: leaving it cancels frames that are waiting."""

    def __init__(self, detectors: Sequence[KeypointDetector], camera: Camera) -> None:
        self._idle: queue.SimpleQueue[Any] = queue.SimpleQueue()
        for detector in detectors:
            self._idle.put(detector)
        self._camera = camera
        # Once, as checking a protocol's members takes as long as cutting a crop.
        self._by_crop, self._mirrors = (isinstance(detectors[0], kind) for kind in (CropDetector, MirrorDetector))
        self._pool = ThreadPoolExecutor(len(detectors), "keypoints")
        self.n_detectors = len(detectors)

    def __enter__(self) -> ParallelInference:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def submit(self, frame: Frame, roi_px: np.ndarray, inspection: Inspection) -> Future[PersonKeypoints]:
        """Detect in the region `roi_px` (4,) of a frame as soon as a detector is idle, in the order of the calls."""
        return self._pool.submit(self._detect, frame, roi_px, inspection)

    def _detect(self, frame: Frame, roi_px: np.ndarray, inspection: Inspection) -> PersonKeypoints:
        detector, quick = self._idle.get(), inspection is Inspection.QUICK
        try:
            if not self._by_crop:
                return detector.detect(frame.image, roi_px, self._camera, quick=quick)
            crop = frame.cut(*detector.crop_of(roi_px))
            if self._mirrors and inspection in (Inspection.PLAIN, Inspection.MIRRORED):
                return detector.detect_once(crop, roi_px, self._camera, mirrored=inspection is Inspection.MIRRORED)
            return detector.detect_crop(crop, roi_px, self._camera, quick=quick)
        finally:
            self._idle.put(detector)


def two_passes(
    frames: Iterable[Frame],
    inference: Inference,
    time_s: np.ndarray,
    regions: Regions,
    inspection: Callable[[int], Inspection] = lambda _: Inspection.FULL,
) -> Iterator[tuple[int, PersonKeypoints]]:
    """Yield the index of each frame, in order, with the keypoints that the second pass found.

    `frames` are those with the person, of the video with stamps `time_s` (T,). The first pass is over those of
    `regions.first`; the second inspects a frame once all results of the first up to `regions.reach_s` later are known.
    `inspection`: that of a frame in the second pass.
    """
    last_needed = np.searchsorted(time_s, time_s + regions.reach_s, side="right") - 1
    waiting: collections.deque[Frame] = collections.deque()
    early: collections.deque[tuple[int, Future[PersonKeypoints]]] = collections.deque()
    late: collections.deque[tuple[int, Future[PersonKeypoints]]] = collections.deque()

    def second(frame: Frame) -> None:
        while early and early[0][0] <= last_needed[frame.index]:
            index, future = early.popleft()
            regions.correct(index, future.result())
        late.append((frame.index, inference.submit(frame, regions.at(frame.index), inspection(frame.index))))

    for frame in frames:
        waiting.append(frame)
        if frame.index in regions.first:
            early.append((frame.index, inference.submit(frame, regions.track_px[frame.index], Inspection.QUICK)))
        while waiting and last_needed[waiting[0].index] <= frame.index:
            second(waiting.popleft())
        # Just enough frames that no detector waits, as each is held in memory.
        while len(late) > 2 * inference.n_detectors:
            index, future = late.popleft()
            yield index, future.result()
    while waiting:
        second(waiting.popleft())
    while late:
        index, future = late.popleft()
        yield index, future.result()
