"""What every solver returns."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Solution:
    """qpos (N, T, 40) on the padded frames; scale (8,) multipliers; site_offset_m (J, 3); loss_trace (K, 2)."""

    qpos: np.ndarray
    scale: np.ndarray
    site_offset_m: np.ndarray
    loss_trace: np.ndarray
    compile_seconds: float
    seconds: float
