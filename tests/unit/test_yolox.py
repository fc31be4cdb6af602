"""YOLOX as a registered person detector: decoding by hand, the real model where it is, and bad model folders."""

import hashlib
import json
import shutil
import types
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from pbl_pipeline import models
from pbl_pipeline.cli.detect import detect
from pbl_pipeline.errors import PblError
from pbl_pipeline.tracking import (
    METHODS,
    YoloxDetector,
    choose_subject,
    detector_params,
    track_people,
)
from pbl_pipeline.tracking.tiling import detect_in
from pbl_pipeline.tracking.yolox import decode, grid
from pbl_pipeline.video import read_frames
from tests import refused
from tests.dot_models import changed
from tests.videos import constant_rate, write_video

# --- decoding -----------------------------------------------------------------------------------------------------


def test_grid_has_a_row_for_each_cell_of_three_strides():
    cells, strides = grid(416, 416)
    assert len(cells) == 52**2 + 26**2 + 13**2 == 3549
    np.testing.assert_array_equal(cells[[0, 1, 52, 2704, 3548]], [[0, 0], [1, 0], [0, 1], [0, 0], [12, 12]])
    np.testing.assert_array_equal(strides[[0, 2703, 2704, 3380]].ravel(), [8, 8, 16, 32])


def rows(*people: tuple[int, tuple[float, float], tuple[float, float], float, list[float]]) -> np.ndarray:
    """Output rows (3549, 5 + 3): (row, offset, size in strides, objectness, classes) of each; nothing elsewhere."""
    out = np.zeros((3549, 8), np.float32)
    for row, offset, size, objectness, classes in people:
        out[row] = [*offset, *np.log(size), objectness, *classes]
    return out


def test_decode_by_hand():
    found = rows(
        # Row 2704 + 26 + 2: cell (2, 1) of stride 16: centre ((2 + 0.5) 16, (1 + 0.25) 16) = (40, 20), 32 x 64 px.
        (2732, (0.5, 0.25), (2, 4), 0.9, [0.8, 0.1, 0.0]),
        (100, (0, 0), (1, 1), 0.9, [0.3, 0.9, 0.0]),  # more likely something else
        (200, (0, 0), (1, 1), 0.5, [0.5, 0.0, 0.0]),  # 0.25: too unsure
    )
    boxes, scores = decode(found, 416, 416, 0.3)
    np.testing.assert_allclose(boxes, [[24, -12, 56, 52]], atol=1e-4)
    np.testing.assert_allclose(scores, [0.72], rtol=1e-6)


class Fixed:
    """Stands in for `OnnxModel`: gives the same rows, and keeps what it was shown."""

    def __init__(self, output: np.ndarray, kind: str = "person_detector") -> None:
        entry = types.SimpleNamespace(width=416, height=416)
        self.spec = types.SimpleNamespace(kind=kind, input=entry, name="fixed", sha256="0" * 64)
        self.folder = Path("fixed")
        self._output = output

    def __call__(self, pictures: np.ndarray) -> dict[str, np.ndarray]:
        self.shown = pictures
        return {"boxes": self._output[None]}


def detector(*args, **kwargs) -> tuple[YoloxDetector, Fixed]:
    model = Fixed(rows(*args), **kwargs)
    return YoloxDetector(model), model  # type: ignore[arg-type]


def test_boxes_come_back_in_pixels_of_the_picture_and_once():
    """A picture of 832 x 416 is shown at half the size in the upper half; two boxes of one person overlap."""
    person = (2732, (0.5, 0.25), (2, 4), 0.9, [0.8, 0.1, 0.0])
    double = (2733, (-0.4, 0.25), (2, 4), 0.9, [0.7, 0.1, 0.0])
    other = (3000, (0.0, 0.0), (1, 2), 0.9, [0.5, 0.1, 0.0])
    finder, model = detector(double, other, person)
    image = np.full((416, 832, 3), 50, np.uint8)
    found = finder.detect(image)
    assert [round(d.score, 2) for d in found] == [0.72, 0.45]
    np.testing.assert_allclose(found[0].box_px, np.array([48, -24, 112, 104]) - 0.5, atol=1e-3)
    assert all(np.isnan(d.roi_px).all() for d in found)
    assert (model.shown[0, :208] == 50).all()
    assert (model.shown[0, 208:] == 114).all()
    assert detector()[0].detect(image) == []


def test_a_box_that_its_window_cuts_does_not_count():
    """In a window whose right edge lies inside the picture the box ends at that edge: the person goes on."""
    at_edge = (2732 + 23, (0.9, 0.25), (2, 4), 0.9, [0.9, 0.1, 0.0])  # its right edge at 414 of 416
    finder, _ = detector(at_edge)
    image = np.zeros((416, 832, 3), np.uint8)
    assert detect_in(finder, image, [(0, 0, 416, 416)]) == []
    assert len(detect_in(finder, image[:, :416], [(0, 0, 416, 416)])) == 1


def test_models_of_another_kind_or_shape_are_refused():
    def load(output, **kwargs):
        YoloxDetector(Fixed(output, **kwargs))  # type: ignore[arg-type]

    assert "kind heatmap" in refused("MODEL_INVALID", load, rows(), kind="heatmap").found
    assert "one row for each grid cell" in refused("MODEL_INVALID", load, np.zeros((2100, 85), np.float32)).expected
    refused("MODEL_INVALID", load, np.zeros((3549, 5), np.float32))


# --- the real model ----------------------------------------------------------------------------------------------


@pytest.fixture
def registry(tmp_path, environment) -> Path:
    environment(PBL_MODELS=tmp_path / "models")
    return tmp_path / "models"


SPEC = {
    "name": "yolox-nano",
    "kind": "person_detector",
    "licence": "Apache-2.0",
    "source": "YOLOX nano, Megvii; Kazuhito00/YOLOX-ONNX-TFLite-Sample 3d4f111",
    "input": {
        "name": "images",
        "width": 416,
        "height": 416,
        "layout": "NCHW",
        "colour": "BGR",
        "mean": [0, 0, 0],
        "std": [1, 1, 1],
    },
    "outputs": {"boxes": "output"},
}


@pytest.fixture
def folder(shared_data, tmp_path) -> Path:
    """YOLOX nano as a model's folder, as docs/models.md describes it."""
    path = tmp_path / "yolox"
    path.mkdir()
    shutil.copyfile(shared_data / "real" / "models" / "yolox_nano.onnx", path / "model.onnx")
    sha256 = hashlib.sha256((path / "model.onnx").read_bytes()).hexdigest()
    (path / "model.json").write_text(json.dumps(SPEC | {"sha256": sha256}))
    return path


@pytest.mark.long
@pytest.mark.slow
def test_the_walker_of_a_real_clip(folder, registry, shared_data, tmp_path):
    models.add(folder)
    method = METHODS.find("yolox-nano")
    assert (method.name, method.version, method.params.model) == ("yolox-nano", 1, "yolox-nano")
    video = shared_data / "real" / "video_mocap" / "walk" / "video.mp4"
    half = (cv2.resize(f.image, (360, 640)) for f in read_frames(video, step=2))
    path = write_video(tmp_path / "half.mp4", half, constant_rate(38))
    tracking = track_people(path, method)
    choice = choose_subject(tracking)
    assert (tracking.detector, choice.status, choice.person_id) == ("yolox-nano", "CHOSEN", 1)
    box = tracking.persons[0].box_px
    # By eye, in pixels of the whole picture: in frame 60 from 221, 533 to 439, 1074.
    np.testing.assert_allclose(2 * box[30], [221, 533, 439, 1074], atol=30)
    assert np.isfinite(box).all()
    assert np.isnan(tracking.persons[0].roi_px).all()


@pytest.mark.long
def test_the_command_takes_a_registered_detector_and_says_its_licence(folder, registry, shared_data, tmp_path):
    models.add(folder)
    video = shared_data / "real" / "video_mocap" / "walk" / "video.mp4"
    # Without the assets of BlazePose no keypoints: only the words before them are asked for.
    result = CliRunner().invoke(detect, [str(video), "--out", str(tmp_path / "k.npz"), "--people", "yolox-nano"])
    assert "people by the model yolox-nano, licence: Apache-2.0" in result.output
    none = CliRunner().invoke(detect, [str(video), "--out", str(tmp_path / "k.npz"), "--people", "yolo"])
    assert isinstance(none.exception, PblError)
    assert none.exception.code == "SOLVER_UNKNOWN"
    assert "yolox-nano" in none.exception.expected


@pytest.mark.slow
def test_bad_folders_and_changed_models(folder, registry, shared_data):
    video = shared_data / "real" / "video_mocap" / "walk" / "video.mp4"
    refused("MODEL_CHECKSUM", models.add, changed(folder, sha256="0" * 64))
    good = hashlib.sha256((folder / "model.onnx").read_bytes()).hexdigest()
    refused("MODEL_INVALID", models.add, changed(folder, sha256=good, outputs={"boxes": "rows"}))
    refused("MODEL_INVALID", models.add, changed(folder, outputs={"heatmap": "output"}))
    refused("MODEL_INVALID", models.add, changed(folder, outputs={"boxes": "output"}, joint_names=["hip"]))
    models.add(changed(folder, joint_names=None))
    params = detector_params("yolox-nano")
    # The lab registers another spec under the name: the old method does not run on it.
    models.add(changed(folder, comment="the same numbers"), replace=True)
    track_people(video, params)
    entry = SPEC["input"] | {"colour": "RGB"}
    models.add(changed(folder, input=entry), replace=True)
    assert "model.json" in refused("MODEL_CHECKSUM", track_people, video, params).found
    models.remove("yolox-nano")
    refused("MODEL_MISSING", track_people, video, params)
    refused("MODEL_MISSING", detector_params, "yolox-nano")
    refused("SOLVER_UNKNOWN", METHODS.find, "yolox-nano")
