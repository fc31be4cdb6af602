"""Keypoints of the tracked person from any detector, views of several cameras, markers of a laboratory."""

from ._blazepose import BlazePoseLandmarks
from ._detect import DEFAULT, DETECTORS, PARAMSETS, KeypointParams, detect_keypoints
from ._methods import find_method, params_class, params_of
from ._multi_view import SAME_TIME_S, MultiView, cameras_of_files
from ._onnx_keypoints import ModelKeypointParams, ModelParams, OnnxKeypoints, method_of_model
from ._protocol import KeypointDetector, PersonKeypoints
from ._quality import check_keypoints, side_changes
from ._types import Keypoints
from ._view import view_rotation
from ._world_markers import WorldMarkers

__all__ = [
    "DEFAULT",
    "DETECTORS",
    "PARAMSETS",
    "SAME_TIME_S",
    "BlazePoseLandmarks",
    "KeypointDetector",
    "KeypointParams",
    "Keypoints",
    "ModelKeypointParams",
    "ModelParams",
    "MultiView",
    "OnnxKeypoints",
    "PersonKeypoints",
    "WorldMarkers",
    "cameras_of_files",
    "check_keypoints",
    "detect_keypoints",
    "find_method",
    "method_of_model",
    "params_class",
    "params_of",
    "side_changes",
    "view_rotation",
]
