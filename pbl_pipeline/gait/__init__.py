"""Gait: feet, events, cycles, spatiotemporal measures and the Gait Deviation Index of three angles.

Each step is a function of its own with a frozen result: `feet_from_fit` or `feet_from_keypoints`, `detect_events`,
`find_cycles`, `spatiotemporal`, `score_gdi`; `gait_metrics` runs them for a session.
"""

from ._angles import ANGLE_NAMES, AngleSeries, angle_series, pelvis_angles
from ._cycles import REPORT_PERCENT, GaitCycle, cycle_curves, find_cycles
from ._feet import FOOT_MARKER_SETS, FootTrajectories, feet_from_fit, feet_from_keypoints, feet_from_markers
from ._gdi import GDI_MODEL, GDI_PARAMSETS, Gdi, GdiCycle, GdiParams, gdi_vector, score_gdi
from ._metrics import GaitMetrics, GaitParams, TrialMetrics, cycle_checks, gait_metrics
from ._poses import BodyPoses, trial_poses
from ._spatiotemporal import MEASURES, Measure, Spatiotemporal, spatiotemporal
from .events import (
    DEFAULT_EVENT_PARAMSET,
    EVENT_PARAMSETS,
    EventParams,
    GaitEvent,
    GaitEvents,
    detect_events,
    load_events,
)
from .normative import DEFAULT_NORM, NormativeSet, fit_norm, load_norm, norm_names

__all__ = [
    "ANGLE_NAMES",
    "DEFAULT_EVENT_PARAMSET",
    "DEFAULT_NORM",
    "EVENT_PARAMSETS",
    "FOOT_MARKER_SETS",
    "GDI_MODEL",
    "GDI_PARAMSETS",
    "MEASURES",
    "REPORT_PERCENT",
    "AngleSeries",
    "BodyPoses",
    "EventParams",
    "FootTrajectories",
    "GaitCycle",
    "GaitEvent",
    "GaitEvents",
    "GaitMetrics",
    "GaitParams",
    "Gdi",
    "GdiCycle",
    "GdiParams",
    "Measure",
    "NormativeSet",
    "Spatiotemporal",
    "TrialMetrics",
    "angle_series",
    "cycle_checks",
    "cycle_curves",
    "detect_events",
    "feet_from_fit",
    "feet_from_keypoints",
    "feet_from_markers",
    "find_cycles",
    "fit_norm",
    "gait_metrics",
    "gdi_vector",
    "load_events",
    "load_norm",
    "norm_names",
    "pelvis_angles",
    "score_gdi",
    "spatiotemporal",
    "trial_poses",
]
