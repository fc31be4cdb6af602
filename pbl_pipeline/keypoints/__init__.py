"""Keypoints of the tracked person, behind one protocol for every detector."""

from ._blazepose import BlazePoseLandmarks
from ._detect import DEFAULT, DETECTORS, PARAMSETS, KeypointParams, detect_keypoints
from ._protocol import KeypointDetector, PersonKeypoints
from ._quality import check_keypoints, side_changes
from ._types import Keypoints
from ._view import view_rotation

__all__ = [
    "DEFAULT",
    "DETECTORS",
    "PARAMSETS",
    "BlazePoseLandmarks",
    "KeypointDetector",
    "KeypointParams",
    "Keypoints",
    "PersonKeypoints",
    "check_keypoints",
    "detect_keypoints",
    "side_changes",
    "view_rotation",
]
