"""Gait: feet, events, cycles, spatiotemporal measures and the Gait Deviation Index, of three angles or nine.

Each step is a function of its own with a frozen result: `feet_from_fit` or `feet_from_keypoints`, `detect_events`,
`find_cycles`, `spatiotemporal`, `score_gdi`; `gait_metrics` runs them for a session.
"""

from ._angles import ANGLE_NAMES, LEG_ANGLES, AngleSeries, angle_series, leg_angles, leg_angles_sd, pelvis_angles
from ._bands import NormalBands, leg_length_m, normal_bands
from ._camera_side import camera_side, mostly
from ._condition import ACTIVITIES, ANY_PACE, PACES, SELF_SELECTED, UNKNOWN, Condition
from ._curve_frame import CURVE_FRAME_COLUMNS, curve_frame
from ._cycles import REPORT_PERCENT, cycle_curves, find_cycles
from ._exclusion import Exclusion
from ._gdi import (
    GDI_METHODS,
    GDI_MODEL,
    GILLETTE_MODEL,
    MODEL_ANGLES,
    Z90,
    Gdi,
    GdiCycle,
    GdiParams,
    gdi_vector,
    interval_90,
    score_gdi,
)
from ._own_norm import norm_from_cycles
from ._profile import MovementProfile, movement_profile, variable_scores
from .cycle_measures import MEASURES, Measure, Spatiotemporal, cycle_measures, far_leg_of, spatiotemporal
from .events import METHODS as EVENT_METHODS
from .events import (
    EventParams,
    GaitEvent,
    GaitEvents,
    apply_correction,
    check_correction,
    detect_events,
    load_events,
)
from .ground import cycle_lengths
from .laboratory import PLUG_IN_GAIT_POINTS, LabTrial, read_lab_feet, read_lab_trial
from .metrics import (
    GaitMetrics,
    GaitParams,
    SessionMetrics,
    TrialCycles,
    TrialMetrics,
    cycle_checks,
    gait_metrics,
    pool_trials,
)
from .motion import (
    FOOT_MARKER_SETS,
    BodyPoses,
    FootTrajectories,
    feet_from_fit,
    feet_from_keypoints,
    feet_from_markers,
    trial_poses,
)
from .normative import (
    ANGLE_MODELS,
    BODY_ANGLES,
    DEFAULT_NORM,
    NINE_ANGLES,
    PLUG_IN_GAIT,
    THREE_ANGLES,
    NormativeSet,
    fit_norm,
    load_norm,
    norm_names,
    offset_deg,
)
from .types import GaitCycle, Lengths

__all__ = [
    "ACTIVITIES",
    "ANGLE_MODELS",
    "ANGLE_NAMES",
    "ANY_PACE",
    "BODY_ANGLES",
    "CURVE_FRAME_COLUMNS",
    "DEFAULT_NORM",
    "EVENT_METHODS",
    "FOOT_MARKER_SETS",
    "GDI_METHODS",
    "GDI_MODEL",
    "GILLETTE_MODEL",
    "LEG_ANGLES",
    "MEASURES",
    "MODEL_ANGLES",
    "NINE_ANGLES",
    "PACES",
    "PLUG_IN_GAIT",
    "PLUG_IN_GAIT_POINTS",
    "REPORT_PERCENT",
    "SELF_SELECTED",
    "THREE_ANGLES",
    "UNKNOWN",
    "Z90",
    "AngleSeries",
    "BodyPoses",
    "Condition",
    "EventParams",
    "Exclusion",
    "FootTrajectories",
    "GaitCycle",
    "GaitEvent",
    "GaitEvents",
    "GaitMetrics",
    "GaitParams",
    "Gdi",
    "GdiCycle",
    "GdiParams",
    "LabTrial",
    "Lengths",
    "Measure",
    "MovementProfile",
    "NormalBands",
    "NormativeSet",
    "SessionMetrics",
    "Spatiotemporal",
    "TrialCycles",
    "TrialMetrics",
    "angle_series",
    "apply_correction",
    "camera_side",
    "check_correction",
    "curve_frame",
    "cycle_checks",
    "cycle_curves",
    "cycle_lengths",
    "cycle_measures",
    "detect_events",
    "far_leg_of",
    "feet_from_fit",
    "feet_from_keypoints",
    "feet_from_markers",
    "find_cycles",
    "fit_norm",
    "gait_metrics",
    "gdi_vector",
    "interval_90",
    "leg_angles",
    "leg_angles_sd",
    "leg_length_m",
    "load_events",
    "load_norm",
    "mostly",
    "movement_profile",
    "norm_from_cycles",
    "norm_names",
    "normal_bands",
    "offset_deg",
    "pelvis_angles",
    "pool_trials",
    "read_lab_feet",
    "read_lab_trial",
    "score_gdi",
    "spatiotemporal",
    "trial_poses",
    "variable_scores",
]
