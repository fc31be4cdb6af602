"""BlazePose's landmark networks, full and heavy: 33 body points in the picture and, in metres, around the mid-hip.

Layout: Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose tracking", Grishchenko et al. 2022, "BlazePose
GHUM Holistic" for the metric points, and the graph configuration beside the model in the mediapipe 0.10.21 wheel.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import expit

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError
from pbl_pipeline.models import LiteModel
from pbl_pipeline.tracking import circle_roi
from pbl_pipeline.video import Camera, cut_image

from ._flips import leg_points, mirror_of
from ._protocol import PersonKeypoints
from ._view import crop_matrix, view_rotation

if TYPE_CHECKING:
    from ._params import KeypointParams

#: The networks by their SHA-256: the asset that each is. They have the same inputs and outputs.
_NETWORKS = {assets.ASSETS[name].sha256: name for name in ("blazepose_landmarks", "blazepose_landmarks_heavy")}
MODEL_SHA256, HEAVY_SHA256 = _NETWORKS
INPUT_SIZE = 256
#: The crop is this much larger than the region of interest.
CROP_MARGIN = 1.25
NAMES: tuple[str, ...] = (
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
#: The network adds six points; the first two are the middle of the hips and a point of the region of interest.
N_ALL = 39
#: For each point of the mirrored picture, whose it is: left and right change places.
MIRROR = np.array(mirror_of(NAMES))
_OWN = np.arange(N_POINTS)
_GROUPS = (np.flatnonzero(leg_points(NAMES)), np.flatnonzero(~leg_points(NAMES)))
#: The answers for picture and mirror image are taken to have other sides where they lie apart by more than this
#: fraction of the crop, in the mean, and by less than half of that with the sides exchanged.
LEAST_APART, MOST_CROSSED = 0.04, 0.5
#: Factor of the confidence there.
UNDECIDED = 0.5


class BlazePoseLandmarks:
    """`KeypointDetector` with BlazePose's 33 points, root-relative (origin between the hips).

    The crop is shown twice, the second time mirrored, and the answers are averaged: the network's errors in the two are
    partly independent, and where it prefers one side of the body the mirrored answer prefers the other.

    confidence = sigmoid(visibility logit) * sigmoid(presence logit), the mean of both answers, times
    1 / (1 + exp((sigma - agree_mm) / agree_width_mm)); sigma is half the 3D distance in mm between the answers. The
    first two factors are the network's own statement (the point is not hidden; it lies in the picture), which stays
    near 1 where it takes one leg for the other; the last is small there. presence = the network's own pose flag.

    Where the two answers are one body with left and right exchanged, of the legs or of the rest, the second is renamed
    after the first (their mean would be a body without width) and the confidence of these points is halved: which of
    the two is right, the movement says (`exchange_sides`).
    """

    name = "blazepose"
    names: tuple[str, ...] = NAMES
    marker_set = "blazepose_33"
    root_relative = True

    #: One for each core: calls of one thread side by side are faster than one call of several threads.
    per_core = True

    def __init__(
        self,
        model_path: str | Path,
        agree_mm: float = 100.0,
        agree_width_mm: float = 20.0,
        num_threads: int = 1,
        sha256: str = MODEL_SHA256,
    ) -> None:
        self._model = LiteModel(model_path, sha256, (N_ALL * 5, N_ALL * 3, 1), num_threads)
        self.model_sha256 = self._model.sha256
        self._agree_mm, self._agree_width_mm = agree_mm, agree_width_mm

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False) -> PersonKeypoints:
        """See `KeypointDetector`. `image` (H, W, 3) uint8 BGR; what lies beyond it is black to the network."""
        return self.detect_crop(cut_image(image, *self.crop_of(roi_px)), roi_px, camera, quick=quick)

    def crop_of(self, roi_px: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
        """See `CropDetector`."""
        matrix = crop_matrix(_with_margin(roi_px), INPUT_SIZE)
        # A cut counts from pixel centres of the crop, the network from the crop's edge.
        matrix[:, 2] += 0.5 * (matrix[:, 0] + matrix[:, 1])
        return matrix, (INPUT_SIZE, INPUT_SIZE)

    def detect_crop(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False
    ) -> PersonKeypoints:
        """See `CropDetector`."""
        roi = _with_margin(roi_px)
        to_picture = crop_matrix(roi, INPUT_SIZE)
        crop = np.multiply(cv2.cvtColor(crop, cv2.COLOR_BGR2RGB), np.float32(1 / 255), dtype=np.float32)
        points, circle, world, confidence, presence = self._look(crop)
        if not quick:
            points_m, circle_m, world_m, confidence_m, presence_m = _mirrored(*self._look(crop[:, ::-1]))
            same = _same_sides(points, points_m)
            points_m, world_m, confidence_m = points_m[same], world_m[same], confidence_m[same]
            sigma_mm = 500.0 * np.linalg.norm(world - world_m, axis=1)
            agree = expit((self._agree_mm - sigma_mm) / self._agree_width_mm)
            points, circle, world = (points + points_m) / 2, (circle + circle_m) / 2, (world + world_m) / 2
            confidence, presence = (confidence + confidence_m) / 2 * agree, (presence + presence_m) / 2
            confidence = np.where(same == _OWN, confidence, confidence * UNDECIDED)
        circle_px = circle @ to_picture[:, :2].T + to_picture[:, 2]
        return PersonKeypoints(
            xy_px=points @ to_picture[:, :2].T + to_picture[:, 2],
            xyz_cam_m=world @ view_rotation(roi, camera).T,
            confidence=confidence,
            presence=presence,
            roi_px=circle_roi(*circle_px),
        )

    def _look(self, crop: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Points (33, 2) and the circle's centre and rim (2, 2) in crop pixels, world points (33, 3) m in the crop's
        axes, confidence (33,) and presence."""
        output = self._model(np.ascontiguousarray(crop))
        points = output[N_ALL * 5].reshape(N_ALL, 5).astype(np.float64)
        world = output[N_ALL * 3].reshape(N_ALL, 3)[:N_POINTS].astype(np.float64)
        confidence = expit(points[:N_POINTS, 3]) * expit(points[:N_POINTS, 4])
        return points[:N_POINTS, :2], points[N_POINTS : N_POINTS + 2, :2], world, confidence, float(output[1].item())


def _with_margin(roi_px: np.ndarray) -> np.ndarray:
    """The region that the network sees."""
    return np.array([roi_px[0], roi_px[1], roi_px[2] * CROP_MARGIN, roi_px[3]], np.float64)


def _same_sides(points: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(33,) which point of `other` to compare with each of `points` (33, 2 in crop pixels): itself, or that of the
    other side where the legs, or the rest of the body, lie clearly closer with left and right exchanged."""
    order = _OWN.copy()
    for group in _GROUPS:
        apart = np.linalg.norm(points[group] - other[group], axis=1).mean()
        crossed = np.linalg.norm(points[group] - other[MIRROR[group]], axis=1).mean()
        if apart > LEAST_APART * INPUT_SIZE and crossed < MOST_CROSSED * apart:
            order[group] = MIRROR[group]
    return order


def _mirrored(
    points: np.ndarray, circle: np.ndarray, world: np.ndarray, confidence: np.ndarray, presence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """What was seen in the mirrored crop, in terms of the crop itself."""
    flip, edge = np.array([-1.0, 1.0]), np.array([float(INPUT_SIZE), 0.0])
    turned = world[MIRROR] * np.array([-1.0, 1.0, 1.0])
    return points[MIRROR] * flip + edge, circle * flip + edge, turned, confidence[MIRROR], presence


def blazepose(params: KeypointParams) -> BlazePoseLandmarks:
    """The detector of the method, with the network that its parameters name by hash.

    Raises `PblError` SOLVER_UNKNOWN for another network, and those of `assets.fetch`.
    """
    sha256 = params.model_sha256
    if sha256 not in _NETWORKS:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"a BlazePose network with SHA-256 {sha256}",
            expected=f"one of {', '.join(f'{s} ({n})' for s, n in _NETWORKS.items())}",
            next_step="use the version of pbl-pipeline that the method was made with, or select another method",
        )
    path = assets.fetch(_NETWORKS[sha256])
    return BlazePoseLandmarks(path, params.agree_mm, params.agree_width_mm, sha256=sha256)
