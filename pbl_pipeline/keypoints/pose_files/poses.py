"""Keypoints of all people in one recording, as another program wrote them."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np

from pbl_pipeline.bounded import MAX_ROWS
from pbl_pipeline.errors import PblError

bad_file = functools.partial(
    PblError, "FILE_FORMAT", next_step="see docs/models.md, section 2D keypoints of other programs"
)
#: No pixel is further from the picture's corner.
_FURTHEST_PX = 1e6


@dataclasses.dataclass(frozen=True)
class Poses:
    """P people, T frames, J points. Missing points become NaN with confidence 0, also those that come with a confidence
    of 0 or less; a point without a confidence has 1."""

    program: str
    frame: np.ndarray  # (T,) number of each frame in its recording, the first one 0; increasing by one step
    people: tuple[str, ...]
    names: tuple[str, ...]
    xy_px: np.ndarray  # (P, T, J, 2) x right, y down, of the picture that the program saw
    confidence: np.ndarray  # (P, T, J) 0..1
    rate_hz: float = math.nan  # as the file states it

    def __post_init__(self) -> None:
        confidence = np.where(np.isnan(self.confidence), 1.0, np.clip(self.confidence, 0.0, 1.0))
        seen = np.all(np.abs(self.xy_px) < _FURTHEST_PX, axis=-1) & (confidence > 0)
        object.__setattr__(self, "xy_px", np.where(seen[..., None], self.xy_px, np.nan))
        object.__setattr__(self, "confidence", np.where(seen, confidence, 0.0))


def every_frame(numbers: np.ndarray, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    """All numbers from the first to the last by their common step, then `values` (N, ...) of the given, increasing
    numbers (N,) for each of them, NaN where there was none. Raises ValueError beyond `MAX_ROWS`."""
    step = max(int(np.gcd.reduce(np.diff(numbers))), 1) if len(numbers) > 1 else 1
    row = (numbers - numbers[0]) // step
    if row[-1] >= MAX_ROWS:
        raise ValueError(f"frames {numbers[0]} to {numbers[-1]}: more than {MAX_ROWS:,}")
    out = [np.full((row[-1] + 1, *v.shape[1:]), np.nan) for v in values]
    for o, v in zip(out, values, strict=True):
        o[row] = v
    return numbers[0] + step * np.arange(row[-1] + 1), *out
