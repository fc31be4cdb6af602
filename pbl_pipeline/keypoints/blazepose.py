"""BlazePose's landmark networks, full and heavy: 33 body points in the picture and, in metres, around the mid-hip.

Layout: Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose tracking", Grishchenko et al. 2022, "BlazePose
GHUM Holistic" for the metric points, and the graph configuration beside the model in the mediapipe 0.10.21 wheel.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError
from pbl_pipeline.models import Network
from pbl_pipeline.models.heat_maps import SIDE
from pbl_pipeline.tracking import circle_roi
from pbl_pipeline.video import Camera, cut_image

from .flips import mirror_of
from .mirrored_inference import MirroredInference
from .protocol import MARKER_SET, MODEL_SHA256, ROOT_RELATIVE, KeypointParams
from .types import PersonKeypoints
from .virtual_camera import crop_matrix, view_rotation

HEAVY_SHA256 = assets.ASSETS["blazepose_landmarks_heavy"].sha256
#: The networks by their SHA-256: the asset that each is. They have the same inputs and outputs.
_NETWORKS = {MODEL_SHA256: "blazepose_landmarks", HEAVY_SHA256: "blazepose_landmarks_heavy"}
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
#: Sizes of the networks' outputs: points of the picture, of the world, and the presence of a person; and heat maps.
_OUTPUTS = (N_ALL * 5, N_ALL * 3, 1)
_MAPS = N_ALL * SIDE**2
#: Index of the same point in the mirrored picture: left and right are exchanged.
MIRROR = np.array(mirror_of(NAMES))


class BlazePoseLandmarks:
    """`KeypointDetector` with BlazePose's 33 points, root-relative (origin between the hips).

    The crop is shown twice, the second time mirrored, and `MirroredInference` combines the results; a quick inference
    is one of the network at `quick_path`, if given, without the mirror image. The network's confidence is
    sigmoid(visibility logit) * sigmoid(presence logit): the point is not hidden, and is in the picture. `presence` is
    the network's pose flag.
    """

    name = "blazepose"
    names: tuple[str, ...] = NAMES
    marker_set = MARKER_SET
    root_relative = ROOT_RELATIVE

    #: One for each core: parallel calls of one thread are faster than one call of several threads.
    per_core = True

    def __init__(
        self,
        model_path: str | Path,
        agree_mm: float = 100.0,
        agree_width_mm: float = 20.0,
        sha256: str = MODEL_SHA256,
        quick_path: str | Path | None = None,
        window_cells: float = 0.0,
    ) -> None:
        def load(path: str | Path, sha256: str, window_cells: float = 0.0) -> Network:
            outputs = (*_OUTPUTS, _MAPS) if window_cells else _OUTPUTS
            return Network(path, sha256, 1 / 255, outputs=outputs, num_threads=1, window_cells=window_cells)

        self._model = load(model_path, sha256, window_cells)
        self._quick = load(quick_path, MODEL_SHA256) if quick_path else self._model
        self.model_sha256 = self._model.sha256
        self.mirrored_inference = MirroredInference(NAMES, agree_mm, agree_width_mm)

    @property
    def side_by_side(self) -> int:
        """Number of parallel calls that use the device fully; 1: a detector for each core is fastest."""
        return self._model.side_by_side

    @property
    def origin(self) -> str:
        """Device and runtime of the keypoints; "" for LiteRT on a machine without a GPU."""
        if self._model.on_gpu:
            return f"{self.name} on {self._model.device}"
        return f"{self.name} {self._model.note}" if self._model.note else ""

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False) -> PersonKeypoints:
        """See `KeypointDetector`. `image` (H, W, 3) uint8 BGR, black beyond it."""
        return self.detect_crop(cut_image(image, *self.crop_of(roi_px)), roi_px, camera, quick=quick)

    def crop_of(self, roi_px: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
        """See `CropDetector`."""
        matrix = crop_matrix(_with_margin(roi_px), INPUT_SIZE)
        # A cut counts from the centre of the crop's first pixel, the network from the crop's edge.
        matrix[:, 2] += 0.5 * (matrix[:, 0] + matrix[:, 1])
        return matrix, (INPUT_SIZE, INPUT_SIZE)

    def detect_crop(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False
    ) -> PersonKeypoints:
        """See `CropDetector`."""
        if quick:
            return self._look(self._quick, crop, roi_px, camera, mirrored=False)
        own, other = (self.detect_once(crop, roi_px, camera, mirrored=m) for m in (False, True))
        return self.mirrored_inference.averaged(own, other)

    def detect_once(
        self, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, mirrored: bool = False
    ) -> PersonKeypoints:
        """See `MirrorDetector`."""
        return self._look(self._model, crop, roi_px, camera, mirrored=mirrored)

    def _look(
        self, network: Network, crop: np.ndarray, roi_px: np.ndarray, camera: Camera, *, mirrored: bool
    ) -> PersonKeypoints:
        """Return the points that a network finds in the crop, or in its mirror image, in coordinates of the picture."""
        crop = cv2.cvtColor(crop, cv2.COLOR_BGR2RGB)
        output = network(cv2.flip(crop, 1) if mirrored else crop)
        found = output[N_ALL * 5].reshape(N_ALL, 5).astype(np.float64)
        points, circle, logits = found[:N_POINTS, :2], found[N_POINTS : N_POINTS + 2, :2], found[:N_POINTS, 3:]
        world = output[N_ALL * 3].reshape(N_ALL, 3)[:N_POINTS].astype(np.float64)
        confidence = expit(logits[:, 0]) * expit(logits[:, 1])
        if mirrored:
            flip, edge = np.array([-1.0, 1.0]), np.array([float(INPUT_SIZE), 0.0])
            points, circle = points[MIRROR] * flip + edge, circle * flip + edge
            world, confidence = world[MIRROR] * np.array([-1.0, 1.0, 1.0]), confidence[MIRROR]
        roi = _with_margin(roi_px)
        to_picture = crop_matrix(roi, INPUT_SIZE)
        circle_px = circle @ to_picture[:, :2].T + to_picture[:, 2]
        return PersonKeypoints(
            xy_px=points @ to_picture[:, :2].T + to_picture[:, 2],
            xyz_cam_m=world @ view_rotation(roi, camera).T,
            confidence=confidence,
            presence=float(output[1].item()),
            roi_px=circle_roi(*circle_px),
            crop_px=float(roi[2]),
        )


def _with_margin(roi_px: np.ndarray) -> np.ndarray:
    return np.array([roi_px[0], roi_px[1], roi_px[2] * CROP_MARGIN, roi_px[3]], np.float64)


def blazepose(params: KeypointParams) -> BlazePoseLandmarks:
    """Return the detector of the method, with the network that its parameters name by hash.

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
    quick = assets.fetch(_NETWORKS[MODEL_SHA256]) if params.lighter_first else None
    return BlazePoseLandmarks(path, params.agree_mm, params.agree_width_mm, sha256, quick, params.window_cells)
