"""BlazePose's two networks: decoding by hand, and the real models on frames of the demo recording.

The tests with models need the assets and skip where those are absent and cannot be fetched.
"""

import dataclasses
import hashlib
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import METHODS, BlazePoseLandmarks, KeypointParams
from pbl_pipeline.keypoints.blazepose import MIRROR, NAMES, blazepose
from pbl_pipeline.keypoints.passes import ParallelInference
from pbl_pipeline.keypoints.protocol import Inspection
from pbl_pipeline.models import LiteModel, Network, ssd, suppress
from pbl_pipeline.models.tflite import keep_outputs
from pbl_pipeline.tracking import BlazePoseDetector
from pbl_pipeline.tracking.blazepose import LAYOUT
from pbl_pipeline.tracking.tiling import detect_in, tiles
from pbl_pipeline.video import Camera, Frame, cut_image, read_frames
from tests import refused

CAMERA = Camera(np.array([[2520.0, 0, 884], [0, 2520.0, 497], [0, 0, 1]]), np.zeros(5), "Calib_demo.toml of Sports2D")

#: Read off the frames by eye on a pixel grid (px, +- 6): front and rear ankle of the woman, and which foot is in
#: front, told by the near arm, which is the left one, and swings against its leg.
BY_EYE = {
    100: ("right", (961, 906), (1133, 906)),
    116: ("left", (788, 903), (945, 906)),
    134: ("right", (604, 903), (766, 906)),
}


def asset(name: str) -> Path:
    try:
        return assets.fetch(name)
    except PblError as error:
        if error.code != "ASSET_MISSING":
            raise
        pytest.skip(f"asset {name} is absent: {error.found}")


@pytest.fixture(scope="module")
def frames() -> dict[int, np.ndarray]:
    video = asset("demo_video")
    return {f.index: f.image for f in read_frames(video, start=100, stop=135) if f.index in BY_EYE}


@pytest.fixture(scope="module")
def detector() -> BlazePoseDetector:
    return BlazePoseDetector(asset("blazepose_detector"))


@pytest.fixture(scope="module", params=["blazepose-33", "blazepose-heavy"])
def landmarks(request: pytest.FixtureRequest) -> BlazePoseLandmarks:
    method = METHODS[request.param]
    network = next(name for name, a in assets.ASSETS.items() if a.sha256 == method.params.model_sha256)
    asset(network)
    detector = method.function(method.params)
    assert detector.model_sha256 == assets.ASSETS[network].sha256
    return detector


# --- by hand ----------------------------------------------------------------------------------------------------


def test_anchors():
    centres = LAYOUT.anchor_centres
    assert centres.shape == (2254, 2)
    np.testing.assert_allclose(centres[:3], [[0.5 / 28, 0.5 / 28], [0.5 / 28, 0.5 / 28], [1.5 / 28, 0.5 / 28]])
    first16 = 28 * 28 * 2
    np.testing.assert_allclose(centres[first16 + 2 * 14], [0.5 / 14, 1.5 / 14])
    np.testing.assert_allclose(centres[-6:], np.tile([6.5 / 7, 6.5 / 7], (6, 1)))


def test_decode_one_box_by_hand():
    raw_boxes = np.zeros((2254, 12), np.float32)
    raw_scores = np.full(2254, -500, np.float32)
    row = 28 * 28 * 2 + 14 * 14 * 2  # first anchor of stride 32: centre at 16 px
    raw_boxes[row] = [4, 8, 40, 20, 0, 0, 0, -50, 1, 2, 3, 4]
    raw_scores[row] = np.log(3)
    values, scores = LAYOUT.decode(raw_boxes, raw_scores, 0.5)
    np.testing.assert_allclose(scores, [0.75])
    np.testing.assert_allclose(values[0, :8] * 224, [0, 14, 40, 34, 16, 16, 16, -34], rtol=1e-6, atol=1e-9)


def test_weighted_suppression_by_hand():
    values = np.array([[0, 0, 2, 2, 7], [0, 0, 2, 1.6, 1], [5, 5, 6, 6, 3.0]])
    kept, scores = suppress(values, np.array([0.9, 0.6, 0.5]), 0.3)
    np.testing.assert_allclose(scores, [0.9, 0.5])
    np.testing.assert_allclose(kept[0], [0, 0, 2, (0.9 * 2 + 0.6 * 1.6) / 1.5, (0.9 * 7 + 0.6) / 1.5])
    np.testing.assert_allclose(kept[1], values[2])


def test_another_file_than_the_pinned_model_is_refused(tmp_path):
    (tmp_path / "model.tflite").write_bytes(b"not the model")
    refused("ASSET_CHECKSUM", BlazePoseDetector, tmp_path / "model.tflite")


def test_a_network_that_this_version_does_not_know_is_refused():
    params = KeypointParams(model_sha256="0" * 64)
    assert "blazepose_landmarks_heavy" in refused("SOLVER_UNKNOWN", METHODS.find(params).function, params).expected


# --- with the models --------------------------------------------------------------------------------------------


def test_tiles_find_both_people_and_the_whole_frame_does_not(detector, frames):
    image = frames[100]
    found = detect_in(detector, image, tiles(1768, 994, 0.7, 0.3))
    sure = sorted((d.roi_px for d in found if d.score > 0.9), key=lambda r: r[0])
    assert len(sure) == 2
    man, woman = sure
    # Hips by eye: the man's on the wall near (645, 250), the woman's near (1005, 715).
    assert np.hypot(*(man[:2] - [645, 250])) < 40
    assert np.hypot(*(woman[:2] - [1005, 715])) < 40
    assert abs(woman[3]) < 0.3
    assert not [d for d in detector.detect(image) if d.score > 0.9]


def test_on_a_gpu_the_windows_of_a_picture_are_asked_for_together(detector, frames, monkeypatch):
    together = threading.Barrier(3, timeout=5)

    class Shared(Network):
        @property
        def side_by_side(self) -> int:
            return 3

        def __call__(self, image: np.ndarray) -> dict[int, np.ndarray]:
            together.wait()
            return super().__call__(image)

    monkeypatch.setattr(ssd, "Network", Shared)
    windows = tiles(1768, 994, 0.7, 0.3)[:3]
    shared = detect_in(BlazePoseDetector(assets.fetch("blazepose_detector")), frames[100], windows)
    alone = detect_in(detector, frames[100], windows)
    assert [d.roi_px.tolist() for d in shared] == [d.roi_px.tolist() for d in alone] != []


def test_no_person_in_noise_or_flat_pictures(detector):
    rng = np.random.default_rng(0)
    for image in (rng.integers(0, 256, (480, 640, 3), np.uint8), np.full((480, 640, 3), 127, np.uint8)):
        assert not [d for d in detector.detect(image) if d.score > 0.8]


def region(frame: int) -> np.ndarray:
    """A body circle around the middle of the two ankles seen by eye, one leg length above."""
    _, front, rear = BY_EYE[frame]
    return np.array([(front[0] + rear[0]) / 2, 715.0, 440.0, 0.0])


@pytest.mark.parametrize("frame", BY_EYE)
def test_ankles_where_a_human_sees_them(landmarks, frames, frame):
    side, front, rear = BY_EYE[frame]
    other = "left" if side == "right" else "right"
    person = landmarks.detect(frames[frame], region(frame), CAMERA)
    assert person.presence > 0.9
    # 25 px are 9 cm of this person.
    assert np.hypot(*(person.xy_px[NAMES.index(f"{side}_ankle")] - front)) < 25
    assert np.hypot(*(person.xy_px[NAMES.index(f"{other}_ankle")] - rear)) < 25
    # She walks to the left of the picture, so her left side is nearer, and the head is up (y is down).
    xyz = person.xyz_cam_m
    assert xyz[NAMES.index("left_hip"), 2] < xyz[NAMES.index("right_hip"), 2]
    assert xyz[NAMES.index("nose"), 1] < -0.4
    assert 0.5 < xyz[NAMES.index(f"{side}_ankle"), 1] < 1.0
    np.testing.assert_allclose(xyz[[23, 24]].mean(axis=0), 0, atol=0.02)
    assert np.all((person.confidence >= 0) & (person.confidence <= 1))
    assert person.confidence[NAMES.index(f"{side}_ankle")] > 0.5


def test_a_mirrored_picture_gives_the_mirrored_person(landmarks, frames):
    image, roi = frames[116], region(116)
    width = image.shape[1]
    matrix = CAMERA.matrix.copy()
    matrix[0, 2] = width - 1 - matrix[0, 2]
    mirrored = np.ascontiguousarray(image[:, ::-1])
    a = landmarks.detect(image, roi, CAMERA)
    # Half a pixel: the crop's centre is a place on the picture, counted from pixel centres on both sides.
    b = landmarks.detect(mirrored, np.array([width - 1 - roi[0], *roi[1:]]), Camera(matrix, np.zeros(5), "mirrored"))
    np.testing.assert_allclose(b.xy_px[MIRROR] * [-1, 1] + [width - 1, 0], a.xy_px, atol=3)
    np.testing.assert_allclose(b.xyz_cam_m[MIRROR] * [-1, 1, 1], a.xyz_cam_m, atol=0.02)


def test_a_turned_picture_gives_the_turned_person(landmarks, frames):
    image, roi = frames[100], region(100)
    turn = 0.5
    about = (float(CAMERA.matrix[0, 2]), float(CAMERA.matrix[1, 2]))
    warp = cv2.getRotationMatrix2D(about, -np.degrees(turn), 1.0)
    turned = cv2.warpAffine(image, warp, (1768, 1400))
    a = landmarks.detect(image, roi, CAMERA)
    b = landmarks.detect(turned, np.array([*(warp @ [*roi[:2], 1]), roi[2], turn]), CAMERA)
    np.testing.assert_allclose(b.xy_px, a.xy_px @ warp[:, :2].T + warp[:, 2], atol=12)
    roll = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    np.testing.assert_allclose(b.xyz_cam_m, a.xyz_cam_m @ roll.T, atol=0.06)


def test_what_is_left_of_the_network_computes_the_same_bits(frames):
    path = asset("blazepose_landmarks")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    whole, part = LiteModel(path, sha256), LiteModel(path, sha256, (195, 117, 1), num_threads=1)
    for image in frames.values():
        crop = np.ascontiguousarray(image[:256, :256, ::-1].astype(np.float32) / 255)
        a, b = whole(crop), part(crop)
        assert set(b) == {195, 117, 1} < set(a)
        for size, values in b.items():
            np.testing.assert_array_equal(values, a[size])


def test_an_output_that_the_network_lacks():
    path = asset("blazepose_landmarks")
    with pytest.raises(ValueError, match="no output of \\[7\\] elements"):
        keep_outputs(path.read_bytes(), (195, 7))


def test_quick_gives_nearly_the_same_circle(landmarks, frames):
    full = landmarks.detect(frames[100], region(100), CAMERA)
    quick = landmarks.detect(frames[100], region(100), CAMERA, quick=True)
    np.testing.assert_allclose(quick.roi_px[:2], full.roi_px[:2], atol=20)


def test_which_network_looks(frames):
    """Of `blazepose-heavy`, the first pass over a frame is the lighter network's; each that counts is its own."""
    for name in ("blazepose_landmarks", "blazepose_landmarks_heavy"):
        asset(name)
    heavy = METHODS["blazepose-heavy"].params
    light, both = blazepose(KeypointParams()), blazepose(heavy)
    alone = blazepose(dataclasses.replace(heavy, lighter_first=False))
    roi = region(100)
    crop = cut_image(frames[100], *both.crop_of(roi))

    def points(detector: BlazePoseLandmarks, inspection: Inspection) -> np.ndarray:
        with ParallelInference([detector], CAMERA) as inference:
            return inference.submit(Frame(0, 0.0, lambda: frames[100]), roi, inspection).result().xy_px

    np.testing.assert_array_equal(points(both, Inspection.QUICK), points(light, Inspection.QUICK))
    assert np.abs(points(alone, Inspection.QUICK) - points(light, Inspection.QUICK)).max() > 1
    for inspection in (Inspection.PLAIN, Inspection.MIRRORED, Inspection.FULL):
        np.testing.assert_array_equal(points(both, inspection), points(alone, inspection))
    np.testing.assert_array_equal(points(both, Inspection.PLAIN), points(alone, Inspection.QUICK))
    mirrored = both.detect_once(crop, roi, CAMERA, mirrored=True).xy_px
    np.testing.assert_array_equal(points(both, Inspection.MIRRORED), mirrored)
