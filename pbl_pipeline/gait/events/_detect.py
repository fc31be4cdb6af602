"""Detection of foot down and foot up by a named method."""

from __future__ import annotations

from typing import Any

from pbl_pipeline.gait.motion import FootTrajectories

from ._coordinates import detect_by_coordinates
from ._foot_velocity import FootVelocityParams, detect_by_foot_velocity
from ._methods import resolve_params
from ._phase import PhaseParams, detect_by_phase
from ._types import EventParams, GaitEvents

#: How the parameters of each class are used.
_BY_PARAMS = {
    EventParams: detect_by_coordinates,
    FootVelocityParams: detect_by_foot_velocity,
    PhaseParams: detect_by_phase,
}


def detect_events(feet: FootTrajectories, params: Any = None) -> GaitEvents:
    """Foot down and foot up of both sides in order of time, in bouts of walking.

    Parameters
    ----------
    feet
        Trajectories with NaN where the person is not seen. Long gaps split the trial.
    params
        Name of a method (`EVENT_PARAMSETS`), a `Paramset`, or a method's own parameters; None for the default.

    Returns
    -------
    GaitEvents
        Status PASS, or EMPTY with a reason where nobody walks (standing, sit-to-stand, too short in view).

    Raises
    ------
    PblError
        GAIT_INPUT where no frame holds what the method needs, or the legs are upside down or mirrored;
        SOLVER_UNKNOWN for an unknown name; ASSET_MISSING where the event model's weights are not there.
    """
    paramset = resolve_params(params)
    for kind, detect in _BY_PARAMS.items():
        if set(paramset.params) == set(kind.__dataclass_fields__):
            return detect(feet, paramset)
    raise TypeError(f"{paramset.name}: parameters {sorted(paramset.params)} are of no method")
