"""The logic of the review page's scripts, by `node --test`. Skips where there is no node."""

import dataclasses
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import capsules, load_body
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.render import body_track, to_camera, to_pixels
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.video import Camera
from pbl_pipeline.visit import Recording
from pbl_workers.web import movement
from pbl_workers.web.movement import Movement, body_json
from tests.walker import observe
from tests.walking_fit import LEVEL_CAMERA_QUAT_WXYZ, walking_fit

STATIC = Path(movement.__file__).parent / "static"
TESTS = Path(__file__).parent / "web_scripts"

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="no node on this machine: apt-get install nodejs")


def handheld_walk(n_frames: int = 90):
    """A walk before a lens with distortion, in a hand that turns; the person is in view from frame 5 to 79."""
    fit = walking_fit(n_frames=n_frames, seen=(5, 80), image_size_px=(1280, 720))
    lens = np.array([[1100.0, 0, 655], [0, 1090, 350], [0, 0, 1]])
    sway = Rotation.from_rotvec(0.05 * np.sin(np.arange(n_frames)[:, None] / [9.0, 14.0, 6.0]))
    quat = (sway * Rotation.from_quat(LEVEL_CAMERA_QUAT_WXYZ, scalar_first=True)).as_quat(scalar_first=True)
    camera = Camera(lens, np.array([-0.11, 0.05, 0.002, -0.001, 0.004]), "test")
    scale = np.linspace(0.9, 1.1, 8)
    return dataclasses.replace(
        fit, camera=camera, phone_quat_wxyz=quat, scale=scale, camera_position_m=np.array([0.2, -0.1, 0.05])
    )


def discs_of(fit) -> list[list[list[float | None]] | None]:
    """What `render_overlay` draws, frame by frame: x, y, radius of the discs of both ends (px), depth (m)."""
    drawn = capsules(load_body(), fit.qpos, fit.scale)
    focal = 0.5 * (fit.camera.matrix[0, 0] + fit.camera.matrix[1, 1])
    out: list[list[list[float | None]] | None] = []
    for t in range(len(fit.time_s)):
        if not np.isfinite(fit.qpos[t]).all():
            out.append(None)
            continue
        ends = [to_camera(p[t], fit.phone_quat_wxyz[t], fit.camera_position_m) for p in (drawn.start, drawn.end)]
        parts = [np.c_[to_pixels(e, fit.camera), focal * drawn.radius_m / e[:, 2]] for e in ends]
        rows = np.c_[parts[0], parts[1], (ends[0][:, 2] + ends[1][:, 2]) / 2]
        out.append([[float(v) if np.isfinite(v) else None for v in row] for row in rows])
    return out


def detected(fit) -> Keypoints:
    """Points around the picture of a fit, some of them not known for a while."""
    rng = np.random.default_rng(5)
    found = observe(plain_walk(fit.time_s), fit.time_s)
    xy = np.array([640.0, 360.0]) + np.cumsum(rng.normal(0, 9, found.xy_px.shape), axis=0)
    confidence = rng.uniform(0.01, 1, found.confidence.shape)
    xy[20:30, 3], confidence[20:30, 3] = np.nan, 0
    confidence[:, 7] = 0
    return dataclasses.replace(found, xy_px=xy.astype(found.xy_px.dtype), confidence=confidence)


def spelled(points: Keypoints) -> tuple[list, list]:
    return np.nan_to_num(points.xy_px).astype(float).tolist(), points.confidence.astype(float).tolist()


@needs_node
def test_scripts_of_the_page(tmp_path: Path):
    points = detected(handheld_walk())
    found = Recording.of("walk", handheld_walk(), points)
    shutil.copytree(STATIC, tmp_path / "static")
    for file in TESTS.glob("*.mjs"):
        shutil.copy(file, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    sent = Movement.of(found)
    assert found.fit is not None
    (tmp_path / "movement.json").write_bytes(sent.movement)
    (tmp_path / "body.bin").write_bytes(sent.body)
    (tmp_path / "expected.json").write_text(json.dumps(discs_of(found.fit)))
    (tmp_path / "points.bin").write_bytes(sent.points)
    seen = [[[*xy, c] for xy, c in zip(p, q, strict=True) if c > 0] for p, q in zip(*spelled(points), strict=True)]
    (tmp_path / "points.json").write_text(json.dumps(seen))
    (tmp_path / "root.json").write_text(json.dumps(np.nan_to_num(body_track(found.fit).root_m).tolist()))
    files = sorted(p.name for p in tmp_path.glob("*.test.mjs"))
    done = subprocess.run(["node", "--test", *files], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert "# pass 0" not in done.stdout


def test_a_recording_without_a_camera_or_a_pose_is_sent_too():
    fit = handheld_walk()
    markers = dataclasses.replace(
        fit,
        camera=Camera(np.full((3, 3), np.nan), np.full(5, np.nan), "none"),
        phone_quat_wxyz=np.full_like(fit.phone_quat_wxyz, np.nan),
        camera_position_m=np.full(3, np.nan),
        image_size_px=(0, 0),
    )
    body, numbers = body_json(Recording.of("walk", markers))
    assert body["camera"] is None
    assert body["known"] == [(5, 79)]
    assert len(numbers) == 2 * 90 * (3 + 4 * len(body["sides"]) + 4)
    nobody = dataclasses.replace(fit, qpos=np.full_like(fit.qpos, np.nan))
    sent = json.loads(Movement.of(Recording.of("walk", nobody)).movement)
    assert (sent["body"]["known"], sent["body"]["floor"]) == ([], None)


def test_the_floor_is_under_the_feet():
    """The walker's pelvis is 0.95 m above the floor, which lies 1.15 m under the camera (`walking_fit`)."""
    body, _ = body_json(Recording.of("walk", walking_fit()))
    assert body["floor"] == pytest.approx(-1.15, abs=0.06)
