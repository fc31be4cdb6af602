"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from .keypoint_files import RecordingFacts, read_keypoints
from .marker_files import MarkerFile, read_markers
from .method_choice import Points, default_fit, points_of, unsuited
from .methods import METHODS
from .params import (
    CostParams,
    GaussNewtonParams,
    ImplicitAdamParams,
    Params,
    ViewParams,
)
from .results import SessionFit, TrialFit
from .session import Trial
from .session_fit import (
    SessionInput,
    check_trial,
    fit_session,
    fit_sessions,
)
from .world_checks import in_upright_world
