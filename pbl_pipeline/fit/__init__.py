"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from ._params import DEFAULT, PARAMSETS, CostParams, ImplicitAdamParams, ViewParams, params_of
from ._problem import LEVEL_CAMERA_R_NC
from ._session import LEVEL_CAMERA_QUAT_WXYZ, SOLVERS, check_trial, fit_session
from ._types import SessionFit, TrialFit

__all__ = [
    "DEFAULT",
    "LEVEL_CAMERA_QUAT_WXYZ",
    "LEVEL_CAMERA_R_NC",
    "PARAMSETS",
    "SOLVERS",
    "CostParams",
    "ImplicitAdamParams",
    "SessionFit",
    "TrialFit",
    "ViewParams",
    "check_trial",
    "fit_session",
    "params_of",
]
