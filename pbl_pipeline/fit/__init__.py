"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from ._default import default_for_points, default_method
from ._inputs import LEVEL_CAMERA_R_NC, Trial
from ._params import (
    METHODS,
    CostParams,
    GaussNewtonParams,
    ImplicitAdamParams,
    Params,
    ViewParams,
)
from ._session import (
    LEVEL_CAMERA_QUAT_WXYZ,
    SessionInput,
    check_trial,
    fit_session,
    fit_sessions,
    paper_objective,
)
from ._types import SessionFit, TrialFit

__all__ = [
    "LEVEL_CAMERA_QUAT_WXYZ",
    "LEVEL_CAMERA_R_NC",
    "METHODS",
    "CostParams",
    "GaussNewtonParams",
    "ImplicitAdamParams",
    "Params",
    "SessionFit",
    "SessionInput",
    "Trial",
    "TrialFit",
    "ViewParams",
    "check_trial",
    "default_for_points",
    "default_method",
    "fit_session",
    "fit_sessions",
    "paper_objective",
]
