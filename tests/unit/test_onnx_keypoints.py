"""Keypoints from ONNX models, against truth: dots at known 3D points through a known, distorted, tilted camera."""

import functools
import json
import threading
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pbl_pipeline import models
from pbl_pipeline.keypoints import (
    BlazePoseLandmarks,
    KeypointParams,
    Keypoints,
    ModelParams,
    OnnxKeypoints,
    PersonKeypoints,
    detect_keypoints,
    onnx_keypoints,
)
from pbl_pipeline.keypoints.blazepose import CROP_MARGIN, MIRROR, N_ALL
from pbl_pipeline.keypoints.blazepose import NAMES as BLAZEPOSE_NAMES
from pbl_pipeline.keypoints.onnx_keypoints import absolute_root, from_heatmap, from_simcc
from pbl_pipeline.keypoints.passes import BatchedInference
from pbl_pipeline.keypoints.protocol import MODEL_SHA256 as BLAZEPOSE_SHA256
from pbl_pipeline.keypoints.protocol import Inspection
from pbl_pipeline.keypoints.virtual_camera import (
    Augmentation,
    aligned,
    augmentations,
    crops,
    look_at,
    sd_confidence,
    spread_mm,
)
from pbl_pipeline.models import LiteModel
from pbl_pipeline.report.page import page_of
from pbl_pipeline.tracking import PersonTrack, Tracking
from pbl_pipeline.video import Camera, Frame, probe, read_frames, viewing_ray
from pbl_pipeline.visit import Recording, Visit
from tests import dot_models, refused
from tests.command import pbl
from tests.dot_models import NAMES, lens, person, picture, project, region
from tests.unit.test_blazepose import BY_EYE, asset
from tests.unit.test_blazepose import CAMERA as DEMO_CAMERA
from tests.unit.test_blazepose import region as demo_region
from tests.videos import constant_rate, write_video

CAMERA = lens()
#: A person, and where she is in the picture.
XYZ = person()
XY = project(XYZ, CAMERA)
PLACES = {"left edge": (-1.5, 0.1, 4.0), "middle": (0.0, 0.0, 4.0), "right, near": (1.0, 0.1, 3.2)}


def detector(folder: Path, kind: str, graph, n: int = 10, size=(256, 256), **changes) -> OnnxKeypoints:
    dot_models.write(folder, graph, dot_models.spec(kind, size, **changes))
    spec = models.load_spec(folder)
    params = ModelParams(spec.name, spec.sha256, spec.spec_sha256, spec.licence, n)
    return OnnxKeypoints(params, "cpu", folder)


# --- geometry


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("roi", [(480, 360, 300, 0.0), (120, 300, 400, 0.3), (900, 650, 250, -1.2)])
def test_a_pixel_of_the_crop_is_a_pixel_of_the_picture_and_back(roi, mirrored):
    view = look_at(np.array(roi, float), CAMERA, (192, 256), 1.2, 0.9, 0.4, mirrored)
    rng = np.random.default_rng(0)
    xyz = viewing_ray(np.array(roi[:2])[None], CAMERA)[0] * 4 + rng.uniform(-0.4, 0.4, (50, 3))
    in_crop = xyz @ view.turn.T
    xy_crop = in_crop[:, :2] / in_crop[:, 2:] @ view.matrix[:2, :2].T + view.matrix[:2, 2]
    # The points' pixels by the lens equations, and by the crop's.
    np.testing.assert_allclose(view.to_picture(xy_crop, CAMERA), project(xyz, CAMERA), atol=1e-6)
    np.testing.assert_allclose(view.to_camera(in_crop), xyz, atol=1e-12)
    np.testing.assert_allclose(view.turn @ view.turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.turn) == pytest.approx(-1.0 if mirrored else 1.0)


def test_the_crop_is_centred_upright_in_the_region_and_as_large_as_asked():
    roi = np.array([700.0, 250.0, 300.0, 0.35])
    plain = Camera(CAMERA.matrix, np.zeros(5), "no distortion")
    view = look_at(roi, plain, (192, 256))
    np.testing.assert_allclose(view.to_picture(np.array([95.5, 127.5]), plain), roi[:2], atol=1e-9)
    # Down in the crop is down in the region: the ends of its middle line, 300 px apart in the picture but for the
    # stretch of the perspective.
    top, bottom = view.to_picture(np.array([[95.5, -0.5], [95.5, 255.5]]), plain)
    down = (bottom - top) / np.linalg.norm(bottom - top)
    np.testing.assert_allclose(down, [-np.sin(0.35), np.cos(0.35)], atol=1e-3)
    assert np.linalg.norm(bottom - top) == pytest.approx(300, rel=0.02)
    double = look_at(roi, plain, (192, 256), margin=2.0)
    enlarged = look_at(roi, plain, (192, 256), margin=2.0, scale=2.0)
    assert double.matrix[0, 0] == pytest.approx(view.matrix[0, 0] / 2)
    assert enlarged.matrix[0, 0] == pytest.approx(view.matrix[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 3])
def test_the_crop_shows_what_the_virtual_camera_sees(times):
    """Dots lie in the crop where their 3D points are seen, also where the picture is shown three times smaller."""
    xyz = person()
    camera = Camera(CAMERA.matrix * np.array([[times, 1, times], [1, times, times], [1, 1, 1]]), CAMERA.distortion, "")
    xy = project(xyz, camera)
    image = picture(xy, (960 * times, 720 * times), 5.0 * times)
    views = [look_at(region(xy), camera, (256, 256), 1.0, s, r, m) for s, r, m in ((1, 0, False), (0.8, 0.4, True))]
    for view, crop in zip(views, crops(image, views, camera), strict=True):
        in_crop = xyz @ view.turn.T
        seen = in_crop[:, :2] / in_crop[:, 2:] @ view.matrix[:2, :2].T + view.matrix[:2, 2]
        red = np.clip(crop[..., 2].astype(float) - crop[..., :2].max(axis=2) - 30, 0, None)  # the head alone is red
        y, x = np.indices(red.shape)
        centre = np.array([np.sum(red * x), np.sum(red * y)]) / red.sum()
        np.testing.assert_allclose(centre, seen[NAMES.index("head")], atol=0.1)


def test_a_small_crop_of_a_fine_pattern_is_grey():
    """Each pixel of the crop is the mean of those it stands for, not one of them."""
    image = np.zeros((720, 960, 3), np.uint8)
    image[::2] = 255
    crop = crops(image, [look_at(np.array([480.0, 360, 640, 0]), CAMERA, (160, 160))], CAMERA)[0]
    assert np.ptp(crop[20:-20, 20:-20].astype(int)) < 40
    assert abs(crop[20:-20, 20:-20].mean() - 127.5) < 3


def test_beyond_the_picture_and_beyond_the_lens_model_the_crop_is_black():
    white = np.full((720, 960, 3), 255, np.uint8)
    beyond = crops(white, [look_at(np.array([40.0, 360, 400, 0]), CAMERA, (128, 128))], CAMERA)[0]
    assert beyond[:, -20:].min() == 255
    assert beyond[:, :20].max() == 0
    # This lens folds back at 52 degrees; without care the picture would appear a second time beyond that.
    folding = Camera(np.array([[300.0, 0, 480], [0, 300.0, 360], [0, 0, 1]]), np.array([-0.2, 0, 0, 0, 0]), "folds")
    wide = crops(white, [look_at(np.array([480.0, 360, 200, 0]), folding, (128, 128), margin=6.0)], folding)[0]
    rays = look_at(np.array([480.0, 360, 200, 0]), folding, (128, 128), margin=6.0).rays(
        np.stack(np.meshgrid(np.arange(128), np.arange(128)), -1)
    )
    radius = np.hypot(rays[..., 0], rays[..., 1]) / rays[..., 2]
    assert wide[radius > 1.3].max() == 0
    assert wide[radius < 1.0].max() == 255


# --- augmentations and confidence


def test_augmentations_are_ten_different_ones_and_always_the_same():
    ten = augmentations(10)
    assert ten == augmentations(10)
    assert len(set(ten)) == 10
    assert sum(a.mirrored for a in ten) == 5
    assert (min(a.scale for a in ten), max(a.scale for a in ten)) == (0.8, 1.1)
    np.testing.assert_allclose([ten[0].roll_rad, ten[-1].roll_rad], np.radians([-25, 25]))
    assert (ten[0].gamma, ten[-1].gamma) == (0.6, 1.0)
    assert augmentations(1) == (Augmentation(),)
    assert augmentations(2) == (Augmentation(), Augmentation(mirrored=True))


def test_confidence_by_hand():
    np.testing.assert_allclose(
        sd_confidence(np.array([30.0, 0.0, 40.0, 1e4])), [0.5, 1 / (1 + np.exp(-3)), 1 / (1 + np.e), 0], atol=1e-12
    )


def test_spread_by_hand():
    """Two answers 60 mm apart: each 30 mm from their mean."""
    xyz = np.zeros((2, 3, 3))
    xyz[1, 0] = [0.0, 0.036, 0.048]
    np.testing.assert_allclose(spread_mm(xyz), [30.0, 0, 0], atol=1e-9)


def test_a_shift_of_a_whole_answer_is_no_spread_and_a_point_that_strays_spreads_alone():
    rng = np.random.default_rng(2)
    shape = rng.normal(0, 0.4, (20, 3))
    answers = np.tile(shape, (10, 1, 1)) + rng.normal(0, 1.0, (10, 1, 3))
    np.testing.assert_allclose(spread_mm(aligned(answers)), 0, atol=1e-9)
    stray = rng.normal(0, 0.2, (10, 3))
    answers[:, 7] += stray
    wanted = 1000 * np.sqrt(np.mean(np.sum((stray - stray.mean(axis=0)) ** 2, axis=1)))
    sigma = spread_mm(aligned(answers))
    assert sigma[7] == pytest.approx(wanted, rel=0.03)
    assert np.delete(sigma, 7).max() < 0.05 * wanted


# --- 2D models


def test_peaks_lie_between_the_bins():
    """A parabola's top is found exactly; a value at the end of the profile is where it is."""
    bins = np.arange(40)
    x = 1 - ((bins - 12.3) / 20) ** 2
    y = 0.8 - ((bins - 39.0) / 50) ** 2
    points, score = from_simcc(x[None, None], y[None, None], 2.0)
    np.testing.assert_allclose(points[0, 0], [6.15, 19.5], atol=1e-9)
    np.testing.assert_allclose(score, 0.8)
    rows, columns = np.ogrid[:30, :20]
    hill = 0.9 - ((rows - 7.4) / 30) ** 2 - ((columns - 11.25) / 30) ** 2
    points, score = from_heatmap(hill[None, None], (80, 120))
    np.testing.assert_allclose(points[0, 0], [11.25 * 4, 7.4 * 4], atol=1e-9)
    assert score[0, 0] == pytest.approx(hill.max())
    flat, _ = from_heatmap(np.zeros((1, 1, 4, 4)), (4, 4))
    assert np.isfinite(flat).all()


# --- where the person is


def test_root_by_hand_and_with_wrong_points():
    rng = np.random.default_rng(3)
    shape = rng.uniform(-0.6, 0.6, (5, 30, 3))
    at = np.stack([rng.uniform(-1, 1, 5), rng.uniform(-0.5, 0.5, 5), rng.uniform(2, 8, 5)], axis=1)
    xy = np.stack([project(x + a, CAMERA) for x, a in zip(shape, at, strict=True)])
    np.testing.assert_allclose(absolute_root(shape, xy, np.ones((5, 30)), CAMERA), at, atol=1e-6)
    wrong = xy.copy()
    wrong[:, :4] += 120.0
    assert np.abs(absolute_root(shape, wrong, np.ones((5, 30)), CAMERA) - at).max() < 0.15
    weighed = np.ones((5, 30))
    weighed[:, :4] = 0.0
    np.testing.assert_allclose(absolute_root(shape, wrong, weighed, CAMERA), at, atol=1e-6)


def test_root_is_where_distances_in_the_picture_are_least():
    """Points at 1.5 to 7 m, 2 px of noise: as close to the place that a general solver finds as the noise is small."""
    rng = np.random.default_rng(5)
    apart, spread = [], []
    for _ in range(20):
        shape = rng.uniform([-0.5, -0.5, -2.5], [0.5, 0.5, 3.0], (40, 3))
        at = np.array([0.1, 0.1, 4.0])
        xy = project(shape + at, CAMERA) + rng.normal(0, 2.0, (40, 2))

        def off(t, shape=shape, xy=xy):
            return np.linalg.norm(project(shape + t, CAMERA) - xy, axis=1)

        best = least_squares(off, at, loss="cauchy", f_scale=5.0).x
        apart.append(absolute_root(shape[None], xy[None], np.ones((1, 40)), CAMERA)[0] - best)
        spread.append(best - at)
    assert np.std(apart) < 0.3 * np.std(spread)


def test_root_that_cannot_be_known_is_nan():
    shape = np.random.default_rng(4).uniform(-0.5, 0.5, (1, 10, 3))
    xy = project(shape[0] + [0, 0, 3.0], CAMERA)[None]
    few = np.zeros((1, 10))
    few[0, :3] = 1
    assert np.isnan(absolute_root(shape, xy, few, CAMERA)).all()
    turned_over = 2 * CAMERA.matrix[:2, 2] - xy  # seen upside down: only behind the camera
    assert np.isnan(absolute_root(shape, turned_over, np.ones((1, 10)), CAMERA)).all()


# --- the whole way


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("n", [2, 10])
def test_crop_model_brings_the_points_back(tmp_path, place, n):
    """Within 0.5 px and 5 mm, each on its own side, from a tilted, rolled camera with a distorted lens."""
    xyz = person(PLACES[place])
    xy = project(xyz, CAMERA)
    found = detector(tmp_path, "crop3d", dot_models.crop3d(xyz), n).detect(picture(xy), region(xy), CAMERA)
    assert np.linalg.norm(found.xy_px - xy, axis=1).max() < 0.5
    assert 1000 * np.linalg.norm(found.xyz_cam_m - xyz, axis=1).max() < 5.0
    np.testing.assert_allclose(found.confidence, sd_confidence(np.array(0.0)), atol=0.005)
    assert found.presence == pytest.approx(found.confidence.mean())
    # The better region is around the points.
    assert np.linalg.norm(found.roi_px[:2] - region(xy)[:2]) < 0.05 * found.roi_px[2]


def test_pixels_may_count_from_the_edge(tmp_path):
    model = detector(tmp_path, "crop3d", dot_models.crop3d(XYZ, origin_px=0.5), pixel_origin="edge")
    assert np.abs(model.detect(picture(XY), region(XY), CAMERA).xy_px - XY).max() < 0.1


def test_without_exchanging_sides_the_mirrored_points_would_be_wrong(tmp_path):
    """What the test above would see: the pairs are declared to be no pairs."""
    swap = {"left": "a", "right": "b"}
    names = [swap.get(n.split("_")[0], n.split("_")[0]) + "".join(n.partition("_")[1:]) for n in NAMES]
    model = detector(tmp_path, "crop3d", dot_models.crop3d(XYZ), joint_names=names)
    found = model.detect(picture(XY), region(XY), CAMERA)
    sides = [i for i, n in enumerate(NAMES) if "_" in n]
    assert np.linalg.norm(found.xy_px - XY, axis=1)[sides].min() > 5
    assert found.confidence[sides].max() < 0.2


def test_noise_gives_the_confidence_that_the_formula_says(tmp_path):
    """Depths that grow with the grey of the background, which gamma makes another in each augmentation."""
    drift = {"left_hip": 300.0, "right_knee": 900.0, "head": 600.0, "base": 300.0}
    found = detector(tmp_path, "crop3d", dot_models.crop3d(XYZ, drift_mm=drift)).detect(picture(XY), region(XY), CAMERA)
    grey = np.array([(dot_models.GREY / 255) ** a.gamma for a in augmentations(10)])
    # Mirrored pictures show the other side: half of the answers of a pair are the partner's, which does not drift.
    for j, name in enumerate(NAMES):
        partner = name.replace("left", "~").replace("right", "left").replace("~", "right")
        depth = np.array(
            [drift.get(partner if a.mirrored else name, 0.0) * g for a, g in zip(augmentations(10), grey, strict=True)]
        )
        sigma_mm = float(np.std(depth))
        wanted = 1 / (1 + np.exp((sigma_mm - 30) / 10))
        assert found.confidence[j] == pytest.approx(wanted, abs=0.03), name
    at = {n: found.confidence[NAMES.index(n)] for n in NAMES}
    assert at["right_knee"] < 0.01
    assert 0.4 < at["head"] < 0.6  # 30 mm
    assert 0.75 < at["base"] < 0.85  # 15 mm
    assert at["left_ankle"] > 0.94


@pytest.mark.parametrize(("kind", "graph"), [("simcc", dot_models.simcc), ("heatmap", dot_models.heatmap)])
def test_models_without_depth(tmp_path, kind, graph):
    found = detector(tmp_path, kind, graph(), 2, (192, 256)).detect(picture(XY), region(XY), CAMERA)
    assert np.linalg.norm(found.xy_px - XY, axis=1).max() < 0.5
    assert np.isnan(found.xyz_cam_m).all()
    # The graph's own score, 1 at a dot's centre: dots are there, and smaller in the crop than a cell is wide.
    assert found.confidence.min() > 0.7
    black = detector(tmp_path, kind, graph(), 2, (192, 256)).detect(
        np.zeros((720, 960, 3), np.uint8), region(XY), CAMERA
    )
    assert black.confidence.max() == 0
    assert black.presence == 0


def test_scores_of_the_mirrored_picture_go_to_their_own_side(tmp_path):
    """The left knee is half as clear as the right one."""
    image = picture(XY)
    x, y = np.round(XY[NAMES.index("left_knee")]).astype(int)
    patch = image[y - 20 : y + 21, x - 20 : x + 21]
    patch[:] = (patch.astype(int) + dot_models.GREY) // 2
    found = detector(tmp_path, "simcc", dot_models.simcc(), 2, (192, 256)).detect(image, region(XY), CAMERA)
    left, right = (found.confidence[NAMES.index(f"{side}_knee")] for side in ("left", "right"))
    assert left < 0.4
    assert right > 0.7


@pytest.mark.slow
def test_several_frames_in_one_call_are_the_same_as_one_by_one(tmp_path):
    people = [dot_models.turned(person(), a) for a in (0.0, 0.1, 0.25)]
    images = [picture(project(x, CAMERA)) for x in people]
    rois = [region(project(x, CAMERA)) for x in people]
    model = detector(tmp_path, "crop3d", dot_models.crop3d(people[0]))
    for together, image, roi, xyz in zip(model.detect_many(images, rois, CAMERA), images, rois, people, strict=True):
        alone = model.detect(image, roi, CAMERA)
        np.testing.assert_allclose(together.xyz_cam_m, alone.xyz_cam_m, atol=1e-5)
        assert np.abs(together.xyz_cam_m - xyz).max() < 0.005


def test_a_model_without_spread_has_no_confidence(tmp_path):
    refused("USAGE", detector, tmp_path, "crop3d", dot_models.crop3d(person()), 1)


def test_another_model_than_the_method_froze(tmp_path):
    model = detector(tmp_path, "simcc", dot_models.simcc(), 2, (192, 256))
    spec = models.load_spec(tmp_path)
    assert model.model_sha256 == spec.sha256
    for params in (
        ModelParams(spec.name, "0" * 64, spec.spec_sha256, spec.licence, 2),
        ModelParams(spec.name, spec.sha256, "0" * 64, spec.licence, 2),
    ):
        refused("MODEL_CHECKSUM", OnnxKeypoints, params, "cpu", tmp_path)


class BlazePoseAsCropModel:
    """BlazePose's network in the place of a session: a real one, whose answers are known by another way."""

    device, note, fixed_batch = "cpu", "", None

    def __init__(self, *_: object) -> None:
        entry = {"name": "image", "width": 256, "height": 256, "layout": "NHWC", "colour": "RGB"}
        fields = dot_models.spec("crop3d", input=entry | {"mean": [0, 0, 0], "std": [255, 255, 255]})
        fields |= {"sha256": "0" * 64, "marker_set": "blazepose_33", "joint_names": list(BLAZEPOSE_NAMES)}
        self.spec = models.parse_spec(fields | {"pixel_origin": "edge", "box_margin": CROP_MARGIN}, "a test")
        self._network = LiteModel(asset("blazepose_landmarks"), BLAZEPOSE_SHA256)

    def __call__(self, crops: np.ndarray, gamma: np.ndarray) -> dict[str, np.ndarray]:
        outputs = [
            self._network(((c[..., ::-1] / 255.0) ** g).astype(np.float32)) for c, g in zip(crops, gamma, strict=True)
        ]
        return {
            "coords2d": np.stack([o[N_ALL * 5].reshape(N_ALL, 5)[:33, :2] for o in outputs]),
            "coords3d": 1000 * np.stack([o[N_ALL * 3].reshape(N_ALL, 3)[:33] for o in outputs]),
        }


@pytest.mark.slow
def test_a_real_network_gives_the_same_by_this_way_and_its_own(monkeypatch):
    """Two looks, plain and mirrored, at a woman about 440 px high; the camera is that of the recording."""
    monkeypatch.setattr(onnx_keypoints, "OnnxModel", BlazePoseAsCropModel)
    spec = BlazePoseAsCropModel().spec
    assert list(spec.mirror) == list(MIRROR)
    model = OnnxKeypoints(ModelParams(spec.name, "0" * 64, spec.spec_sha256, spec.licence, 2), folder="nowhere")
    direct = BlazePoseLandmarks(asset("blazepose_landmarks"))
    frames = [f for f in read_frames(asset("demo_video"), start=100, stop=135) if f.index in BY_EYE]
    assert frames
    for frame in frames:
        roi = direct.detect(frame.image, demo_region(frame.index), DEMO_CAMERA).roi_px
        a, b = (d.detect(frame.image, roi, DEMO_CAMERA) for d in (direct, model))
        assert np.median(np.linalg.norm(a.xy_px - b.xy_px, axis=1)) < 2
        hips = [BLAZEPOSE_NAMES.index(f"{s}_hip") for s in ("left", "right")]
        relative = b.xyz_cam_m - b.xyz_cam_m[hips].mean(axis=0)
        assert np.median(np.linalg.norm(relative - a.xyz_cam_m, axis=1)) < 0.03
        # She walks at about 9.5 m, as large as she is: the leg of 190 px.
        assert 8.5 < b.xyz_cam_m[hips, 2].mean() < 10.5


# --- batches


class Counts:
    """A detector that only counts; a region of side 13 is one it cannot bear."""

    batch = 3

    def __init__(self) -> None:
        self.calls: list[tuple[list[float], bool]] = []
        self.begin = threading.Event()

    def detect_many(self, images, rois_px, camera, *, quick=False):
        assert self.begin.wait(10)
        self.calls.append(([float(r[0]) for r in rois_px], quick))
        if any(r[2] == 13 for r in rois_px):
            raise ValueError("13")
        return [PersonKeypoints(np.zeros((1, 2)), np.zeros((1, 3)), np.ones(1), 1.0, r) for r in rois_px]


def torn() -> np.ndarray:
    raise ValueError("torn")


def roi(x: float, side: float = 10) -> np.ndarray:
    return np.array([x, 0, side, 0])


def test_what_waits_goes_together_in_order_and_quick_looks_apart():
    counts, frame = Counts(), Frame(0, 0.0, lambda: np.zeros((2, 2, 3), np.uint8))
    with BatchedInference(counts, CAMERA) as inference:
        futures = [
            inference.submit(frame, roi(x), Inspection.QUICK if x in (4, 5) else Inspection.FULL) for x in range(9)
        ]
        counts.begin.set()
        assert [f.result(10).roi_px[0] for f in futures] == list(range(9))
    assert [x for xs, _ in counts.calls for x in xs] == list(range(9))
    assert all(quick == (xs[0] in (4, 5)) and len(xs) <= 3 for xs, quick in counts.calls)
    assert max(len(xs) for xs, _ in counts.calls) == 3


def test_an_error_goes_to_who_asked_and_leaving_drops_what_waits():
    counts, frame = Counts(), Frame(0, 0.0, lambda: np.zeros((2, 2, 3), np.uint8))
    counts.begin.set()
    with BatchedInference(counts, CAMERA) as inference:
        bad = inference.submit(frame, roi(0, 13), Inspection.FULL)
        with pytest.raises(ValueError, match="13"):
            bad.result(10)
        assert inference.submit(frame, roi(1), Inspection.FULL).result(10).roi_px[0] == 1
        with pytest.raises(ValueError, match="torn"):
            inference.submit(Frame(1, 0.1, torn), roi(2), Inspection.FULL).result(10)
        counts.begin.clear()
        waiting = [inference.submit(frame, roi(x), Inspection.FULL) for x in range(50)]
        counts.begin.set()
    assert sum(f.done() for f in waiting) < 50


# --- a video


N = 45


@functools.cache
def walk() -> tuple[np.ndarray, np.ndarray]:
    """Points (N, J, 3) of somebody carried around the camera, and their pixels."""
    xyz = np.stack([dot_models.turned(person(), a) for a in np.linspace(-0.05, 0.45, N)])
    return xyz, np.stack([project(x, CAMERA) for x in xyz])


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tracking]:
    """A video of her, and a track that is late and too large: the first look has to correct it."""
    _, xy = walk()
    path = tmp_path_factory.mktemp("dots") / "walk.mp4"
    write_video(path, (picture(p) for p in xy), constant_rate(N), pixel_format="yuv444p", crf=8)
    low, high = xy.min(axis=1), xy.max(axis=1)
    box = np.concatenate([low - 30, high + 10], axis=1) + 8.0
    track = PersonTrack(1, box, np.full((N, 4), np.nan), np.ones(N), np.ones(N, bool))
    return path, Tracking(probe(path).time_s, (960, 720), (track,), "by hand", "0" * 64)


@pytest.fixture
def registered(tmp_path, environment) -> None:
    environment(PBL_MODELS=tmp_path / "models")
    environment(PBL_ONNX_DEVICE="cpu")  # also put back what `--device` sets
    models.add(dot_models.write(tmp_path / "a", dot_models.crop3d(person()), dot_models.spec("crop3d")))
    models.add(dot_models.write(tmp_path / "b", dot_models.simcc(), dot_models.spec("simcc", (192, 256))))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dots-crop3d", "dots-simcc"])
def test_a_video_through_detect_keypoints(video, registered, tmp_path, name):
    path, tracking = video
    xyz, xy = walk()
    found = detect_keypoints(path, tracking, 1, CAMERA, name)
    assert found.names == NAMES
    # The pictures are compressed, and a pixel of the 2D model's crop is 1.3 of them.
    off = np.linalg.norm(found.xy_px - xy, axis=2)
    assert np.median(off) < 0.5
    assert off.max() < (0.5 if name == "dots-crop3d" else 2.0)
    assert (found.confidence > 0.5).all()
    if name == "dots-crop3d":
        assert 1000 * np.linalg.norm(found.xyz_cam_m - xyz, axis=2).max() < 25
        assert 1000 * np.median(np.linalg.norm(found.xyz_cam_m - xyz, axis=2)) < 5
        assert not found.root_relative
    else:
        assert np.isnan(found.xyz_cam_m).all()
    assert "licence: CC0-1.0, a test" in found.origin
    assert "on cpu" in found.origin
    found.save(tmp_path / "keypoints.npz")
    again = Keypoints.load(tmp_path / "keypoints.npz")
    assert again.origin == found.origin


def test_the_detector_onnx_without_a_model(video):
    path, tracking = video
    refused("SOLVER_UNKNOWN", detect_keypoints, path, tracking, 1, CAMERA, KeypointParams(detector="onnx"))


def test_what_is_wrong_with_the_call_is_found_before_the_work(video, registered, tmp_path, monkeypatch):
    path, _ = video
    unknown = pbl("detect", path, "--out", tmp_path / "k.npz", "--keypoints", "metrabs")
    assert unknown.error_code == "SOLVER_UNKNOWN"
    assert "dots-crop3d, dots-simcc" in unknown.err
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    cuda = pbl("detect", path, "--out", tmp_path / "k.npz", "--keypoints", "dots-simcc", "--device", "cuda")
    assert cuda.error_code == "DEVICE_UNAVAILABLE"


@pytest.mark.slow
def test_pbl_detect_shows_the_licence_before_the_work(video, registered, tmp_path, stand_in):
    path, tracking = video
    stand_in(track_people=lambda *_, **__: tracking)
    camera = {"camera_matrix": CAMERA.matrix.tolist(), "distortion": CAMERA.distortion.tolist()}
    (tmp_path / "camera.json").write_text(json.dumps(camera | {"image_size_px": [960, 720]}))
    arguments = ("--out", tmp_path / "k.npz", "--camera", tmp_path / "camera.json", "--person", 1)
    done = pbl("detect", path, *arguments, "--keypoints", "dots-crop3d", "--device", "cpu")
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0] == "keypoints by the model dots-crop3d, licence: CC0-1.0, a test"
    assert any("10 points (dots_10) of person 1 in 45 of 45 frames" in line for line in lines)
    assert any(line.startswith("  keypoints by crop3d model dots-crop3d, SHA-256") for line in lines)
    assert Keypoints.load(tmp_path / "k.npz").marker_set == "dots_10"


@pytest.mark.slow
def test_the_report_names_the_model(video, registered):
    path, tracking = video
    found = detect_keypoints(path, tracking, 1, CAMERA, "dots-simcc")
    groups = page_of(Visit((Recording.of("walk", keypoints=found),)), {}, "Report")["origin"]
    (software,) = (group["rows"] for group in groups if group["name"] == "Software")
    assert ("keypoints of walk", found.origin, False) in software


def test_rotation_of_the_crop_is_the_roll_that_was_asked():
    """The turn of the virtual camera is the one of the region, rolled about its axis, whatever the lens."""
    roi = np.array([300.0, 500.0, 200.0, 0.2])
    straight, turned = (look_at(roi, CAMERA, (128, 128), roll_rad=r).turn for r in (0.0, 0.5))
    np.testing.assert_allclose(turned @ straight.T, Rotation.from_rotvec([0, 0, 0.5]).as_matrix(), atol=1e-12)
    axis = straight[2]
    ray = cv2.undistortPoints(roi[None, None, :2], CAMERA.matrix, CAMERA.distortion)[0, 0]
    np.testing.assert_allclose(axis[:2] / axis[2], ray, atol=1e-4)
