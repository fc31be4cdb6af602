"""Laboratory markers, TRC files, and one trial seen by several cameras."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pbl_pipeline import pipeline
from pbl_pipeline.body import load_marker_set
from pbl_pipeline.cli.options import fit_paramset
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import GaussNewtonParams, ImplicitAdamParams, Params, default_fit, points_of
from pbl_pipeline.keypoints import (
    METHODS,
    MOST_MISS_M,
    Keypoints,
    ModelKeypointParams,
    ModelParams,
    MultiView,
    WorldMarkers,
    cameras_of_files,
    check_views_agree,
    ray_miss_m,
)
from pbl_pipeline.methods import Stage
from pbl_pipeline.video import Camera, CameraPose, load_attitude, load_camera, load_camera_poses
from tests import SHARED, StandIn
from tests.command import Done, pbl
from tests.inputs import (
    CALIBRATION,
    LENS,
    LEVEL,
    NAMES,
    PHONE_T,
    POSE,
    ROWS,
    UPRIGHT,
    J,
    T,
    about,
    changed,
    csv_log,
    keypoints,
    markers,
    rewritten,
    trc_text,
)
from tests.integration import chain


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    (tmp_path / "Calib.toml").write_text(CALIBRATION)
    return tmp_path / "Calib.toml"


# --- markers of a laboratory ------------------------------------------------------------------------------------


def test_markers_go_through_a_file(tmp_path):
    xyz, confidence = markers().xyz_world_m.copy(), np.ones((T, J))
    xyz[2, 1], confidence[2, 1] = np.nan, 0
    seen = markers(xyz_world_m=xyz, confidence=confidence)
    seen.save(tmp_path / "m.npz")
    again = WorldMarkers.load(tmp_path / "m.npz")
    np.testing.assert_allclose(again.xyz_world_m, xyz, rtol=1e-6)
    np.testing.assert_array_equal(again.confidence, confidence)
    np.testing.assert_array_equal(again.time_s, seen.time_s)
    assert (again.names, again.marker_set) == (NAMES, "lab")


@pytest.mark.parametrize(
    "changes",
    [
        {"xyz_world_m": np.zeros((T, J, 2))},
        {"xyz_world_m": changed(np.zeros((T, J, 3)), np.inf)},
        {"xyz_world_m": changed(np.zeros((T, J, 3)), np.nan)},  # with confidence 1
        {"xyz_world_m": np.full((T, J, 3), "x")},
        {"confidence": np.ones(T)},
        {"confidence": changed(np.ones((T, J)), 1.1)},
        {"confidence": changed(np.ones((T, J)), -0.1)},
        {"confidence": changed(np.ones((T, J)), np.nan)},
        {"time_s": changed(np.arange(T), np.nan)},
        {"names": ("A", "B", "A")},
        {"names": ("A", "B")},
        {"names": (), "xyz_world_m": np.zeros((T, 0, 3)), "confidence": np.zeros((T, 0))},
        {"time_s": np.zeros(0), "xyz_world_m": np.zeros((0, J, 3)), "confidence": np.zeros((0, J))},
    ],
)
def test_markers_that_cannot_be(changes):
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        markers(**changes)


@pytest.mark.parametrize("lost", ["time_s", "names", "marker_set", "xyz_world_m", "confidence"])
def test_a_file_of_markers_needs_all_its_fields(tmp_path, lost):
    markers().save(tmp_path / "m.npz")
    less = rewritten(tmp_path / "m.npz", lost)
    with pytest.raises(PblError, match=r"^FILE_FORMAT: ") as error:
        WorldMarkers.load(less)
    assert lost in error.value.found
    assert less.name in str(error.value.key)


def test_markers_are_put_into_the_order_of_a_set():
    chosen = markers().select(("C", "X", "A"), "mine")
    assert (chosen.names, chosen.marker_set) == (("C", "X", "A"), "mine")
    np.testing.assert_array_equal(chosen.xyz_world_m[:, 0], markers().xyz_world_m[:, 2])
    np.testing.assert_array_equal(chosen.xyz_world_m[:, 2], markers().xyz_world_m[:, 0])
    assert np.isnan(chosen.xyz_world_m[:, 1]).all()
    assert chosen.confidence.tolist() == [[1, 0, 1]] * T
    with pytest.raises(PblError, match=r"^MARKER_SET_UNKNOWN: "):
        markers().select(("X", "Y"))


# --- TRC --------------------------------------------------------------------------------------------------------


def trc(tmp_path: Path, *args, up: str = "y", **more) -> WorldMarkers:
    (tmp_path / "walk.trc").write_text(trc_text(*args, **more))
    return WorldMarkers.from_trc(tmp_path / "walk.trc", "lab", up)


def test_a_trc_file_by_hand(tmp_path):
    seen = trc(tmp_path, ROWS)
    assert (seen.names, seen.marker_set) == (("Hip", "Head"), "lab")
    np.testing.assert_allclose(seen.time_s, [0, 0.01, 0.02])
    # x stays forward, up (y) becomes z, right (z) becomes -y: right-handed.
    np.testing.assert_allclose(seen.xyz_world_m[0], [[0.1, -0.2, 0.9], [0.11, -0.21, 1.6]])
    # Empty cells and three zeros are gaps.
    assert seen.confidence.tolist() == [[1, 1], [1, 0], [1, 0]]
    assert np.isnan(seen.xyz_world_m[1:, 1]).all()


@pytest.mark.parametrize(("units", "factor"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("M", 1.0)])
def test_units_and_upright_axis_of_a_trc_file(tmp_path, units, factor):
    seen = trc(tmp_path, ["1\t0\t1\t2\t3\t4\t5\t6"], units, up="z")
    np.testing.assert_allclose(seen.xyz_world_m[0], factor * np.array([[1.0, 2, 3], [4, 5, 6]]))


@pytest.mark.parametrize(
    ("rows", "more"),
    [
        (ROWS, {"units": "ft"}),
        (ROWS, {"units": ""}),
        (ROWS, {"n_frames": 4}),
        (ROWS, {"names": "Hip\t\t\t\t\t"}),
        (ROWS, {"names": "Hip\t\t\tHip\t\t"}),
        ([], {}),
        ([ROWS[0][:-4]], {}),  # cut off: a number shorter is not seen, a cell less is
        (["1\t0.00\t100\t900\t200\t110\t1600"], {}),
        ([ROWS[0] + "\t5"], {}),
        ([ROWS[0].replace("900", "9o0")], {}),
        ([ROWS[0].replace("900", "inf")], {}),
        ([ROWS[0], ROWS[0]], {}),
        ([ROWS[1], ROWS[0]], {}),
        ([ROWS[0].replace("0.00", "")], {}),
    ],
)
def test_damaged_trc_files(tmp_path, rows, more):
    with pytest.raises(PblError, match=r"^FILE_FORMAT: ") as error:
        trc(tmp_path, rows, **more)
    assert "walk.trc" in str(error.value.key)


def test_files_that_are_no_trc(tmp_path):
    (tmp_path / "text.trc").write_text("hello\n" * 9)
    (tmp_path / "bytes.trc").write_bytes(bytes(range(256)) * 20)
    (tmp_path / "empty.trc").touch()
    for name in ("text", "bytes", "empty"):
        with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
            WorldMarkers.from_trc(tmp_path / f"{name}.trc", "lab")
    with pytest.raises(PblError, match=r"^FILE_MISSING: "):
        WorldMarkers.from_trc(tmp_path / "no.trc", "lab")
    with pytest.raises(PblError, match=r"^USAGE: "):
        trc(tmp_path, ROWS, up="x")


@pytest.mark.parametrize("units", ["m", "mm"])
def test_a_wrong_unit_is_noticed(tmp_path, units):
    """Three markers over 1.7 m, once written in mm and called m, once the other way round."""
    size = 1.7 if units == "mm" else 1700.0
    row = "\t".join(f"{v:g}" for v in (1, 0, 0, 0, 1, 0, size / 2, 0, 0, size, 0.1))
    text = trc_text([row], units, names="A\t\t\tB\t\t\tC\t\t").replace("\t2\t" + units, "\t3\t" + units)
    (tmp_path / "w.trc").write_text(text)
    with pytest.raises(PblError) as error:
        WorldMarkers.from_trc(tmp_path / "w.trc", "lab")
    assert "m apart if Units" in error.value.found


@pytest.mark.skipif(not SHARED.is_dir(), reason="the development data (../shared/data) is absent")
def test_real_trc_files():
    walk = WorldMarkers.from_trc(SHARED / "real" / "marker_ik" / "walking1.trc", "lab")
    assert walk.xyz_world_m.shape == (131, 51, 3)
    np.testing.assert_allclose(walk.xyz_world_m[0, 0], [-0.297591, 0.264781, 1.41067])  # C7, first row of the file
    at = {n: np.nanmean(walk.xyz_world_m[:, i], axis=0) for i, n in enumerate(walk.names)}
    # She walks along +x, so her right is -y; her neck is above her hips, these above her heels.
    assert np.diff(walk.xyz_world_m[[0, -1], 0, 0])[0] > 1
    assert at["L.ASIS"][1] > at["R_HJC"][1]
    assert at["C7"][2] > at["L.ASIS"][2] > at["L_calc"][2] > 0
    files = sorted((SHARED / "real").glob("m*/*.trc"))
    assert len(files) == 8
    for path in files:
        seen = WorldMarkers.from_trc(path, "lab")
        assert seen.confidence.mean() > 0.95, path.name
        assert 1.3 < np.nanmax(seen.xyz_world_m[..., 2]) < 1.9, path.name


# --- several cameras --------------------------------------------------------------------------------------------


def test_views_of_one_trial():
    views = MultiView((keypoints(), keypoints(time_s=np.arange(T) / 30 + 0.0009)), (POSE, POSE))
    assert (views.names, views.marker_set, len(views.time_s)) == (NAMES, "lab", T)


@pytest.mark.parametrize(
    "other",
    [
        {"time_s": np.arange(T) / 30 + 0.0011},
        {"time_s": changed(np.arange(T) / 30, np.nan)},
        {"names": ("A", "C", "B")},
        {"marker_set": "other"},
    ],
)
def test_views_that_do_not_belong_together(other):
    with pytest.raises(PblError, match=r"^FIT_INPUT: "):
        MultiView((keypoints(), keypoints(**other)), (POSE, POSE))


def looking(x: float, z: float, distance: float = 4.0) -> tuple[Keypoints, CameraPose]:
    """A camera `distance` behind the origin that looks along world +y, and turned by 90 degrees for x: it sees all
    points at (x, 0, z)."""
    xy = np.broadcast_to(LENS.matrix[:2, 2] + LENS.matrix[0, 0] / distance * np.array([x, -z]), (T, J, 2))
    return keypoints(xy_px=xy), CameraPose(LEVEL_Y, np.array([0.0, -distance, 0.0]))


#: Columns: right is +x, down -z, forward +y of the world; and for a camera that looks along -x.
LEVEL_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
LEVEL_X = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])


def test_rays_that_meet_and_rays_that_miss():
    """Two cameras at right angles: heights that differ by 2 d at the crossing miss by d each, and by c1, c2 as the
    weights say."""
    front, front_pose = looking(0.0, 0.0)
    for up, miss in ((0.0, 0.0), (0.08, 0.04), (0.3, 0.15)):
        side, _ = looking(0.0, up)
        side_pose = CameraPose(LEVEL_X, np.array([4.0, 0.0, 0.0]))
        trial = MultiView((front, side), (front_pose, side_pose), ("left", "right"))
        # The side's ray climbs: its nearest point lies a little off the crossing, at cos of its slope.
        slope = np.arctan2(up, 4.0)
        np.testing.assert_allclose(ray_miss_m(trial), miss * np.cos(slope), atol=1e-6)
        if miss <= MOST_MISS_M:
            assert check_views_agree(trial, "walk") == pytest.approx(miss * np.cos(slope), abs=1e-6)
            continue
        with pytest.raises(PblError, match="VIEWS_DISAGREE") as error:
            check_views_agree(trial, "walk")
        assert "left 15 cm, right 15 cm" in error.value.found
    doubted = MultiView((keypoints(xy_px=front.xy_px, confidence=np.full((T, J), 0.25)), side), (front_pose, side_pose))
    np.testing.assert_allclose(ray_miss_m(doubted), 0.3 * np.cos(slope) * np.array([0.8, 0.2]), atol=1e-6)
    # A place behind a camera is not what it sees; and where no point is seen twice nothing is compared.
    away = MultiView((front, side), (front_pose, CameraPose(LEVEL_X, np.array([-4.0, 0.0, 0.0]))))
    assert ray_miss_m(away)[1] > 3.0
    blind = MultiView((front, keypoints(confidence=np.zeros((T, J)))), (front_pose, side_pose))
    assert np.isnan(ray_miss_m(blind)).all()
    assert np.isnan(check_views_agree(blind, "walk"))


def test_too_few_views_or_poses():
    with pytest.raises(PblError, match=r"^FIT_INPUT: "):
        MultiView((keypoints(),), (POSE,))
    with pytest.raises(PblError, match=r"^CAMERA_INVALID: "):
        MultiView((keypoints(), keypoints()), (POSE,))
    shorter = {k: getattr(keypoints(), k)[:-1] for k in ("time_s", "xy_px", "xyz_cam_m", "confidence", "box_px")}
    with pytest.raises(PblError, match=r"(?s)^FIT_INPUT: .*4 frames"):
        MultiView((keypoints(), keypoints(**shorter)), (POSE, POSE))


@pytest.mark.parametrize(
    ("R", "p"),
    [
        (1.01 * np.eye(3), np.zeros(3)),
        (np.diag([1.0, 1, -1]), np.zeros(3)),
        (np.zeros((3, 3)), np.zeros(3)),
        (changed(np.eye(3), np.nan), np.zeros(3)),
        (np.eye(3), np.array([0, np.inf, 0])),
        (np.eye(3), np.zeros(2)),
        (np.eye(4), np.zeros(3)),
        (np.full((3, 3), "x"), np.zeros(3)),
    ],
)
def test_poses_that_cannot_be(R, p):
    with pytest.raises(PblError, match=r"^CAMERA_INVALID: "):
        CameraPose(R, p)


def test_poses_by_hand(calibration):
    poses = load_camera_poses(calibration)
    assert list(poses) == ["cam_01", "cam_02"]
    # x_cam = Rx(90) x_world + (0, 1.5, 4): the camera looks along world +y from 4 m behind and 1.5 m above the origin.
    np.testing.assert_allclose(poses["cam_01"].R_nc[:, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(poses["cam_01"].R_nc[:, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(poses["cam_01"].p_nc, [0, -4, 1.5], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rotation = [0, 0, 0]", ""),
        ("rotation = [0, 0, 0]", "rotation = [0, 0]"),
        ("rotation = [0, 0, 0]", "rotation = 3"),
        ("translation = [0, 0, 2]", "translation = [0, 0, nan]"),
        ("translation = [0, 0, 2]", "translation = 'far'"),
        ("[cam_01]", "[cam_01"),
        ("matrix", "other"),
    ],
)
def test_calibrations_that_cannot_be(calibration, old, new):
    calibration.write_text(CALIBRATION.replace(old, new))
    with pytest.raises(PblError, match=r"^CAMERA_INVALID: "):
        load_camera_poses(calibration)


def test_files_find_their_cameras(calibration):
    assert cameras_of_files(["cam_02", "Cam01"], calibration) == ("trial", ["cam_02", "cam_01"])
    assert cameras_of_files(["walk.cam_01", "walk.cam_02"], calibration) == ("walk", ["cam_01", "cam_02"])
    assert cameras_of_files(["left", "right"], calibration) == ("trial", ["cam_01", "cam_02"])
    for stems in (["cam_01", "right"], ["cam_01", "cam_01"], ["a", "b", "c"], ["a"]):
        with pytest.raises(PblError, match=r"^CAMERA_INVALID: "):
            cameras_of_files(stems, calibration)


def test_lenses_come_from_the_calibration(calibration):
    views = MultiView.from_calibration(
        [keypoints(image_size_px=(500, 500)), keypoints()], calibration, ["cam_02", "cam_01"]
    )
    assert [v.camera.matrix[0, 2] for v in views.views] == [250, 500]
    assert views.poses[0].p_nc.tolist() == [0, 0, -2]
    with pytest.raises(PblError, match=r"^CAMERA_INVALID: "):
        MultiView.from_calibration([keypoints(), keypoints()], calibration, ["cam_01", "cam_09"])


#: Column of each marker of the TRC file (hips and legs right, left; neck, head, nose; arms right, left) in OpenPose's
#: BODY_25B.
IN_BODY_25B = [12, 14, 16, 22, 23, 24, 11, 13, 15, 19, 20, 21, 17, 18, 0, 6, 8, 10, 5, 7, 9]


@pytest.mark.skipif(not SHARED.is_dir(), reason="the development data (../shared/data) is absent")
def test_poses_of_a_real_calibration_triangulate_to_its_markers():
    """The 2D points of four cameras meet where the TRC of the same recording has its markers."""
    folder = SHARED / "real" / "multiview"
    truth = WorldMarkers.from_trc(folder / "S00_P00_T01_BalancingTrial_0-100.trc", "body_25b")
    assert [truth.names[i] for i in (0, 5, 6, 14, 17)] == ["RHip", "RHeel", "LHip", "Nose", "RWrist"]
    poses = load_camera_poses(folder / "Calib_qualisys.toml")
    # from_trc keeps the file's x; the cameras' world is turned by 90 degrees about the vertical.
    in_world = np.stack([-truth.xyz_world_m[..., 1], truth.xyz_world_m[..., 0], truth.xyz_world_m[..., 2]], axis=-1)
    seen = np.load(folder / "openpose_body25b_2d.npz")
    lines, weights, median_px = [], [], []
    for number, (name, pose) in enumerate(poses.items(), 1):
        camera = load_camera(folder / "Calib_qualisys.toml", (1088, 1920), name)
        x_cam = (in_world - pose.p_nc) @ pose.R_nc
        uv = cv2.projectPoints(x_cam.reshape(-1, 3), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0]
        people = seen[f"cam{number:02d}"][:, :, IN_BODY_25B]
        away = np.linalg.norm(people[..., :2] - uv.reshape(len(people), 1, -1, 2), axis=-1)
        away = np.where(people[..., 2] > 0.3, away, np.nan)
        enough = np.sum(np.isfinite(away), axis=2, keepdims=True) > 5
        chosen = np.nanmedian(np.where(enough, away, np.inf), axis=2).argmin(axis=1)
        frames = np.arange(len(people))
        median_px.append(np.nanmedian(away[frames, chosen]))
        points = people[frames, chosen]
        flat = cv2.undistortPoints(points[..., :2].reshape(-1, 1, 2).astype(float), camera.matrix, camera.distortion)
        R_cn = pose.R_nc.T
        projection = np.column_stack([R_cn, -R_cn @ pose.p_nc])
        xy = flat.reshape(*points.shape[:2], 2)
        lines.append(xy[..., None] * projection[2] - projection[:2])
        weights.append(np.where(points[..., 2] > 0.3, points[..., 2], 0.0))
    assert max(median_px) < 20  # the other direction of the poses is off by 2000 px and more
    used = np.sum(np.array(weights) > 0, axis=0) >= 3
    equations = np.concatenate([w[..., None, None] * line for w, line in zip(weights, lines, strict=True)], axis=2)
    points = np.linalg.svd(equations)[2][..., -1, :]
    met = points[..., :3] / points[..., 3:]
    assert used.mean() > 0.9
    assert np.median(np.linalg.norm(met - in_world, axis=-1)[used]) < 1e-3


# --- keypoints of other programs


def test_keypoints_of_another_program_need_only_what_is_needed(tmp_path):
    rng = np.random.default_rng(0)
    whole = keypoints(xy_px=rng.uniform(0, 1000, (T, J, 2)), confidence=changed(np.ones((T, J)), 0.0))
    whole.save(tmp_path / "whole.npz")
    assert Keypoints.load(tmp_path / "whole.npz").assumed == ()
    lacking = ("box_px", "distortion", "camera_source")
    other = rewritten(tmp_path / "whole.npz", *lacking, note="written by another program")
    found = Keypoints.load(other)
    assert found.assumed == ("distortion", "camera_source", "box_px")
    assert not found.camera.distortion.any()
    assert not found.camera.calibrated
    seen = whole.xy_px[0, [0, 2]]  # the second point of the first frame has no confidence
    np.testing.assert_allclose(found.box_px[0], [*seen.min(axis=0), *seen.max(axis=0)], rtol=1e-6)
    with np.load(other) as f:
        needed = set(f.files) - {"note"}
    for name in needed:
        with pytest.raises(PblError, match="FILE_FORMAT"):
            Keypoints.load(rewritten(other, name))


def test_a_frame_without_points_has_no_box(tmp_path):
    keypoints(confidence=np.zeros((T, J))).save(tmp_path / "k.npz")
    assert np.isnan(Keypoints.load(rewritten(tmp_path / "k.npz", "box_px")).box_px).all()


@pytest.mark.parametrize("size", [[0, 100], [-5, 100], [100, np.inf], [1e9, 1]])
def test_sizes_of_pictures_that_cannot_be(tmp_path, size):
    keypoints().save(tmp_path / "k.npz")
    with pytest.raises(PblError, match="FILE_FORMAT"):
        Keypoints.load(rewritten(tmp_path / "k.npz", image_size_px=np.array(size, float)))


# --- lenses that no camera has


@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        (LENS.matrix, [1e9, 0, 0, 0, 0]),
        (LENS.matrix, [0, 0, 0, 0, 1e9]),
        (LENS.matrix, [0, 0, 1e9, 0, 0]),
        (LENS.matrix, [-1e9, 0, 0, 0, 0]),
        (LENS.matrix, [np.nan, 0, 0, 0, 0]),
        ([[1000, 9, 500], [0, 1000, 500], [0, 0, 1]], [0, 0, 0, 0, 0]),
        ([[1000, 0, 500], [9, 1000, 500], [0, 0, 1]], [0, 0, 0, 0, 0]),
        ([[1e-3, 0, 500], [0, 1e-3, 500], [0, 0, 1]], [0, 0, 0, 0, 0]),
        ([[1e12, 0, 500], [0, 1e12, 500], [0, 0, 1]], [0, 0, 0, 0, 0]),
        ([[np.inf, 0, 500], [0, 1000, 500], [0, 0, 1]], [0, 0, 0, 0, 0]),
    ],
)
def test_lenses_that_no_camera_has_are_refused_wherever_they_stand(tmp_path, matrix, distortion):
    lens = Camera(np.array(matrix, float), np.array(distortion, float), "test")
    with pytest.raises(PblError, match="CAMERA_INVALID"):
        keypoints(camera=lens)
    if np.isfinite([*np.ravel(matrix), *distortion]).all():
        fields = {"camera_matrix": lens.matrix.tolist(), "distortion": distortion, "image_size_px": [1000, 1000]}
        (tmp_path / "c.json").write_text(json.dumps(fields))
        with pytest.raises(PblError, match="CAMERA_INVALID"):
            load_camera(tmp_path / "c.json", (1000, 1000))


@pytest.mark.parametrize("distortion", [[-0.3, 0.1, 1e-3, -1e-3, 0], [0.25, -0.8, 0, 0, 1.0], [0.1, 0, 0.01, 0.01, 0]])
def test_lenses_of_cameras_are_taken(distortion):
    keypoints(camera=Camera(LENS.matrix, np.array(distortion), "test"))


# --- the commands that read the inputs of the fit: what they hand to it; detection and the fit are stand-ins


@pytest.fixture
def fits(stand_in: StandIn) -> list[dict]:
    """What `fit_session` was called with; the fit is a stand-in."""
    calls: list[dict] = []

    def fit(trials, names, paramset=None, camera_motion="static", **more):
        calls.append({"trials": trials, "names": names, "paramset": paramset, "motion": camera_motion, **more})
        return chain.fit_session(trials, names, paramset)

    stand_in(fit_session=fit)
    return calls


def succeeds(done: Done) -> None:
    assert done.code == 0, done.err


TABLE = "name,body,x,y,z\nHead,head,0,0.1,0\nHip,pelvis,0,0,0.1\nToe,toes_r,0,0,0\n"


def test_pbl_fit_reads_markers(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    (tmp_path / "lab.csv").write_text(TABLE)
    WorldMarkers.from_trc(tmp_path / "walk.trc", "lab").save(tmp_path / "two.npz")
    files = (tmp_path / "walk.trc", tmp_path / "two.npz")
    done = pbl("fit", *files, "--out", tmp_path / "out", "--marker-set", tmp_path / "lab.csv")
    succeeds(done)
    assert "2 of 3 markers of lab" in done.out
    assert "not in the file: Toe" in done.out
    (call,) = fits
    assert (call["names"], call["motion"]) == (["walk", "two"], "static")
    assert call["markers"].names == ("Head", "Hip", "Toe")
    for trial in call["trials"]:
        assert trial.names == ("Head", "Hip", "Toe")
        assert trial.confidence.tolist() == [[1, 1, 0], [0, 1, 0], [0, 1, 0]]
        np.testing.assert_allclose(trial.xyz_world_m[0, 1], [0.1, -0.2, 0.9], atol=1e-6)
    assert (tmp_path / "out" / "walk.fit.npz").exists()
    succeeds(pbl("fit", files[0], "--out", tmp_path / "z", "--marker-set", tmp_path / "lab.csv", "--up", "z"))
    np.testing.assert_allclose(fits[1]["trials"][0].xyz_world_m[0, 1], [0.1, 0.9, 0.2], atol=1e-6)


def test_pbl_fit_refuses_markers_it_cannot_place(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    out = ("--out", tmp_path / "out")
    assert pbl("fit", tmp_path / "walk.trc", *out).error_code == "USAGE"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", "nobody's").error_code == "MARKER_SET_UNKNOWN"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", "blazepose_33").error_code == "MARKER_SET_UNKNOWN"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", tmp_path / "no.csv").error_code == "FILE_FORMAT"
    markers().save(tmp_path / "m.npz")
    assert pbl("fit", tmp_path / "m.npz", *out).error_code == "MARKER_SET_UNKNOWN"
    assert not fits


def test_pbl_fit_reads_views(fits, calibration, tmp_path):
    for name in ("walk.cam_02", "walk.cam_01"):
        side = 500 if name.endswith("2") else 1000
        keypoints(image_size_px=(side, side)).save(tmp_path / f"{name}.keypoints.npz")
    files = [tmp_path / f"walk.cam_0{i}.keypoints.npz" for i in (2, 1)]
    (tmp_path / "lab.csv").write_text(TABLE)
    done = pbl("fit", *files, "--cameras", calibration, "--marker-set", tmp_path / "lab.csv", "--out", tmp_path / "out")
    succeeds(done)
    (call,) = fits
    assert (call["names"], call["motion"]) == (["walk"], "static")
    (trial,) = call["trials"]
    assert isinstance(trial, MultiView)
    assert trial.marker_set == load_marker_set(tmp_path / "lab.csv").name
    assert trial.poses[0].p_nc.tolist() == [0, 0, -2]  # the first file is of the second camera
    done = pbl("fit", files[0], "--cameras", calibration, "--out", tmp_path / "out")
    assert done.error_code == "FIT_INPUT"
    markers(marker_set="blazepose_33", names=("nose", "left_hip", "right_hip")).save(tmp_path / "cam_01.npz")
    done = pbl("fit", tmp_path / "cam_01.npz", files[0], "--cameras", calibration, "--out", tmp_path / "out")
    assert done.error_code == "USAGE"


def test_keypoints_with_orientation_are_fitted_as_handheld(fits, tmp_path):
    keypoints().save(tmp_path / "still.npz")
    phone = keypoints(phone_time_s=PHONE_T, phone_quat_wxyz=np.tile(LEVEL, (3, 1)))
    phone.save(tmp_path / "phone.npz")
    out = ("--out", tmp_path / "out")
    succeeds(pbl("fit", tmp_path / "phone.npz", *out))
    succeeds(pbl("fit", tmp_path / "still.npz", *out))
    succeeds(pbl("fit", tmp_path / "phone.npz", tmp_path / "still.npz", *out))
    succeeds(pbl("fit", tmp_path / "phone.npz", *out, "--camera-motion", "static"))
    assert [c["motion"] for c in fits] == ["handheld", "static", ["handheld", "static"], "static"]
    assert all("markers" not in c for c in fits)


def test_events_of_markers(tmp_path):
    """Two feet that swing past each other in front of and behind the hips, one cycle a second, toes after heels."""
    time = np.arange(500) / 100
    names = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")
    xyz = np.zeros((len(time), 6, 3))
    xyz[:, :2, 2], xyz[:, 0::2, 1], xyz[:, 1::2, 1] = 0.9, 0.1, -0.1
    for marker, (sign, late_s) in {2: (1, 0), 3: (-1, 0), 4: (1, 0.1), 5: (-1, 0.1)}.items():
        xyz[:, marker, 0] = 0.4 * sign * np.sin(2 * np.pi * (time - late_s))
    xyz[..., 0] += time[:, None]
    walk = WorldMarkers(time, names, "plug_in_gait", xyz, np.ones(xyz.shape[:2]))
    walk.save(tmp_path / "m.npz")
    succeeds(pbl("events", tmp_path / "m.npz", "--out", tmp_path / "e.csv"))
    assert (tmp_path / "e.csv").read_text().count("foot_down") >= 7
    for changes in ({"xyz_world_m": changed(xyz, np.nan)}, {"names": np.array(["LASI"] * 6)}, {"time_s": time[1:]}):
        bad = rewritten(tmp_path / "m.npz", **changes)
        assert pbl("events", bad, "--out", tmp_path / "x.csv").error_code == "FILE_FORMAT"


@pytest.fixture
def paramsets(monkeypatch: pytest.MonkeyPatch) -> None:
    methods: Stage[Params] = Stage("fit", "solver", "usual")
    methods.register("paper", 1, ImplicitAdamParams(), len)
    methods.register("usual", 1, GaussNewtonParams(), len)
    methods.register("other", 1, GaussNewtonParams(max_iterations=7))
    methods.register("markers", 1, GaussNewtonParams(max_iterations=8))
    for module in ("fit", "fit.method_choice"):
        monkeypatch.setattr(f"pbl_pipeline.{module}.METHODS", methods)


@pytest.mark.usefixtures("paramsets")
def test_solver_and_paramset():
    expected = {
        (None, None): "usual",
        ("gauss-newton", None): "usual",
        ("implicit-adam", None): "paper",
        (None, "other"): "other",
        ("gauss-newton", "other"): "other",
    }
    assert {k: fit_paramset(*k).name for k in expected} == expected
    assert fit_paramset(None, None, [None]).name == "markers"
    assert fit_paramset("implicit-adam", None, [None]).name == "paper"
    for solver, params in (("newton", None), ("implicit-adam", "other"), (None, "none")):
        with pytest.raises(PblError, match=r"^SOLVER_UNKNOWN: "):
            fit_paramset(solver, params)


@pytest.mark.usefixtures("paramsets")
def test_markers_have_a_paramset_of_their_own(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    (tmp_path / "lab.csv").write_text(TABLE)
    keypoints().save(tmp_path / "k.npz")
    more = ("--out", tmp_path / "out", "--marker-set", tmp_path / "lab.csv")
    succeeds(pbl("fit", tmp_path / "walk.trc", *more))
    succeeds(pbl("fit", tmp_path / "k.npz", "--out", tmp_path / "out"))
    succeeds(pbl("fit", tmp_path / "walk.trc", *more, "--solver", "implicit-adam"))
    assert [c["paramset"].name for c in fits] == ["markers", "usual", "paper"]


@pytest.mark.parametrize(
    ("markers", "root_relative", "expected"),
    [
        ("bml_movi_87", False, "gauss-newton"),
        ("bml_movi_87", True, "blazepose"),
        ("blazepose_33", True, "blazepose"),
        ("mpi_inf_3dhp_17", False, "blazepose"),
    ],
)
def test_the_fit_follows_from_the_points(fits, tmp_path, markers, root_relative, expected):
    """As in the tables (tests/integration/test_model_tables.py)."""
    path = tmp_path / "walk.keypoints.npz"
    seen = keypoints(marker_set=markers, root_relative=root_relative)
    seen.save(path)
    succeeds(pbl("fit", path, "--out", tmp_path / "out"))
    succeeds(pbl("fit", path, "--out", tmp_path / "out", "--params", "markers"))
    assert [c["paramset"].name for c in fits] == [expected, "markers"]
    other = keypoints(marker_set="bml_movi_87", root_relative=False)
    assert default_fit(*points_of([seen, other])) == ("gauss-newton" if expected == "gauss-newton" else "blazepose")


def test_changes_to_a_named_paramset(tmp_path):
    from pbl_pipeline.fit import METHODS

    (tmp_path / "mine.json").write_text('{"base": "paper-2025", "steps": 8000, "cost": {"weight_2d": 0.05}}')
    mine, paper = fit_paramset(None, str(tmp_path / "mine.json")).params, METHODS["paper-2025"].params
    assert isinstance(mine, ImplicitAdamParams)
    assert isinstance(paper, ImplicitAdamParams)
    assert (mine.steps, mine.cost.weight_2d) == (8000, 0.05)
    assert (mine.samples_per_trial, mine.cost.huber_2d_px) == (paper.samples_per_trial, paper.cost.huber_2d_px)
    wrong = {
        '{"base": "nobody"}': "nobody",
        '{"base": ["paper-2025"]}': "base",
        '{"base": "paper-2025", "step": 3}': "step",
        '{"cost": {"weight_2D": 1.0}}': "weight_2D",
        '{"cost": {"weight_2d": "0.1"}}': "is not of type float @ $.cost.weight_2d",
        '{"cost": {"weight_2d": -0.1}}': "weight_2d = -0.1",
        '{"cost": {"weight_2d": NaN}}': "weight_2d",
        '{"cost": {"weight_2d": true}}': "is not of type float @ $.cost.weight_2d",
        '{"cost": 3}': "cost",
        '{"max_iterations": 0}': "max_iterations",
        '{"max_iterations": -3}': "max_iterations",
        '{"max_iterations": "many"}': "max_iterations",
        '{"base": "paper-2025", "steps": 0}': "steps",
        '{"max_iterations": 1.5}': "is not of type int @ $.max_iterations",
        '{"sd_floor": [["knee"]]}': "sd_floor",
        '{"solver": "implicit-adam"}': "solver",
        "[]": "object",
    }
    for text, words in wrong.items():
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(PblError, match=r"^FILE_FORMAT: ") as error:
            fit_paramset(None, str(tmp_path / "bad.json"))
        assert words in error.value.found, text


def test_pbl_run_wants_a_log_for_each_video(tmp_path):
    videos = [chain.small_video(tmp_path, name, n=10) for name in ("a", "b")]
    log = csv_log(tmp_path / "a.csv", UPRIGHT, {"frame": "device"})
    done = pbl("run", *videos, "--attitude", log, "--out", tmp_path / "out")
    assert (done.code, done.error_code) == (1, "USAGE")
    assert "1 times --attitude for 2 videos" in done.err


@pytest.fixture
def detection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracking and keypoints are stand-ins; the walker is seen at 1920x1080."""
    chain.install(monkeypatch)


@pytest.mark.slow
@pytest.mark.usefixtures("detection")
def test_logs_go_with_their_videos_into_the_fit(fits, tmp_path, stand_in):
    stand_in(check_trial=lambda *_: None)
    videos = [chain.small_video(tmp_path, name) for name in ("a", "b")]
    logs = [csv_log(tmp_path / f"{a}.csv", about(0, a), {"frame": "device"}, n=400) for a in (90, 70)]
    visit, _ = pipeline.run_visit(videos, tmp_path / "out", attitude_files=logs)
    (call,) = fits
    assert call["motion"] == "handheld"
    for recording, log in zip(visit.fitted, logs, strict=True):
        assert recording.keypoints is not None
        np.testing.assert_array_equal(recording.keypoints.phone_quat_wxyz, load_attitude(log).quat_wxyz)
    pipeline.run_visit(videos, tmp_path / "out")
    assert fits[1]["motion"] == "static"
    assert all(k.phone_time_s is None for k in fits[1]["trials"])
    logs[1].write_text("nothing")
    stand_in(track_people=lambda *a, **k: pytest.fail("work was begun"))
    with pytest.raises(PblError, match=r"^PHONE_LOG: "):
        pipeline.run_visit(videos, tmp_path / "out", attitude_files=logs)


@pytest.mark.slow
@pytest.mark.usefixtures("detection")
@pytest.mark.parametrize(("markers", "expected"), [("bml_movi_87", "gauss-newton"), ("mpi_inf_3dhp_17", "blazepose")])
def test_a_session_is_fitted_as_its_points_want(fits, monkeypatch, tmp_path, markers, expected, stand_in):
    stand_in(check_trial=lambda *_: None)
    monkeypatch.setattr(ModelKeypointParams, "points", lambda _: (markers, False))
    model = ModelParams("still", "1" * 64, "2" * 64, "MIT", 10)
    method = METHODS.make("still", 1, ModelKeypointParams(model_sha256=model.sha256, model=model))
    video = chain.small_video(tmp_path, "a")
    pipeline.run_visit([video], tmp_path / "out", keypoints=method)
    pipeline.run_visit([video], tmp_path / "out", keypoints=method, paramset="markers")
    assert [c["paramset"].name for c in fits] == [expected, "markers"]


@pytest.mark.usefixtures("detection")
def test_pbl_detect_keeps_the_log(tmp_path):
    video = chain.small_video(tmp_path, "a", n=60)
    log = csv_log(tmp_path / "a.csv", UPRIGHT, {"frame": "device"})
    done = pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", log)
    succeeds(done)
    assert "3 samples" in done.out
    np.testing.assert_array_equal(Keypoints.load(tmp_path / "k.npz").phone_quat_wxyz, load_attitude(log).quat_wxyz)
    assert pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", video).error_code == "PHONE_LOG"
    assert pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", tmp_path / "no").error_code == "FILE_MISSING"
