"""Inference by a detector that takes several frames in one call: what waits goes together, up to its batch."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from concurrent.futures import Future
from threading import Thread
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.video import Camera, Frame

from .protocol import Inspection
from .types import PersonKeypoints

_Item = tuple[Frame, np.ndarray, bool, "Future[PersonKeypoints]"]


@runtime_checkable
class BatchDetector(Protocol):
    """A `KeypointDetector` that is best given up to `batch` frames at once."""

    batch: int

    def detect_many(
        self, images: Sequence[np.ndarray], rois_px: Sequence[np.ndarray], camera: Camera, *, quick: bool = False
    ) -> list[PersonKeypoints]: ...


class BatchedInference:
    """As `ParallelInference`, with one detector in one thread. As a context: leaving it drops what has not begun."""

    def __init__(self, detector: BatchDetector, camera: Camera) -> None:
        self._detector, self._camera = detector, camera
        self._waiting: queue.Queue[_Item | None] = queue.Queue()
        self._closed = False
        self._thread = Thread(target=self._work, name="keypoints", daemon=True)
        self._thread.start()
        #: As many frames are kept under way as if there were so many detectors, so that batches fill.
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
        except BaseException as error:  # noqa: BLE001 - handed to whoever asks for the result
            for item in batch:
                item[3].set_exception(error)
            return
        for item, person in zip(batch, found, strict=True):
            item[3].set_result(person)
