"""Result of fitting the body of a visit, without the movements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pbl_pipeline.records import column, record, stored


@record
class Solution:
    """Result of fitting the body of a visit, without the movements."""

    solver: str = column("solver", type="varchar(32)")
    params_hash: str
    iterations: int | None = column(
        "fit_iterations", "steps of the solver, null for fits of before it was recorded", "int32"
    )
    converged: bool | None = column(
        "fit_converged", "ended at a minimum, not at its bound on iterations or steps; null too", "bool"
    )
    #: (8,) multipliers of `body.SCALE_NAMES`.
    scale: np.ndarray = column(
        "fit_scale", "multiplier (-) of each scale group, 1 = the unscaled body", "json", digits=5
    )
    loss_trace: np.ndarray  # (K, 2) step, loss
    seconds: float
    compile_seconds: float = column("compile_seconds", "(s) of the duration, spent compiling")
    device: str = column("compute_device", "what JAX computed on", "varchar(64)")
    software: str = ""  # version and commit of the code

    @property
    @stored("fit_loss", "(-) total loss at the end", before="iterations")
    def loss(self) -> float:
        """Total loss at the end."""
        return float(self.loss_trace[-1, 1])


@record
class Residuals:
    """Medians over frames and points, None where nothing was seen."""

    px: float | None = column("{}_residual_2d", "(px) median distance of body and keypoints in the picture")
    cm: float | None = column("{}_residual_3d", "(cm) median distance of body and 3D keypoints")

    @classmethod
    def of(cls, trials: Sequence[Any]) -> Residuals:
        """Return the residuals of fitted trials (`TrialFit`) together."""
        px, m = (np.concatenate([getattr(t, n).ravel() for t in trials]) for n in ("residual_2d_px", "residual_3d_m"))
        return cls(*(float(np.median(s)) if len(s := v[np.isfinite(v)]) else None for v in (px, 100 * m)))
