"""Depth recordings: each format, and bad input."""

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pbl_pipeline.depth import read_depth
from pbl_pipeline.errors import PblError

N, HEIGHT, WIDTH = 12, 24, 32
#: A video of 4:3.
VIDEO: Any = SimpleNamespace(time_s=np.arange(N) / 30, width_px=640, height_px=480)


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


def stray(folder: Path, end: str = "png") -> Path:
    write(folder / "depth", millimetres, end=end)
    write(folder / "confidence", lambda i: np.full((HEIGHT, WIDTH), 2, np.uint8))
    rows = "".join(f"{100 + t:.4f}, {i:06d}, 0, 0, 0, 0, 0, 0, 1\n" for i, t in enumerate(VIDEO.time_s))
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
    with pytest.raises(PblError) as caught:
        read_depth(path, VIDEO, scale_m)
    assert caught.value.code == "DEPTH_FILE"
    return caught.value


@pytest.mark.parametrize("form", ["png", "npy", "r3d", "folder"])
def test_each_format(tmp_path: Path, form: str):
    if form == "r3d":
        pytest.importorskip("lzfse")
        found = read_depth(record3d(tmp_path / "a.r3d"), VIDEO)
    elif form == "folder":
        found = read_depth(write(tmp_path / "a", millimetres), VIDEO, 0.001)
    else:
        found = read_depth(stray(tmp_path / "a", form), VIDEO)
    np.testing.assert_allclose(found.time_s, VIDEO.time_s, atol=1e-4)
    frame = found.frame(3)
    expected = depths(3)
    expected[0, 0] = expected[-1, -1] = np.nan  # nothing, and beyond 5 m
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-6)
    if form == "folder":
        assert (frame.confidence, found.matrix) == (None, None)
        return
    assert frame.confidence is not None
    assert found.matrix is not None
    assert set(frame.confidence.ravel()) == {2}
    np.testing.assert_allclose(found.matrix, [[30, 0, 16], [0, 30, 12], [0, 0, 1]])


@pytest.mark.parametrize(
    ("picture", "n", "scale", "found"),
    [
        (millimetres, 8, 0.001, "8 depth pictures for 12"),
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
    assert "0 pictures" in refused(write(tmp_path / "b", millimetres, 0), 0.001).found
    pytest.importorskip("lzfse")
    (tmp_path / "c.r3d").write_bytes(b"no zip")
    assert "Record3D" in refused(tmp_path / "c.r3d").found
    assert "0.depth" in refused(record3d(tmp_path / "d.r3d", wrong=b"damaged")).found
