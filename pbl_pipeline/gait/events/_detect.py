"""Detection of initial contact and toe-off by a named method."""

from __future__ import annotations

from typing import Any

from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.results.events import GaitEvents

from .methods import METHODS


def detect_events(feet: FootTrajectories, params: Any = None) -> GaitEvents:
    """Initial contact and toe-off of both sides in order of time, in bouts of walking.

    Raises `PblError` GAIT_INPUT if no frame has the method's input, or the legs are upside down or mirrored;
    SOLVER_UNKNOWN for an unknown method; ASSET_MISSING if the event model's weights are missing.

    The status is PASS, or EMPTY with a reason without walking (standing, sit-to-stand, too short in view).

    Parameters
    ----------
    feet
        Trajectories with NaN where the person is not seen. Long gaps split the trial.
    params
        What `METHODS.find` takes: name of a method, a `Paramset`, or a method's own parameters; None for the default.
    """
    method = METHODS.find(params)
    return method.function(feet, method)
