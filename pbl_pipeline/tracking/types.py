"""Detections, tracks and the choice of the subject."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from pbl_pipeline.files import check_numbers, load_npz
from pbl_pipeline.results.people import PersonTrack
from pbl_pipeline.video import Frame


@dataclasses.dataclass(frozen=True)
class Detection:
    """One person in one frame."""

    box_px: np.ndarray  # (4,) x0, y0, x1, y1 in pixels of the upright frame
    score: float  # 0 to 1
    # (4,) region of interest for keypoints: centre x, centre y and side in px, and rotation in rad (clockwise in the
    # picture, 0 for upright); NaN if the detector does not return it.
    roi_px: np.ndarray
    appearance: np.ndarray | None = None  # `appearance_of`, None if not computed


#: A frame in tracking: regions of its planes, or the whole picture (H, W, 3) uint8 BGR.
Scene = Frame | np.ndarray


class PersonDetector(Protocol):
    """Finds people in one upright BGR frame. Implementations hold a loaded model and are not shared by threads."""

    name: str
    model_sha256: str

    def detect(self, image: np.ndarray) -> list[Detection]: ...


@runtime_checkable
class WindowDetector(PersonDetector, Protocol):
    """A `PersonDetector` whose windows are squares of `window_px` pixels a side, cut from the decoder's planes; those
    of others are parts of the converted picture."""

    window_px: int


@dataclasses.dataclass(frozen=True)
class Tracking:
    """All people in the video: `time_s` (T,), persons numbered from 1 in order of appearance."""

    time_s: np.ndarray
    image_size_px: tuple[int, int]
    persons: tuple[PersonTrack, ...]
    detector: str
    model_sha256: str

    def save(self, path: Path) -> None:
        """Write time stamps and tracks to one npz, float32 but for the time stamps."""
        n, t, tracks = len(self.persons), len(self.time_s), dict[str, np.ndarray]()
        for name, rest in _TRACK.items():
            rows = [getattr(p, name) for p in self.persons]
            tracks[name] = np.asarray(rows, bool if name == "observed" else np.float32).reshape(n, t, *rest)
        ids = np.asarray([p.person_id for p in self.persons], np.int16)
        arrays = {"time_s": np.asarray(self.time_s, np.float64), "person_id": ids, **tracks}
        np.savez_compressed(path, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path, image_size_px: tuple[int, int], detector: str, model_sha256: str) -> Tracking:
        """Read what `save` wrote; the other fields are not in the file. Raises `PblError` FILE_FORMAT."""
        data = load_npz(path, needed=("time_s", "person_id", *_TRACK))
        n, t = data["person_id"].size, data["time_s"].size
        shapes = {"time_s": (t,), "person_id": (n,), **{name: (n, t, *rest) for name, rest in _TRACK.items()}}
        check_numbers(path, data, shapes)
        tracks = zip(*(data[name] for name in _TRACK), strict=True)
        persons = tuple(PersonTrack(int(p), *own) for p, own in zip(data["person_id"], tracks, strict=True))
        return cls(data["time_s"], image_size_px, persons, detector, model_sha256)


#: Arrays of a `PersonTrack` -> their shape in a frame.
_TRACK: dict[str, tuple[int, ...]] = {"box_px": (4,), "roi_px": (4,), "score": (), "observed": ()}
