"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from ._default import default_for_points, default_method, unsuited
from ._fit_session import (
    LEVEL_CAMERA_QUAT_WXYZ,
    SessionInput,
    check_trial,
    fit_session,
    fit_sessions,
)
from ._marker_files import MarkerFile, read_markers
from ._methods import METHODS
from ._params import (
    CostParams,
    GaussNewtonParams,
    ImplicitAdamParams,
    Params,
    ViewParams,
)
from .paper_objective import paper_objective
from .results import SessionFit, TrialFit
from .session import LEVEL_CAMERA_R_NC, Trial

__all__ = [
    "LEVEL_CAMERA_QUAT_WXYZ",
    "LEVEL_CAMERA_R_NC",
    "METHODS",
    "CostParams",
    "GaussNewtonParams",
    "ImplicitAdamParams",
    "MarkerFile",
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
    "read_markers",
    "unsuited",
]
