"""Gait: feet, events, cycles, spatiotemporal measures and the Gait Deviation Index, of three angles or nine.

Each step is a function with a frozen result: `feet_from_fit` or `feet_from_keypoints`, `detect_events`, `find_cycles`,
`spatiotemporal`, `score_gdi`; `gait_metrics` runs them for a session.
"""

from pbl_pipeline.results.cycles import BODY_ANGLES, Exclusion, GaitCycle, Lengths
from pbl_pipeline.results.events import GaitEvent, GaitEvents
from pbl_pipeline.results.index import GDI_MODEL, GILLETTE_MODEL, NUMBERS, PAPER_INDEX, Gdi, GdiCycle
from pbl_pipeline.results.measures import Z90, Measure, interval_90

from ._angles import ANGLE_NAMES, LEG_ANGLES, AngleSeries, angle_series, leg_angles, leg_angles_sd, pelvis_angles
from ._bands import CURVE_FRAME_COLUMNS, AdultRanges, NormalBands, adult_ranges, curve_frame, leg_length_m, normal_bands
from ._cycles import REPORT_PERCENT, cycle_curves, find_cycles, refused_cadence, with_cadence_accepted
from ._gdi import (
    GDI_METHODS,
    MODEL_ANGLES,
    GdiParams,
    intervals_with_one_more,
    passes_of,
    score_gdi,
    worth_of_one_more,
)
from ._own_norm import norm_from_cycles
from .cycle_measures import (
    MEASURES,
    SIDED,
    Spatiotemporal,
    camera_side,
    cycle_measures,
    far_leg_of,
    mostly,
    spatiotemporal,
)
from .events import METHODS as EVENT_METHODS
from .events import EventParams, apply_correction, check_correction, detect_events, load_events
from .ground import cycle_lengths
from .laboratory import PLUG_IN_GAIT_POINTS, LabTrial, read_lab_feet, read_lab_trial
from .measurement import IMPORTANT_CHANGE, MEASURES_REMAIN, REMAINS, Chances, chances, change_sd
from .metrics import (
    GaitMetrics,
    GaitParams,
    SessionMetrics,
    TrialCycles,
    TrialMetrics,
    cycle_checks,
    gait_metrics,
    legs_check,
    pool_trials,
)
from .motion import (
    BodyPoses,
    FootTrajectories,
    check_feet,
    feet_from_fit,
    feet_from_keypoints,
    feet_from_markers,
    trial_poses,
)
from .normative import (
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
from .opensim import OpenSimMotion, read_motion, read_motion_feet, read_motion_trial
from .tasks import TASK_MEASURES, TRIAL_MEASURES, TaskMotion, task_measure, task_measures, task_motion
from .types import (
    ACTIVITIES,
    ANY_PACE,
    PACES,
    SELF_SELECTED,
    UNKNOWN,
    Condition,
    MovementProfile,
    movement_profile,
    variable_scores,
)
