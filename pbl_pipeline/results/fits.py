"""Result of fitting the body of a visit, without the movements."""

from __future__ import annotations

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
