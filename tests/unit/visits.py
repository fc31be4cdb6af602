"""How a body was fitted, for the visits of tests whose fits no solver made."""

from typing import Any

import numpy as np

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.visit import Solution


def solution_of(fit: TrialFit, **changes: Any) -> Solution:
    """Return a solution with the solver, parameters and scale of this fit."""
    of_fit = {"solver": fit.solver, "params_hash": fit.params_hash, "scale": np.asarray(fit.scale)}
    how = {"iterations": 7, "converged": True, "loss_trace": np.array([[0.0, 99.0], [100.0, 9.0]])}
    when = {"seconds": 31.2, "compile_seconds": 12.0, "device": "cpu", "software": "0.1.0+gabc"}
    return Solution(**of_fit | how | when | changes)
