"""BlazePose's landmark network: 33 body points in the picture and, in metres, around the middle of the hips.

Layout: Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose tracking", Grishchenko et al. 2022, "BlazePose
GHUM Holistic" for the metric points, and the graph configuration beside the model in the mediapipe 0.10.21 wheel.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from pbl_pipeline.tracking._blazepose import circle_roi
from pbl_pipeline.tracking._litert import LiteModel
from pbl_pipeline.video import Camera

from ._protocol import PersonKeypoints
from ._view import crop_matrix, view_rotation

MODEL_SHA256 = "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f"
INPUT_SIZE = 256
#: The crop is this much larger than the body circle.
CROP_MARGIN = 1.25
NAMES = (
    "nose",
    "left_eye_inner",
    "left_eye",
    "left_eye_outer",
    "right_eye_inner",
    "right_eye",
    "right_eye_outer",
    "left_ear",
    "right_ear",
    "mouth_left",
    "mouth_right",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_pinky",
    "right_pinky",
    "left_index",
    "right_index",
    "left_thumb",
    "right_thumb",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
    "left_heel",
    "right_heel",
    "left_foot_index",
    "right_foot_index",
)
N_POINTS = len(NAMES)
#: The network adds six points; the first two are the middle of the hips and a point of the body circle.
N_ALL = 39


class BlazePoseLandmarks:
    """`KeypointDetector` with BlazePose's 33 points, root-relative (origin between the hips).

    confidence = sigmoid(visibility logit) * sigmoid(presence logit): that the point is not hidden, and that it lies
    in the picture, as the network states them. presence = the network's own pose flag.
    """

    name = "blazepose"
    names = NAMES
    marker_set = "blazepose_33"
    root_relative = True

    def __init__(self, model_path: str | Path) -> None:
        self._model = LiteModel(model_path, MODEL_SHA256)
        self.model_sha256 = self._model.sha256

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera) -> PersonKeypoints:
        """See `KeypointDetector`. `image` (H, W, 3) uint8 BGR; what lies beyond it is black to the network."""
        roi = np.array([roi_px[0], roi_px[1], roi_px[2] * CROP_MARGIN, roi_px[3]], np.float64)
        to_picture = crop_matrix(roi, INPUT_SIZE)
        # warpAffine counts from pixel centres in the crop, the network from the crop's edge.
        warp = to_picture.copy()
        warp[:, 2] += 0.5 * (to_picture[:, 0] + to_picture[:, 1])
        crop = cv2.warpAffine(image, warp, (INPUT_SIZE, INPUT_SIZE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        output = self._model(crop[:, :, ::-1].astype(np.float32) / np.float32(255))
        points = output[N_ALL * 5].reshape(N_ALL, 5).astype(np.float64)
        xy = points[:, :2] @ to_picture[:, :2].T + to_picture[:, 2]
        world = output[N_ALL * 3].reshape(N_ALL, 3)[:N_POINTS].astype(np.float64)
        return PersonKeypoints(
            xy_px=xy[:N_POINTS],
            xyz_cam_m=world @ view_rotation(roi, camera).T,
            confidence=expit(points[:N_POINTS, 3]) * expit(points[:N_POINTS, 4]),
            presence=float(output[1].item()),
            roi_px=circle_roi(xy[N_POINTS], xy[N_POINTS + 1]),
        )
