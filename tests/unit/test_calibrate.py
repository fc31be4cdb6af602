"""`pbl calibrate` against a lens that is known: films of a board rendered ray by ray."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from pbl_pipeline.video import Board, calibrate_video, load_camera
from pbl_pipeline.video.calibrate import View, calibrate, covered, different_views
from tests import not_none, refused
from tests.board_video import film, varied_poses
from tests.command import pbl
from tests.videos import constant_rate, numbered_frames, write_video

pytestmark = pytest.mark.slow

SIZE = (640, 360)
MATRIX = np.array([[472.0, 0, 316], [0, 474, 183], [0, 0, 1]])
DISTORTION = np.array([0.12, -0.3, 0.001, -0.0008, 0.2])
CHARUCO = Board("charuco", (9, 6), 30.0)
BOARDS = {"checkerboard": Board("checkerboard", (9, 6), 30.0), "charuco": CHARUCO}


def held(frames):
    """Each picture for two frames, as of a board that is held still."""
    return [f for f in frames for _ in range(2)]


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    paths = {}
    for kind, board in BOARDS.items():
        frames = held(film(board, MATRIX, DISTORTION, SIZE, varied_poses(board, MATRIX, SIZE, 30)))
        paths[kind] = write_video(folder / f"{kind}.mp4", frames, constant_rate(len(frames), 10), crf=22)
    return paths


def seen(board: Board, poses: list, noise_px: float = 0.0, seed: int = 5) -> list[View]:
    """Views without pictures: corners projected through the lens, those outside the picture left out."""
    rng = np.random.default_rng(seed)
    views = []
    middle = np.array([*board.squares, 0]) * board.square_mm / 2000 - np.array([1, 1, 0]) * board.square_mm / 1000
    for k, (R, t) in enumerate(poses):
        points = (board.corners_m - middle) @ R.T + t
        xy, _ = cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), MATRIX, DISTORTION)
        xy = xy.reshape(-1, 2) + noise_px * rng.standard_normal((len(points), 2))
        inside = np.all((xy >= 0) & (xy <= np.array(SIZE) - 1), axis=1)
        if inside.sum() >= 8:
            views.append(View(k, np.flatnonzero(inside), xy[inside]))
    return views


# --- videos


@pytest.mark.parametrize("kind", BOARDS)
def test_a_known_lens_comes_back(videos, tmp_path, kind):
    out = tmp_path / "camera.json"
    done = pbl("calibrate", videos[kind], "--board", kind, "--squares", "9x6", "--square-mm", "30", "--out", out)
    assert done.code == 0, done.err
    camera = load_camera(out, SIZE)
    np.testing.assert_allclose(np.diag(camera.matrix)[:2], [472, 474], rtol=0.005)
    np.testing.assert_allclose(camera.matrix[:2, 2], [316, 183], atol=2.0)
    assert 0 < camera.focal_rel_sd < 0.005
    # What matters is where points end up, over the whole picture; a common shift is a turn of the camera.
    grid = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.35, 0.35, 7)), -1).reshape(-1, 2)
    rays = np.column_stack([grid, np.ones(len(grid))]).reshape(-1, 1, 3)
    none = np.zeros(3)
    true, _ = cv2.projectPoints(rays, none, none, MATRIX, DISTORTION)
    found, _ = cv2.projectPoints(rays, none, none, camera.matrix, camera.distortion)
    off = (found - true).reshape(-1, 2)
    assert np.abs(off - off.mean(axis=0)).max() < 1.0
    content = json.loads(out.read_text())
    assert content["n_views"] >= 8
    assert content["rms_px"] < 0.5
    assert content["coverage"] >= 0.5
    assert content["video"]["name"] == f"{kind}.mp4"
    assert f"{content['n_views']} views used" in done.out
    assert not_none(cv2.imread(str(out.with_suffix(".png")))).shape[1] == 900


def test_a_video_without_a_board(tmp_path):
    path = write_video(tmp_path / "walk.mp4", numbered_frames(30, 240, 320), constant_rate(30))
    for board in BOARDS.values():
        assert "squares are counted" in refused("CALIBRATION_NO_BOARD", calibrate_video, path, board).next_step


def test_corners_counted_instead_of_squares(videos):
    board = Board("checkerboard", (8, 5), 30.0)
    assert "9x6 squares" in refused("CALIBRATION_NO_BOARD", calibrate_video, videos["checkerboard"], board).next_step


def test_the_wrong_kind_of_board(videos):
    refused("CALIBRATION_NO_BOARD", calibrate_video, videos["checkerboard"], CHARUCO)


# --- views that do not determine a lens


def test_too_few_views():
    views = seen(CHARUCO, varied_poses(CHARUCO, MATRIX, SIZE, 34))[:7]
    assert "7 usable views" in refused("CALIBRATION_FEW_VIEWS", calibrate, views, CHARUCO, SIZE).found


def test_poor_coverage():
    poses = [(R, np.array([0, 0, 2.0 * t[2]])) for R, t in varied_poses(CHARUCO, MATRIX, SIZE, 30)]
    assert "corners in" in refused("CALIBRATION_POOR", calibrate, seen(CHARUCO, poses, 0.1), CHARUCO, SIZE).found


def test_no_tilt():
    views = seen(CHARUCO, varied_poses(CHARUCO, MATRIX, SIZE, 40, tilt_deg=0), 0.1)
    error = refused("CALIBRATION_POOR", calibrate, views, CHARUCO, SIZE)
    assert "tilt" in error.found or "focal length" in error.found


def test_a_board_of_other_proportions():
    """Squares printed 6 % longer one way (a printer that fits to the page): no lens explains them."""
    stretched = [
        View(v.frame, v.ids, v.xy_px + 12 * np.sin(3 * np.column_stack([v.ids % 8, v.ids // 8])))
        for v in seen(CHARUCO, varied_poses(CHARUCO, MATRIX, SIZE, 34))
    ]
    assert "off the fitted lens" in refused("CALIBRATION_POOR", calibrate, stretched, CHARUCO, SIZE).found


# --- what the figures mean


def test_the_stated_deviation_is_the_actual_one():
    poses = varied_poses(CHARUCO, MATRIX, SIZE, 24)
    found = [calibrate(seen(CHARUCO, poses, 0.3, seed), CHARUCO, SIZE) for seed in range(10)]
    focal = np.array([c.camera.focal_px for c in found])
    stated = np.mean([c.focal_sd_px for c in found])
    assert abs(focal.mean() - 473) < 3 * stated
    # The larger of two estimates: not below the truth, and not far above.
    assert 0.6 < stated / focal.std(ddof=1) < 4


def test_one_bad_view_is_left_out():
    views = seen(CHARUCO, varied_poses(CHARUCO, MATRIX, SIZE, 30), 0.1)
    rng = np.random.default_rng(2)
    bad = View(999, views[3].ids, views[3].xy_px + 15 * rng.standard_normal(views[3].xy_px.shape))
    found = calibrate([*views, bad], CHARUCO, SIZE)
    assert 999 not in [v.frame for v in found.views]
    assert found.camera.focal_px == pytest.approx(473, rel=0.003)


def test_views_are_chosen_for_their_difference():
    poses = varied_poses(CHARUCO, MATRIX, SIZE, 20)
    views = seen(CHARUCO, poses * 5, 0.05)
    chosen = different_views(views, SIZE, 20)
    assert len(chosen) == 20
    assert covered(chosen, SIZE) >= 0.95 * covered(views, SIZE)
    assert len({v.frame % 20 for v in chosen}) >= 15


def test_corners_on_one_line_are_no_view(monkeypatch):
    """They see a plane of any tilt, so the views would seem to be tilted."""
    view = seen(CHARUCO, varied_poses(CHARUCO, MATRIX, SIZE, 1))[0]

    def find(ids: np.ndarray):
        answer = (view.xy_px[ids].reshape(-1, 1, 2), ids.reshape(-1, 1), None, None)
        monkeypatch.setattr(
            "pbl_pipeline.video.boards._detector", lambda _: SimpleNamespace(detectBoard=lambda _: answer)
        )
        return CHARUCO.find(np.zeros((4, 4), np.uint8))

    along = CHARUCO.squares[0] - 1
    assert find(np.arange(along)) is None
    np.testing.assert_array_equal(not_none(find(np.arange(along + 1)))[1], view.xy_px[: along + 1])


def test_boards_that_cannot_be():
    for bad in (
        {"kind": "circles"},
        {"squares": (3, 6)},
        {"square_mm": 0.0},
        {"square_mm": float("nan")},
        {"kind": "charuco", "marker_mm": 30.0},
        {"kind": "charuco", "dictionary": "DICT_1"},
        {"kind": "charuco", "squares": (40, 40), "dictionary": "DICT_4X4_50"},
    ):
        refused("USAGE", Board, **{"kind": "checkerboard", "squares": (9, 6), "square_mm": 30.0, **bad})


@pytest.mark.parametrize("squares", ["9x" + "6" * 5000, "9", "9x6x5", "-9x6"])
def test_squares_that_are_no_numbers_are_wrong_usage(squares, tmp_path):
    done = pbl("calibrate", "a.mov", "--board", "charuco", "--squares", squares, "--square-mm", "30", "--out", tmp_path)
    assert (done.code, "INTERNAL" in done.err) == (2, False)
