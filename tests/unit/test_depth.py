"""Depth recordings: each format, bad input, depths at keypoints, and the way into a fit."""

import dataclasses
import errno
import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pbl_pipeline import bounded
from pbl_pipeline.body import capsules, load_body, ray_lengths
from pbl_pipeline.cli.options import depth_files
from pbl_pipeline.depth import (
    Depth,
    DepthFile,
    PointDepths,
    at_points,
    check_recording,
    pack,
    read_depth,
    sha256_of_recording,
    with_recordings,
)
from pbl_pipeline.depth.folders import read_folder
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.fit import GaussNewtonParams, TrialFit, fit_session
from pbl_pipeline.fit.checks import _depths
from pbl_pipeline.fit.depths import check_depths, shares_of_floors, with_depths
from pbl_pipeline.fit.per_frame import start_of
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.qc import FAIL, PASS, WARN
from pbl_pipeline.records import plain
from pbl_pipeline.results import DepthFit
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.video import Camera

N, HEIGHT, WIDTH = 12, 24, 32
#: A video of 4:3, and one of a phone that was turned.
TIME_S, SIZE_PX = 7.0 + np.arange(N) / 30, (640, 480)
PORTRAIT_PX = (480, 640)
MATRIX = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]])


def depths(i: int) -> np.ndarray:
    """Metres: a wall at 3 m, something at 1.5 m, a hole, and a far corner."""
    out = np.full((HEIGHT, WIDTH), 3.0)
    out[5:15, 5 + i : 12 + i] = 1.5
    out[0, 0], out[-1, -1] = 0.0, 6.0
    return out


def write(folder: Path, picture: Callable[[int], np.ndarray], n: int = N, end: str = "png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(n):
        if end == "npy":
            np.save(folder / f"{i:06d}.npy", picture(i))
        else:
            cv2.imwrite(str(folder / f"{i:06d}.{end}"), picture(i))
    return folder


def millimetres(i: int) -> np.ndarray:
    return (1000 * depths(i)).astype(np.uint16)


#: Quaternions (x, y, z, w) of a camera that looks ahead: clockwise turn of its pictures that makes them upright.
HELD = {
    0: "1, 0, 0, 0",
    90: "0.70710678, -0.70710678, 0, 0",
    180: "0, 1, 0, 0",
    270: "0.70710678, 0.70710678, 0, 0",
}


def stray(folder: Path, end: str = "png", held: int = 0) -> Path:
    write(folder / "depth", millimetres, end=end)
    write(folder / "confidence", lambda i: np.full((HEIGHT, WIDTH), 2, np.uint8))
    rows = "".join(f"{100 + t:.4f}, {i:06d}, 0, 0, 0, {HELD[held]}\n" for i, t in enumerate(TIME_S))
    (folder / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy, qz, qw\n" + rows)
    (folder / "camera_matrix.csv").write_text("600.0, 0.0, 320.0\n0.0, 600.0, 240.0\n0.0, 0.0, 1.0\n")
    return folder


def record3d(path: Path, wrong: bytes = b"") -> Path:
    about = {"w": 640, "h": 480, "dw": WIDTH, "dh": HEIGHT, "fps": 30, "K": [600.0, 0, 0, 0, 600.0, 0, 320.0, 240.0, 1]}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(about))
        for i in range(N):
            for name, values in (("depth", depths(i).astype("<f4")), ("conf", np.full((HEIGHT, WIDTH), 2, np.uint8))):
                raw = values.tobytes()  # as one block of LZFSE that is not packed
                archive.writestr(f"rgbd/{i}.{name}", wrong or b"bvx-" + struct.pack("<I", len(raw)) + raw + b"bvx$")
    return path


def refused(path: Path, scale_m: float | None = None) -> PblError:
    return refused_beside(path, SIZE_PX, scale_m)


def refused_beside(path: Path, size_px: tuple[int, int], scale_m: float | None = None) -> PblError:
    with pytest.raises(PblError) as caught:
        read_depth(path, TIME_S, size_px, scale_m)
    assert caught.value.code == "DEPTH_FILE"
    return caught.value


@pytest.mark.parametrize("form", ["png", "npy", "r3d", "folder"])
def test_each_format(tmp_path: Path, form: str):
    if form == "r3d":
        pytest.importorskip("lzfse")
        found = read_depth(record3d(tmp_path / "a.r3d"), TIME_S, SIZE_PX)
    elif form == "folder":
        found = read_depth(write(tmp_path / "a", millimetres), TIME_S, SIZE_PX, 0.001)
    else:
        found = read_depth(stray(tmp_path / "a", form), TIME_S, SIZE_PX)
    np.testing.assert_allclose(found.time_s, TIME_S - TIME_S[0], atol=1e-4)
    (depth, confidence), (other, _) = found.read([3, 5])
    np.testing.assert_allclose(depth, depths(3), atol=1e-3)
    np.testing.assert_allclose(other, depths(5), atol=1e-3)
    guess = Camera(MATRIX, np.zeros(5), "guess: a phone")
    if form == "folder":
        assert (confidence, found.matrix) == (None, None)
        assert found.camera(guess) is guess
        return
    assert confidence is not None
    assert set(confidence.ravel()) == {2}
    assert found.camera(guess).kind == "metadata"
    np.testing.assert_allclose(found.camera(guess).matrix, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
    calibrated = Camera(MATRIX, np.zeros(5), "file: a calibration")
    assert found.camera(calibrated) is calibrated
    with pytest.raises(PblError, match="another camera or lens"):
        found.camera(Camera(MATRIX * [[1.2], [1.2], [1]], np.zeros(5), "file: a calibration"))


@pytest.mark.parametrize(
    ("picture", "n", "scale", "found"),
    [
        (millimetres, 8, 0.001, "8 depth pictures for 12"),
        (lambda i: millimetres(i % N), 2 * N, 0.001, "24 depth pictures for 12"),
        (lambda i: np.rot90(millimetres(i)).copy(), N, 0.001, "24x32, turned by 90 deg,"),
        (lambda i: millimetres(i)[:, :24].copy(), N, 0.001, "of another camera"),
        (lambda i: np.zeros((HEIGHT, WIDTH), np.uint16), N, 0.001, "depths of 0"),
        (millimetres, N, 1.0, "depths of typically 3e+03 m"),
        (millimetres, N, 1e-6, "depths of typically 0.003 m"),
        (lambda i: millimetres(i) * np.uint16(4), N, 0.001, "beyond 5 m"),
        (lambda i: (millimetres(i) // 16).astype(np.uint8), N, 0.001, "of 8 bits"),
        (lambda i: np.full((HEIGHT, WIDTH, 3), 9, np.uint16), N, 0.001, "no picture of one value a pixel"),
    ],
)
def test_bad_pictures_are_named(tmp_path: Path, picture: Any, n: int, scale: float, found: str):
    assert found in refused(write(tmp_path / "a", picture, n), scale).found


def test_bad_recordings_are_named(tmp_path: Path):
    folder = stray(tmp_path / "a")
    (folder / "odometry.csv").write_text("frame, x\n0, 1\n")
    assert "Stray Scanner" in refused(folder).found
    assert "no depth pictures" in refused(write(tmp_path / "b", millimetres, 0), 0.001).found
    (folder / "camera_matrix.csv").write_text("600, 0, 960\n0, 600, 720\n0, 0, 1\n")
    stray_rows = "timestamp\n" + "".join(f"{t}\n" for t in TIME_S)
    (folder / "odometry.csv").write_text(stray_rows)
    assert "its middle at 960, 720 px" in refused(folder).found
    (folder / "camera_matrix.csv").write_text("500, 0, 384\n0, 500, 288\n0, 0, 1\n")  # of 768x576 beside 640x480
    assert "its middle at 384, 288 px" in refused(folder).found
    (folder / "odometry.csv").write_text(stray_rows.replace("7.0", "9.0", 1))
    (folder / "camera_matrix.csv").unlink()
    assert "do not increase" in refused(folder).found
    (folder / "odometry.csv").write_text("timestamp\n" + "".join(f"{2 * t}\n" for t in TIME_S))
    assert "0.73 s beside a video of 0.37 s" in refused(folder).found
    (folder / "odometry.csv").write_text("timestamp\n" + "".join(f"{1.02 * t}\n" for t in TIME_S))
    (folder / "camera_matrix.csv").unlink(missing_ok=True)
    np.testing.assert_array_equal(read_depth(folder, TIME_S, SIZE_PX).time_s, TIME_S - TIME_S[0])  # frame by frame
    write(folder / "confidence", lambda i: np.full((WIDTH, HEIGHT), 2, np.uint8))
    assert "confidences of (32, 24)" in refused(folder).found
    with pytest.raises(PblError, match="FILE_MISSING"):
        read_depth(tmp_path / "nothing", TIME_S, SIZE_PX)
    pytest.importorskip("lzfse")
    (tmp_path / "c.r3d").write_bytes(b"no zip")
    assert "Record3D" in refused(tmp_path / "c.r3d").found
    assert "0.depth" in refused(record3d(tmp_path / "d.r3d", wrong=b"damaged")).found


def test_pictures_are_paired_by_their_numbers(tmp_path: Path):
    folder = write(tmp_path / "a", millimetres)
    for i in range(N):
        (folder / f"{i:06d}.png").rename(folder / f"depth_{i}.png")
    (depth, _) = next(read_depth(folder, TIME_S, SIZE_PX, 0.001).read([11]))
    np.testing.assert_allclose(depth, depths(11), atol=1e-3)
    # Frames of Stray Scanner without their pictures.
    stray(tmp_path / "b")
    for i in (0, 3):
        (tmp_path / "b" / "depth" / f"{i:06d}.png").unlink()
    found = read_folder(tmp_path / "b", TIME_S, SIZE_PX, None)
    np.testing.assert_allclose(found.time_s, np.delete(TIME_S - TIME_S[0], [0, 3]), atol=1e-4)


def test_cameras_with_other_views_are_registered_by_their_matrices(tmp_path: Path):
    folder = write(tmp_path / "a", lambda i: np.full((40, 36), 2000, np.uint16))
    (folder / "camera_matrix.csv").write_text("600, 0, 319.5\n0, 600, 239.5\n0, 0, 1\n")
    (folder / "depth_matrix.csv").write_text("30, 0, 17.5\n0, 30, 19.5\n0, 0, 1\n")
    found = read_depth(folder, TIME_S, SIZE_PX, 0.001)
    assert found.place(np.array([[319.5, 239.5], [519.5, 139.5]]), (40, 36)).tolist() == [[20, 18], [14, 28]]
    (folder / "camera_matrix.csv").unlink()
    assert "depth_matrix.csv alone" in refused(folder, 0.001).found


def test_depth_at_a_point_is_that_of_one_surface():
    """A limb of 3 columns before a wall, holes, low confidence, beyond 5 m, outside."""
    picture = np.full((48, 64), 3.0)
    picture[:, 20:23] = 1.5 + 0.01 * np.arange(48)[:, None] / 48
    picture[10:13, 40:43] = 0.0
    picture[30:36, 40:46] = np.nan
    picture[:, 55:] = 6.0
    confidence = np.full(picture.shape, 2)
    confidence[20:28, 45:53] = 0
    read = lambda frames: ((picture, confidence) for _ in frames)  # noqa: E731
    depth = Depth(Path("d"), np.arange(3) / 30, (640, 480), None, None, read)
    places = [(21, 5), (24, 5), (30, 5), (41, 11), (42, 32), (59, 5), (49, 24), (0, 0), (80, 5)]
    xy = 10 * np.array(places, float) + 4.5
    keypoints: Any = SimpleNamespace(
        time_s=np.array([5.0, 5.0 + 1 / 30, 5.2]),
        xy_px=np.tile(xy, (3, 1, 1)),
        confidence=np.ones((3, len(places))),
    )
    found = at_points(depth, keypoints).m
    nan = np.nan
    # On the limb, beside it, on the wall, in a small hole, in a large one, far, not confident, at the corner, outside.
    np.testing.assert_allclose(found[0, :, 0], [1.5, 3, 3, nan, nan, nan, nan, nan, nan], atol=0.011)
    np.testing.assert_allclose(found[0, :, 1], [1.5, 1.5, 3, 3, nan, nan, nan, nan, nan], atol=0.011)
    np.testing.assert_array_equal(found[1], found[0])
    assert np.isnan(found[2]).all()  # no picture is near in time


def test_rays_meet_capsules():
    body, rng = load_body(), np.random.default_rng(3)
    shapes = capsules(body, np.zeros((1, len(body.joint_names))), np.ones(8))
    rays, origin = rng.normal([-3, 0, 0], [0.05, 0.3, 0.6], (1, 200, 3)), np.array([[3.0, 0.0, 1.0]])
    found = ray_lengths(shapes, origin, rays)[0]
    # The first of many places on the ray that lies in the capsule.
    steps = np.linspace(0, 2, 4001)
    x = origin[0] + rays[0, :, None] * steps[:, None]
    hits = 0
    for g in range(0, len(shapes.names), 4):
        start, axis = shapes.start[0, g], shapes.end[0, g] - shapes.start[0, g]
        along = np.clip((x - start) @ axis / max(axis @ axis, 1e-12), 0, 1)
        inside = np.linalg.norm(x - start - along[..., None] * axis, axis=-1) < shapes.radius_m[g]
        first = np.where(inside.any(axis=1), steps[inside.argmax(axis=1)], np.inf)
        clear = inside.sum(axis=1) != 1  # a ray that grazes it
        np.testing.assert_allclose(found[clear, g], first[clear], atol=1e-3)
        hits += np.isfinite(first).sum()
    assert hits > 30


def filmed(metre: float = 1.0) -> Any:
    """A walk with exact keypoints whose fit is in other metres than the depths; its session and solution."""
    made = synthesise(SynthSpec(view="frontal", seconds=1.5, marker_set="blazepose_33", seed=511, noise="none"))
    truth, body = made.truth, load_body()
    session = make_session([made.keypoints], ["walk"], GaussNewtonParams())
    state = start_of(session)
    n, j = len(truth.time_s), len(session.markers)
    first = ray_lengths(capsules(body, truth.qpos, truth.scale), np.zeros((n, 3)), truth.markers_world_m).min(axis=-1)
    z = np.einsum("tji,ti->tj", truth.markers_world_m, truth.R_nc[:, :, 2])
    x = np.zeros((len(session.problem.weight), state.site_offset_m.shape[0], 3))
    x[:n, :j] = truth.markers_world_m
    depth = np.where(np.isfinite(first) & (first * z < 5), first * z * metre, np.nan)
    return made, session, state, x, np.stack([depth, depth], axis=-1)


def test_depths_on_the_way_into_a_fit(monkeypatch: pytest.MonkeyPatch):
    made, session, state, x, depth = filmed(1.1)
    q = np.pad(made.truth.qpos, [(0, len(state.qpos) - len(made.truth.qpos)), (0, 0)], mode="edge")
    state = dataclasses.replace(state, qpos=q, R_nc=np.asarray(state.R_nc))
    monkeypatch.setattr("pbl_pipeline.fit.depths.scale_multipliers", lambda s: made.truth.scale)
    rng = np.random.default_rng(2)
    wrong, lost = depth.copy(), rng.random((2, *depth.shape[:2])) < 0.3
    wrong[lost[0], 0] += 1  # a wall beside the limb
    wrong[lost[0] & lost[1], 1] += 1
    p, start, share = with_depths(
        dataclasses.replace(session, depths=(PointDepths(wrong),)), session.problem, state, x, 0.5
    )
    assert p.depths is not None
    assert start.surface is not None
    assert float(start.surface.metre) == pytest.approx(1 / 1.1, rel=0.01)
    assert share == pytest.approx(0.91, abs=0.03)
    used = np.asarray(p.depths.count) > 0
    names = np.array(session.markers.names)[used[:, : len(session.markers)].any(axis=0)]
    assert {n.split("_")[1] for n in names} == {"shoulder", "elbow", "wrist", "hip", "knee", "ankle"}
    assert np.all((np.asarray(p.depths.skin_m)[used] < 0) & (np.asarray(p.depths.skin_m)[used] > -0.14))
    floors = dict(zip(session.body.joint_names, shares_of_floors(session, p)[0], strict=True))
    assert (floors["knee_angle_l"], floors["ankle_angle_l"]) == (0.75, 1.0)
    few = dataclasses.replace(p, depths=dataclasses.replace(p.depths, count=0.2 * p.depths.count))
    assert np.all(shares_of_floors(session, few) == 1.0)
    # Another person's recording: depths of a wall, and of a path that comes nearer.
    away = np.broadcast_to(np.linspace(1, 4.5, len(depth))[:, None, None], depth.shape)
    with pytest.raises(PblError, match="DEPTH_FILE"):
        with_depths(dataclasses.replace(session, depths=(PointDepths(away),)), session.problem, state, x, 0.5)


def test_the_trial_with_a_wrong_recording_is_named():
    """The depths of two trials are right, those of one are another's."""
    made, *_, x, depth = filmed()
    n, q = len(depth), made.truth.qpos
    session = make_session([made.keypoints] * 3, ["a", "b", "c"], GaussNewtonParams())
    state, at = start_of(session), [session.frames(i) for i in range(3)]
    qpos, markers = np.array(state.qpos), np.zeros((len(state.qpos), *x.shape[1:]))
    for i in range(3):
        qpos[at[i]][:n], markers[at[i]][:n] = q, x[:n]
    state: Any = dataclasses.replace(state, qpos=qpos, R_nc=np.asarray(state.R_nc))
    depth, away = (PointDepths(d) for d in (depth, np.broadcast_to(np.linspace(1, 4.5, n)[:, None, None], depth.shape)))
    args: Any = session.problem, state, markers, 0.5
    *_, share = with_depths(dataclasses.replace(session, depths=(depth, None, depth)), *args)
    assert np.isnan(share[1])
    with pytest.raises(PblError, match=r"about: +b\n"):
        with_depths(dataclasses.replace(session, depths=(depth, away, depth)), *args)
    # A recording that was turned, by hand before or not.
    upside_down = [dataclasses.replace(d, turn_deg=180) for d in (depth, away)]
    for own, turned in (((depth, upside_down[1], depth), True), ((upside_down[0], away, depth), False)):
        with pytest.raises(PblError) as caught:
            with_depths(dataclasses.replace(session, depths=own), *args)
        assert ("turned by 180 deg" in caught.value.next_step) == turned


def test_depths_of_other_trials_are_refused():
    made, session, *_, depth = filmed()
    assert check_depths((None,), session.trials) == ()
    for bad in ((depth[1:],), (depth, depth), (np.full(depth.shape, np.nan),)):
        with pytest.raises(PblError, match="DEPTH_FILE"):
            check_depths([PointDepths(d) for d in bad], session.trials)
    with pytest.raises(PblError, match="FIT_INPUT"):
        fit_session([made.keypoints], ["walk"], "paper-2025", depths=[PointDepths(depth)])


@pytest.mark.parametrize(
    ("changed", "name", "outcome"),
    [
        ({}, "", PASS),
        ({"distance": 2.0}, "depth_distance_ratio", FAIL),
        ({"used": 0.05}, "depth_share_used", WARN),
        ({"fits": 0.88}, "depth_share_on_person", WARN),
        ({"z": 3.0}, "depth_misfit_sd", WARN),
    ],
)
def test_checks_of_depths(changed: dict[str, float], name: str, outcome: str):
    good = {"used": 0.5, "fits": 0.95, "distance": 0.92, "z": 1.1}
    checks = _depths([DepthFit("a", "0" * 64, **good | changed, metre=1.0)])
    assert [(c.check, c.outcome) for c in checks if c.outcome != PASS] == ([(name, outcome)] if name else [])
    assert _depths([]) == []


@pytest.mark.long
@pytest.mark.slow
def test_a_fit_with_depths_is_in_their_metres(tmp_path: Path):
    made, _, _, _, depth = filmed(1.0)
    fit = fit_session(
        [made.keypoints], ["walk"], "blazepose", depths=[PointDepths(depth, "a.r3d", "0" * 64)], height_m=1.9
    )
    trial = fit.trials[0]
    hips = np.asarray(trial.markers_world_m)[:, [trial.marker_names.index(f"{s}_hip") for s in ("left", "right")]]
    seen = made.truth.markers_world_m[:, [trial.marker_names.index(f"{s}_hip") for s in ("left", "right")]]
    ratio = np.nanmedian(np.linalg.norm(hips.mean(axis=1), axis=1) / np.linalg.norm(seen.mean(axis=1), axis=1))
    assert ratio == pytest.approx(1.0, abs=0.01)
    assert trial.with_depths
    assert trial.sized
    assert trial.depth is not None
    assert (trial.depth.name, trial.depth.sha256) == ("a.r3d", "0" * 64)
    assert 0.3 < trial.depth.used <= 1
    trial.save(tmp_path / "a.fit.npz")
    assert plain(TrialFit.load(tmp_path / "a.fit.npz").depth) == plain(trial.depth)


def test_keypoints_take_the_camera_and_the_depths_of_a_recording(tmp_path: Path):
    made = synthesise(SynthSpec(seconds=1.0, marker_set="blazepose_33", seed=512)).keypoints
    width, height = made.image_size_px
    folder = write(tmp_path / "a", lambda i: np.full((160, 90), 3000, np.uint16), len(made.time_s))
    matrix = f"1600, 0, {width / 2}\n0, 1600, {height / 2}\n0, 0, 1\n"
    (folder / "camera_matrix.csv").write_text(matrix)
    guessed = dataclasses.replace(made, camera=dataclasses.replace(made.camera, source="guess: a phone"))
    (trial, other), (depth, none) = with_recordings([guessed, made], [DepthFile(folder, 0.001), None])
    assert trial.camera.focal_px == 1600
    assert other is made
    assert none is None
    assert depth is not None
    assert set(depth.m[np.isfinite(depth.m)]) == {3.0}
    assert depth.m.shape == (*made.confidence.shape, 2)
    assert (depth.name, depth.sha256) == ("a", sha256_of_recording(folder))
    assert with_recordings([made], [None]) == ([made], [None])
    with pytest.raises(PblError, match="USAGE"):
        with_recordings([SimpleNamespace(markers="of a laboratory")], [DepthFile(folder, 0.001)])


def test_each_frame_has_its_own_picture_where_keypoints_leave_frames_out(tmp_path: Path):
    made = synthesise(SynthSpec(seconds=1.0, marker_set="blazepose_33", seed=512)).keypoints
    n = len(made.time_s)
    folder = write(tmp_path / "a", lambda i: np.full((160, 90), 3000 + i, np.uint16), n)
    used = np.append(np.arange(0, n - 1, 2), n - 1)
    arrays = {f.name: getattr(made, f.name) for f in dataclasses.fields(made)}
    per_frame = {k: v[used] for k, v in arrays.items() if isinstance(v, np.ndarray) and v.shape[:1] == (n,)}
    _, (depth,) = with_recordings([dataclasses.replace(made, **per_frame, frame=used)], [DepthFile(folder, 0.001)])
    assert depth is not None
    np.testing.assert_allclose(np.nanmedian(depth.m, axis=(1, 2)), 3.0 + 0.001 * used, atol=1e-6)


def test_recordings_are_named_with_their_own_scale():
    files = ["none", "0.001=a", "0.00025=b/c", "x=d", "nan=e"]
    paths = (
        DepthFile(Path("a"), 0.001),
        DepthFile(Path("b/c"), 0.00025),
        DepthFile(Path("x=d")),
        DepthFile(Path("nan=e")),
    )
    assert depth_files(files, 5) == [None, *paths]
    assert depth_files([], 2) == [None, None]
    with pytest.raises(PblError, match="USAGE"):
        depth_files(["b"], 2)


def test_a_zip_is_read_as_its_folder(tmp_path: Path):
    """As the tables keep it; its bytes do not depend on when it was written, nor on what is not read."""
    for name, folder, scale in (("s", stray(tmp_path / "s"), None), ("p", write(tmp_path / "p", millimetres), 0.001)):
        (folder / "rgb.mp4").write_bytes(b"pictures")
        zipped = pack(folder, tmp_path / f"{name}.zip")
        assert sha256_of(zipped) == sha256_of_recording(folder)
        assert "rgb.mp4" not in zipfile.ZipFile(zipped).namelist()
        kept = tmp_path / f"{name}_of_the_store"
        zipped.rename(kept)
        (of_zip, sure), (of_folder, _) = (next(read_depth(p, TIME_S, SIZE_PX, scale).read([7])) for p in (kept, folder))
        np.testing.assert_array_equal(of_zip, of_folder)
        assert (sure is None) == (scale is not None)
    with zipfile.ZipFile(kept, "r") as archive, zipfile.ZipFile(tmp_path / "cut.zip", "w") as cut:
        for member in archive.namelist()[:4]:
            cut.writestr(member, archive.read(member))
    with pytest.raises(PblError, match="4 depth pictures for 12") as caught:
        read_depth(tmp_path / "cut.zip", TIME_S, SIZE_PX, 0.001, "walk")
    assert caught.value.key == "walk"


def test_a_folder_is_packed_as_far_as_its_zip_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = write(tmp_path / "a", millimetres)
    size = zipfile.ZipFile(pack(folder, tmp_path / "a.zip")).start_dir
    for limit, least, shown in (("ZIP64_LIMIT", size, "of 0.00 GiB"), ("ZIP_FILECOUNT_LIMIT", N, "12 files")):
        with monkeypatch.context() as patch:
            patch.setattr(zipfile, limit, least)
            check_recording(DepthFile(pack(folder, tmp_path / "b.zip"), 0.001))
            patch.setattr(zipfile, limit, least - 1)
            with pytest.raises(PblError, match="DEPTH_FILE") as caught:
                pack(folder, tmp_path / "c.zip")
            assert shown in caught.value.found
            assert not (tmp_path / "c.zip").exists()
            assert sha256_of_recording(folder)  # also of what only the tables do not take


def test_a_zip_with_one_folder_on_top_is_read(tmp_path: Path):
    """As Finder and Explorer make it."""
    for name, folder, scale in (("s", stray(tmp_path / "s"), None), ("p", write(tmp_path / "p", millimetres), 0.001)):
        path = tmp_path / f"{name}.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for file in (folder, *folder.rglob("*")):
                archive.write(file, Path(folder.name) / file.relative_to(folder))
            archive.writestr(f"__MACOSX/{folder.name}/._odometry.csv", b"a")
        check_recording(DepthFile(path, scale))
        (depth, _) = next(read_depth(path, TIME_S, SIZE_PX, scale).read([7]))
        np.testing.assert_allclose(depth, depths(7), atol=1e-3)


@pytest.mark.parametrize("form", ["zip", "r3d", "folder"])
def test_a_fault_of_the_machine_is_none_of_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str):
    """Wherever the disk fails, and where no file can be opened any more."""
    if form == "r3d":
        pytest.importorskip("lzfse")
    folder = stray(tmp_path / "a")
    given = {"zip": lambda: pack(folder, tmp_path / "a.zip"), "r3d": lambda: record3d(tmp_path / "a.r3d")}
    path = given.get(form, lambda: folder)()
    n_read, at = 0, 0

    def count() -> None:
        nonlocal n_read
        n_read += 1
        if n_read == at:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    class Failing(io.BufferedReader):
        def read(self, size: int | None = -1, /) -> bytes:
            count()
            return super().read(size)

    def opened(path: Path, *_: object, **__: object) -> Failing:
        count()
        return Failing(io.FileIO(path))

    monkeypatch.setattr(bounded, "open", opened, raising=False)
    check_recording(DepthFile(path))
    for at in range(1, n_read + 1):
        n_read = 0
        with pytest.raises(PblError) as caught:
            check_recording(DepthFile(path))
        assert caught.value.code == "FILE_MISSING", at


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_pictures_of_a_turned_phone_are_turned_as_it_was_held(tmp_path: Path, turn: int):
    """The video is upright; what Stray Scanner writes lies as the sensor does."""
    upright = [np.rot90(depths(i), -turn // 90) for i in range(N)]
    size, other = (PORTRAIT_PX, SIZE_PX) if turn % 180 else (SIZE_PX, PORTRAIT_PX)
    folder = stray(tmp_path / "a", held=turn)
    (folder / "camera_matrix.csv").write_text("600.0, 0.0, 325.0\n0.0, 610.0, 236.0\n0.0, 0.0, 1.0\n")
    found = read_depth(folder, TIME_S, size)
    (depth, sure) = next(found.read([3]))
    assert found.turn_deg == turn
    np.testing.assert_allclose(depth, upright[3], atol=1e-3)
    assert sure is not None
    assert sure.shape == depth.shape
    # A point of the sensor's picture, turned with it.
    wanted = {0: (325, 236), 90: (479 - 236, 325), 180: (639 - 325, 479 - 236), 270: (236, 639 - 325)}[turn]
    assert found.matrix is not None
    np.testing.assert_allclose(found.matrix[:2, 2], wanted)
    np.testing.assert_allclose(np.diag(found.matrix)[:2], (610, 600) if turn % 180 else (600, 610))
    # The video lies on its side, or stands when the phone did not.
    with pytest.raises(PblError, match="turned by 90 deg") as caught:
        read_depth(folder, TIME_S, other)
    assert "so that the person is upright" in caught.value.next_step
    # Not known how it was held: pictures and video must agree.
    (folder / "odometry.csv").write_text("timestamp\n" + "".join(f"{t}\n" for t in TIME_S))
    if turn % 180:
        assert "turned by 90 deg" in refused_beside(folder, size).found
    # Turned by hand before.
    elif turn == 0:
        by_hand = stray(tmp_path / "b", held=90)
        write(by_hand / "depth", lambda i: np.rot90(millimetres(i), -1).copy())
        write(by_hand / "confidence", lambda i: np.full((WIDTH, HEIGHT), 2, np.uint8))
        (by_hand / "camera_matrix.csv").write_text("600, 0, 240\n0, 600, 320\n0, 0, 1\n")
        (depth, _) = next(read_depth(by_hand, TIME_S, PORTRAIT_PX).read([3]))
        np.testing.assert_allclose(depth, np.rot90(depths(3), -1), atol=1e-3)
