"""The cases of `pbl bench fit`. Imports nothing heavy: the parent process stays small and off the GPU."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

#: Measured unless another is named: the method for the points of the benchmark.
METHOD = "gauss-newton"
MARKER_SET = "bml_movi_87"
FPS = 30.0


@dataclasses.dataclass(frozen=True)
class Data:
    """Simulated data: `n_sessions` people, each with `n_trials` walks of `n_frames` frames at 30 Hz."""

    n_trials: int = 1
    n_sessions: int = 3
    n_frames: int = 300

    @property
    def key(self) -> str:
        """A name for the folder of these data."""
        return hashlib.sha256(json.dumps(dataclasses.asdict(self), sort_keys=True).encode()).hexdigest()[:12]


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: a fit method on some data."""

    method: str  # name of a fit method, or path of a JSON file of one
    data: Data
    batch: int = 1  # sessions fitted at once; 1: one by one
    repeat: int = 3  # warm runs of the first call
    camera_motion: str = "static"

    @property
    def label(self) -> str:
        """The case in words."""
        data = self.data
        parts = [Path(self.method).stem, f"{data.n_trials} trial{'s' * (data.n_trials > 1)} x {data.n_frames} frames"]
        return ", ".join([*parts, self.camera_motion, *[f"batch {self.batch}"] * (self.batch > 1)])


def fit_cases(method: str, trials: Sequence[int], batches: Sequence[int], n_people: int, repeat: int) -> list[Case]:
    """Return a case for each number of trials and each size of a batch."""
    return [Case(method, Data(n, batch if batch > 1 else n_people), batch, repeat) for n in trials for batch in batches]
