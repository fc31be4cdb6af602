"""What a report shows beside its visit."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Picture:
    """One frame with the fitted body drawn over it, as `render.overlay_frames` gives it: (H, W, 3) uint8 BGR."""

    index: int
    time_s: float
    image: np.ndarray
