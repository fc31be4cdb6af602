"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from ._inputs import LEVEL_CAMERA_R_NC, Trial
from ._params import (
    DEFAULT,
    PARAMSETS,
    SOLVERS,
    CostParams,
    GaussNewtonParams,
    ImplicitAdamParams,
    Params,
    ViewParams,
    params_of,
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
    "DEFAULT",
    "LEVEL_CAMERA_QUAT_WXYZ",
    "LEVEL_CAMERA_R_NC",
    "PARAMSETS",
    "SOLVERS",
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
    "fit_session",
    "fit_sessions",
    "paper_objective",
    "params_of",
]
