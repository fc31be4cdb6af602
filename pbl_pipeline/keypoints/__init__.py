"""Keypoints of the tracked person from any detector, views of several cameras, and markers of a laboratory."""

from .blazepose import BlazePoseLandmarks
from .detect import detect_keypoints
from .in_view import (
    SEEN_SHARE,
    Gap,
    Visibility,
    blind_runs,
    bridge_gaps,
    longest_run_s,
    unoriented_frames,
    visibility,
    whole_person_in_view,
)
from .marker_augmenter import AnatomicalMarkers, AugmenterParams, MarkerAugmenter
from .methods import METHODS
from .multi_view import MOST_MISS_M, MultiView, cameras_of_files, check_same_times, check_views_agree, ray_miss_m
from .onnx_keypoints import ModelKeypointParams, ModelParams, OnnxKeypoints
from .picture import Picture, PictureMeter
from .protocol import KeypointDetector, KeypointParams
from .quality_checks import (
    BOUND_TRUNK,
    ConfidenceCurve,
    check_keypoints,
    confidence_curve,
    confidence_curves,
    confidence_text,
    probability_within,
    side_changes,
)
from .types import Keypoints, PersonKeypoints, log_shift_s
from .virtual_camera import view_rotation
from .world_markers import WorldMarkers, read_trc
