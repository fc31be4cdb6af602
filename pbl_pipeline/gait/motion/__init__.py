"""Motion of a trial: poses of the fitted body, the legs' joints, the feet and the heading."""

from ._feet import (
    FOOT_MARKER_SETS,
    MIN_TRAVEL_M_PER_S,
    FootTrajectories,
    check_feet,
    feet_from_fit,
    feet_from_keypoints,
    feet_from_markers,
    feet_from_poses,
    heading_agreement,
    heading_from_hips,
)
from ._legs import LEG_JOINTS, BodyPoses, poses_of, trial_poses
