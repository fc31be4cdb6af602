"""Keypoints from a registered ONNX model: crops by virtual cameras, augmentations, the way back into the picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.models import ModelSpec, OnnxModel, check_frozen, find, load_spec
from pbl_pipeline.paramset import later
from pbl_pipeline.video import Camera

from .augment import aligned, augmentations, sd_confidence, spread_mm
from .decode_2d import edge_shift, from_heatmap, from_simcc
from .flips import FlipParams
from .params import KeypointParams
from .root_position import HALF_M, absolute_root
from .types import PersonKeypoints
from .virtual_camera import crops, look_at

#: Frames in one call of the network, by device.
BATCH = {"cpu": 2, "cuda": 16}
#: The person's box is this much larger than the hull of its points.
_HULL_MARGIN = 1.1


@dataclasses.dataclass(frozen=True)
class ModelParams:
    """What a method freezes of a registered model.

    name: under which it is registered. sha256, spec_sha256: of its graph, and of all in its `model.json` that changes a
    number. licence: as its `model.json` states it. n_augmentations: see `augmentations`; a model with 3D needs two or
    more, because their spread is its confidence. half_mm, width_mm: see `sd_confidence`.
    half_root_m: see `absolute_root`; 0: half at 5 px of the file, as of methods that were stored before 0.2.
    """

    name: str
    sha256: str
    spec_sha256: str
    licence: str
    n_augmentations: int
    half_mm: float = 30.0
    width_mm: float = 10.0
    half_root_m: float = later(0.0)


@dataclasses.dataclass(frozen=True)
class ModelKeypointParams(KeypointParams):
    """Parameters of `detect_keypoints` with a registered model.

    min_presence is 0: no network here says whether a person is there; without one, confidences are low. `agree_mm`,
    `confidence_curve` and `sides` were made and measured with BlazePose: the first does nothing here, the others are
    off.
    """

    detector: str = "onnx"
    model_sha256: str = ""
    min_presence: float = 0.0
    confidence_curve: str = ""
    sides: FlipParams | None = None
    model: ModelParams = dataclasses.field(kw_only=True)

    def points(self) -> tuple[str, bool]:
        """As the registered model has them. Raises `PblError` MODEL_MISSING, MODEL_INVALID."""
        spec = load_spec(find(self.model.name))
        return spec.marker_set, root_relative(spec)


def model_params(name: str) -> ModelParams:
    """The parameters of a registered model as it is now: 10 augmentations where it gives 3D, the picture and its mirror
    image where it gives 2D only. Raises `PblError` MODEL_MISSING, MODEL_INVALID, MARKER_SET_UNKNOWN, USAGE."""
    spec = load_spec(find(name))
    if not spec.joint_names:
        raise PblError(
            "MODEL_INVALID",
            found=f"a model of kind {spec.kind}",
            expected="a keypoint model (crop3d, simcc or heatmap)",
            next_step="choose another one of `pbl models list`",
            key=name,
        )
    n = 10 if spec.kind == "crop3d" else 2
    return ModelParams(name, spec.sha256, spec.spec_sha256, spec.licence, n, half_root_m=HALF_M)


class OnnxKeypoints:
    """`KeypointDetector` of any registered model.

    A model with 3D: 2D points are the mean over the augmentations; 3D points the mean of the answers, aligned by a
    shift, and put where the 2D points see them (`absolute_root`), so in the camera frame from the camera on;
    confidence from their spread (`sd_confidence`), their mean is `presence`. A model without: 3D is NaN, confidence is
    the mean of the model's own scores.

    Raises `PblError` MODEL_CHECKSUM where the registered model is not the one that the parameters name; what
    `OnnxModel` raises.
    """

    name = "onnx"

    def __init__(self, params: ModelParams, device: str | None = None, folder: str | Path | None = None) -> None:
        self._model = OnnxModel(folder or find(params.name), device)
        spec = self._model.spec
        check_frozen(spec, params.sha256, params.spec_sha256)
        _check_augmentations(spec, params)
        self._spec, self._params = spec, params
        self.model_sha256 = spec.sha256
        self.names = spec.joint_names
        self.marker_set = spec.marker_set
        self.root_relative = root_relative(spec)
        self.device, self.note = self._model.device, self._model.note
        self.batch = BATCH[self.device]
        self._augmentations = augmentations(params.n_augmentations)
        self._mirror = np.array(spec.mirror)

    @property
    def origin(self) -> str:
        """Where these keypoints come from, for the result."""
        spec = self._spec
        looks = f"{len(self._augmentations)} augmentations, ONNX on {self.device}"
        looks += f" ({self.note})" if self.note else ""
        return f"{spec.kind} model {spec.name}, SHA-256 {spec.sha256}, licence: {spec.licence}; {looks}"

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False) -> PersonKeypoints:
        """See `KeypointDetector`. `image` (H, W, 3) uint8 BGR; what lies beyond it is black to the network."""
        return self.detect_many([image], [roi_px], camera, quick=quick)[0]

    def detect_many(
        self, images: Sequence[np.ndarray], rois_px: Sequence[np.ndarray], camera: Camera, *, quick: bool = False
    ) -> list[PersonKeypoints]:
        """As `detect`, for several frames in one call of the network. `quick`: without augmentations."""
        looks = augmentations(1) if quick else self._augmentations
        size, margin = (self._spec.input.width, self._spec.input.height), self._spec.box_margin
        views = [[look_at(r, camera, size, margin, a.scale, a.roll_rad, a.mirrored) for a in looks] for r in rois_px]
        pictures = np.concatenate([crops(i, v, camera) for i, v in zip(images, views, strict=True)])
        output = self._model(pictures, np.tile([a.gamma for a in looks], len(images)))
        xy_crop, score, xyz_crop = self._decode(output)
        shape = (len(images), len(looks), len(self.names))
        xy_crop = xy_crop.reshape(*shape, 2)
        xy = np.empty_like(xy_crop)
        xyz = np.full((*shape, 3), np.nan)
        if xyz_crop is not None:
            xyz_crop = xyz_crop.reshape(*shape, 3)
        for f, views_f in enumerate(views):
            for a, view in enumerate(views_f):
                whose = self._mirror if view.mirrored else slice(None)
                xy[f, a] = view.to_picture(xy_crop[f, a][whose], camera)
                if xyz_crop is not None:
                    xyz[f, a] = view.to_camera(np.asarray(xyz_crop[f, a])[whose])
        mean_xy = xy.mean(axis=1)
        if xyz_crop is None:
            order = [self._mirror if a.mirrored else np.arange(shape[2]) for a in looks]
            scores = np.stack([score.reshape(shape)[:, a, o] for a, o in enumerate(order)], axis=1).mean(axis=1)
            return [
                _person(x, np.full((shape[2], 3), np.nan), c, r, self._crop_px(r))
                for x, c, r in zip(mean_xy, scores, rois_px, strict=True)
            ]
        together = aligned(xyz)
        mean_xyz = together.mean(axis=1)
        confidence = sd_confidence(spread_mm(together), self._params.half_mm, self._params.width_mm)
        root = absolute_root(mean_xyz, mean_xy, confidence, camera, self._params.half_root_m)
        placed = np.asarray(np.isfinite(root).all(axis=1))
        # A shape that fits nowhere in front of the camera is not a person.
        confidence = np.where(placed[:, None], confidence, 0.0)
        mean_xyz = mean_xyz + root[:, None]
        people = zip(mean_xy, mean_xyz, confidence, rois_px, strict=True)
        return [_person(x, p, c, r, self._crop_px(r), known=not quick) for x, p, c, r in people]

    def _crop_px(self, roi_px: np.ndarray) -> float:
        return float(self._spec.box_margin * roi_px[2])

    def _decode(self, output: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Points (N, J, 2) in the crop from the centre of its first pixel, scores (N, J), 3D (N, J, 3) in m or None."""
        spec, size = self._spec, (self._spec.input.width, self._spec.input.height)
        shift: np.ndarray | float = 0.5 if spec.pixel_origin == "edge" else 0.0
        if spec.kind == "crop3d":
            points = output["coords2d"].astype(np.float64) - shift
            return points, np.ones(points.shape[:2]), output["coords3d"].astype(np.float64) / 1000.0
        if spec.kind == "simcc":
            points, score = from_simcc(output["simcc_x"], output["simcc_y"], spec.simcc_split)
            return points - shift, score, None
        heatmap = output["heatmap"]
        points, score = from_heatmap(heatmap, size)
        if spec.pixel_origin == "edge":
            points = points + edge_shift(heatmap.shape, size) - 0.5
        return points, score, None


def root_relative(spec: ModelSpec) -> bool:
    """Whether 3D points are relative to the root of the body; those of a crop model are put into the camera's frame."""
    return spec.kind != "crop3d"


def model_keypoint_params(name: str) -> ModelKeypointParams:
    """The parameters of the keypoint method of a registered model. Raises as `model_params`."""
    model = model_params(name)
    return ModelKeypointParams(model_sha256=model.sha256, model=model)


def onnx(params: ModelKeypointParams) -> OnnxKeypoints:
    """The detector of the method. Raises what `OnnxKeypoints` raises."""
    return OnnxKeypoints(params.model)


def _person(
    xy: np.ndarray, xyz: np.ndarray, confidence: np.ndarray, roi_px: np.ndarray, crop_px: float, *, known: bool = True
) -> PersonKeypoints:
    """`known`: whether the confidence says anything; a single look of a model with 3D has none."""
    presence = float(confidence.mean()) if known else float("nan")
    return PersonKeypoints(xy, xyz, confidence, presence, _region(xy, roi_px), crop_px)


def _region(xy: np.ndarray, roi_px: np.ndarray) -> np.ndarray:
    """(4,) centre, side and rotation of the box around the points, turned as the region they were found in."""
    cosine, sine = np.cos(roi_px[3]), np.sin(roi_px[3])
    turn = np.array([[cosine, sine], [-sine, cosine]])
    along = xy @ turn.T
    low, high = along.min(axis=0), along.max(axis=0)
    return np.array([*((low + high) / 2 @ turn), _HULL_MARGIN * np.max(high - low), roi_px[3]])


def _check_augmentations(spec: ModelSpec, params: ModelParams) -> None:
    if params.n_augmentations < (2 if spec.kind == "crop3d" else 1):
        raise PblError(
            "USAGE",
            found=f"{params.n_augmentations} augmentations for a {spec.kind} model",
            expected="two or more with 3D, whose spread is the confidence; one or more without",
            next_step="use 10, as the paper does",
            key=params.name,
        )
