"""Keypoints from a registered ONNX model: crops by virtual cameras, augmentations, and mapping back to the picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.models import ModelSpec, OnnxModel, check_frozen, find, load_spec
from pbl_pipeline.paramset import later
from pbl_pipeline.video import Camera, viewing_ray

from .flips import FlipParams
from .protocol import KeypointParams
from .types import PersonKeypoints
from .virtual_camera import aligned, augmentations, crops, look_at, sd_confidence, spread_mm

#: Fewest points that determine a position.
MIN_POINTS = 4
#: Distance at which the weight of a point is halved, as a length at the person's distance (m), the same in a picture of
#: any size: 5 px of one of 1080 x 1920 from 4.5 m. And rounds of reweighting: first with Huber's weights, which
#: converge from anywhere, then with Cauchy's, which ignore outliers.
HALF_M, _OLD_HALF_PX = 0.015, 5.0
_ROUNDS = (8, 8)
#: Least depth of a point (m).
_NEAREST_M = 0.1


def absolute_root(
    xyz_m: np.ndarray, xy_px: np.ndarray, confidence: np.ndarray, camera: Camera, half_m: float = HALF_M
) -> np.ndarray:
    """(T, 3) shift in m that projects points (T, J, 3), known up to one shift, onto their pixels (T, J, 2).

    Least squares on ``(x + tx) - u (z + tz)`` and the same for y, u and v being the ray of the pixel without
    distortion, linear in the shift. Repeated with weights that divide by the depth, so that distances count as in the
    picture, and that fall with a point's distance in the picture from its last projection (Cauchy's, half at `half_m`;
    0: at 5 px of the file, as before 0.2). `confidence` (T, J) weights the points. NaN if fewer than four have one, or
    if the person would be behind the camera.
    """
    xyz, weight0 = np.asarray(xyz_m, np.float64), np.asarray(confidence, np.float64)
    known = np.isfinite(xyz).all(axis=2) & np.isfinite(xy_px).all(axis=2) & (weight0 > 0)
    xyz, weight0 = np.where(known[..., None], xyz, 0.0), np.where(known, weight0, 0.0)
    pixels = np.where(known[..., None], xy_px, camera.matrix[:2, 2])
    rays = viewing_ray(pixels.reshape(-1, 2), camera).reshape(*xyz.shape)[..., :2]
    focal = float(np.mean(camera.matrix[[0, 1], [0, 1]]))
    out = np.full((len(xyz), 3), np.nan)
    rows = np.flatnonzero(known.sum(axis=1) >= MIN_POINTS)
    x, d, w = xyz[rows], rays[rows], weight0[rows]
    shift = _solve(x, d, w)
    for number in range(sum(_ROUNDS)):
        z = np.maximum(x[..., 2] + shift[:, None, 2], _NEAREST_M)
        off = focal * np.linalg.norm((x[..., :2] + shift[:, None, :2]) / z[..., None] - d, axis=-1)
        far = off * z / (focal * half_m) if half_m else off / _OLD_HALF_PX
        robust = np.minimum(1.0, 1 / np.maximum(far, 1e-9)) if number < _ROUNDS[0] else 1 / (1 + far**2)
        shift = _solve(x, d, w * robust / z**2)
    before = np.min(np.where(known[rows], x[..., 2] + shift[:, None, 2], np.inf), axis=1) > _NEAREST_M
    out[rows[before]] = shift[before]
    return out


def _solve(x: np.ndarray, d: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Weighted least squares: rows (1, 0, -u) and (0, 1, -v), right sides u z - x and v z - y."""
    normal = np.zeros((len(x), 3, 3))
    normal[:, 0, 0] = normal[:, 1, 1] = w.sum(axis=1)
    normal[:, :2, 2] = normal[:, 2, :2] = -np.einsum("tj,tjk->tk", w, d)
    normal[:, 2, 2] = np.einsum("tj,tjk->t", w, d**2)
    right = d * x[..., 2:] - x[..., :2]
    b = np.concatenate([np.einsum("tj,tjk->tk", w, right), -np.einsum("tj,tjk,tjk->t", w, d, right)[:, None]], axis=1)
    scale = np.maximum(w.sum(axis=1), 1e-300)[:, None, None]
    return np.linalg.solve(normal / scale + 1e-12 * np.eye(3), (b / scale[..., 0])[..., None])[..., 0]


_FLAT = 1e-12


def from_simcc(x: np.ndarray, y: np.ndarray, split: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, J, 2) in px of the crop and scores (N, J) from SimCC's two profiles (N, J, width * split) and
    (N, J, height * split): the position of the largest value on each axis, refined by the parabola through it and its
    neighbours. The score is the smaller of the two values, 0 to 1 (Li et al. 2022, "SimCC", ECCV)."""
    at_x, top_x = _peak(x)
    at_y, top_y = _peak(y)
    return np.stack([at_x, at_y], axis=-1) / split, np.clip(np.minimum(top_x, top_y), 0.0, 1.0)


def from_heatmap(heatmap: np.ndarray, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, J, 2) in px of the crop of `size_px` (width, height) and scores (N, J) from heat maps (N, J, h, w):
    the position of the largest value, refined by the parabola along each axis; its value, 0 to 1, is the score.

    Cell i is at i * width / w: cells and pixels count from the centre of the first, or both from its edge less half a
    cell."""
    n, j, h, w = heatmap.shape
    best = heatmap.reshape(n, j, -1).argmax(axis=2)
    row, column = best // w, best % w
    a, b = np.ogrid[:n, :j]
    at_x, top = _peak(heatmap[a, b, row])
    at_y, _ = _peak(heatmap[a, b, :, column])
    points = np.stack([at_x * size_px[0] / w, at_y * size_px[1] / h], axis=-1)
    return points, np.clip(top, 0.0, 1.0)


def _peak(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (N, J), refined between the bins, and value (N, J) of the largest of (N, J, K)."""
    index = profile.argmax(axis=2)
    inner = np.clip(index, 1, profile.shape[2] - 2)
    a, b = np.ogrid[: profile.shape[0], : profile.shape[1]]
    left, middle, right = (profile[a, b, inner + k].astype(np.float64) for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    step = np.where(bend < -_FLAT, 0.5 * (left - right) / np.where(bend < -_FLAT, bend, 1.0), 0.0)
    between = (inner == index) & (np.abs(step) <= 0.5)
    return index + np.where(between, step, 0.0), profile.max(axis=2).astype(np.float64)


#: Frames in one call of the network, by device.
BATCH = {"cpu": 2, "cuda": 16}
#: Size of the person's box over that of the hull of its points.
_HULL_MARGIN = 1.1


@dataclasses.dataclass(frozen=True)
class ModelParams:
    """Properties of a registered model that a method stores."""

    name: str  # of the registered model
    sha256: str  # of its graph
    spec_sha256: str  # of all fields of its `model.json` that change a number
    licence: str  # in its `model.json`
    n_augmentations: int  # two or more for a model with 3D, because their spread is its confidence (`augmentations`)
    half_mm: float = 30.0  # these two: see `sd_confidence`
    width_mm: float = 10.0
    half_root_m: float = later(0.0)  # see `absolute_root`; 0 in methods stored before 0.2: half at 5 px of the file


@dataclasses.dataclass(frozen=True)
class ModelKeypointParams(KeypointParams):
    """Parameters of `detect_keypoints` with a registered model.

    min_presence is 0: these networks do not return the presence of a person; without one, confidences are low.
    `agree_mm`, `confidence_curve` and `sides` were measured with BlazePose: the first is not used here, the others are
    off.
    """

    detector: str = "onnx"
    model_sha256: str = ""
    min_presence: float = 0.0
    confidence_curve: str = ""
    sides: FlipParams | None = None
    model: ModelParams = dataclasses.field(kw_only=True)

    def points(self) -> tuple[str, bool]:
        """Those of the registered model. Raises `PblError` MODEL_MISSING, MODEL_INVALID."""
        spec = load_spec(find(self.model.name))
        return spec.marker_set, root_relative(spec)


class OnnxKeypoints:
    """`KeypointDetector` of any registered model.

    With a model of 3D points, 2D points are the mean over the augmentations; 3D points are the mean of the results,
    aligned by a shift and placed by the 2D points (`absolute_root`), so in the camera frame with its origin at the
    camera; confidence is from their spread (`sd_confidence`), and its mean is `presence`. With other models, 3D is NaN,
    and confidence is the mean of the model's scores.

    Raises `PblError` MODEL_CHECKSUM if the registered model is not that of the parameters, USAGE (too few
    augmentations), and as `OnnxModel`.
    """

    name = "onnx"

    def __init__(self, params: ModelParams, device: str | None = None, folder: str | Path | None = None) -> None:
        self._model = OnnxModel(folder or find(params.name), device)
        spec = self._model.spec
        check_frozen(spec, params.sha256, params.spec_sha256)
        if params.n_augmentations < (2 if spec.kind == "crop3d" else 1):
            raise PblError(
                "USAGE",
                found=f"{params.n_augmentations} augmentations for a {spec.kind} model",
                expected="two or more with 3D, whose spread is the confidence; one or more without",
                next_step="use 10, as the paper does",
                key=params.name,
            )
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
        """Origin of these keypoints, for the result."""
        spec = self._spec
        looks = f"{len(self._augmentations)} augmentations, ONNX on {self.device}"
        looks += f" ({self.note})" if self.note else ""
        return f"{spec.kind} model {spec.name}, SHA-256 {spec.sha256}, licence: {spec.licence}; {looks}"

    def detect(self, image: np.ndarray, roi_px: np.ndarray, camera: Camera, *, quick: bool = False) -> PersonKeypoints:
        """See `KeypointDetector`. `image` (H, W, 3) uint8 BGR, black beyond it."""
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
        # Points that fit nowhere in front of the camera are not a person.
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
            cell = np.array([size[0] / heatmap.shape[-1], size[1] / heatmap.shape[-2]])
            points = points + cell / 2 - 0.5
        return points, score, None


def root_relative(spec: ModelSpec) -> bool:
    """True if 3D points are relative to the root of the body; those of a crop model are in the camera's frame."""
    return spec.kind != "crop3d"


def model_keypoint_params(name: str) -> ModelKeypointParams:
    """Return the parameters of the keypoint method of a registered model as it is now: 10 augmentations if it returns
    3D, the picture and its mirror image if only 2D. Raises `PblError` MODEL_MISSING, MODEL_INVALID, MARKER_SET_UNKNOWN,
    USAGE."""
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
    model = ModelParams(name, spec.sha256, spec.spec_sha256, spec.licence, n, half_root_m=HALF_M)
    return ModelKeypointParams(model_sha256=spec.sha256, model=model)


def onnx(params: ModelKeypointParams) -> OnnxKeypoints:
    """Return the detector of the method. Raises as `OnnxKeypoints`."""
    return OnnxKeypoints(params.model)


def _person(
    xy: np.ndarray, xyz: np.ndarray, confidence: np.ndarray, roi_px: np.ndarray, crop_px: float, *, known: bool = True
) -> PersonKeypoints:
    """Keypoints of one frame. `known`: False if there is no confidence, as for one inference of a model with 3D."""
    presence = float(confidence.mean()) if known else float("nan")
    return PersonKeypoints(xy, xyz, confidence, presence, _region(xy, roi_px), crop_px)


def _region(xy: np.ndarray, roi_px: np.ndarray) -> np.ndarray:
    """(4,) centre, side and rotation of the box around the points, turned as their region."""
    cosine, sine = np.cos(roi_px[3]), np.sin(roi_px[3])
    turn = np.array([[cosine, sine], [-sine, cosine]])
    along = xy @ turn.T
    low, high = along.min(axis=0), along.max(axis=0)
    return np.array([*((low + high) / 2 @ turn), _HULL_MARGIN * np.max(high - low), roi_px[3]])
