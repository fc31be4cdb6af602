"""What every solver returns."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from .._outcome import Outcome


@dataclasses.dataclass(frozen=True)
class Solution:
    """A fitted session: F packed frames (padding included), V views, J markers (without padding), N trials.

    qpos in m and rad; R_nc: camera to world; s: the paper's scale parameters; scale: their multipliers; clock_s: sensor
    time minus video time of each trial, 0 where not estimated; loss_trace: (step, loss) of K steps; qpos_sd: standard
    deviations, None where the solver gives none; outcome: `_outcome.py`, None where it is yet to be computed.
    """

    qpos: Float[np.ndarray, "F 40"]
    R_nc: Float[np.ndarray, "F V 3 3"]
    s: Float[np.ndarray, " 8"]
    scale: Float[np.ndarray, " 8"]
    site_offset_m: Float[np.ndarray, "J 3"]
    clock_s: Float[np.ndarray, " N"]
    loss_trace: Float[np.ndarray, "K 2"]
    compile_seconds: float
    seconds: float
    iterations: int
    converged: bool
    qpos_sd: Float[np.ndarray, "F 40"] | None = None
    outcome: Outcome | None = None
