"""Depth pictures in folders: of the app Stray Scanner, and 16-bit PNG with a scale (Kinect, RealSense, ARKit).

Stray Scanner (github.com/strayrobots/scanner, docs/format.md) writes `depth/` (16-bit PNG, older versions npy, in mm),
`confidence/` (PNG, 0 to 2), `odometry.csv` with a time (s) for each frame, and `camera_matrix.csv` of the video.
"""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from pbl_pipeline import bounded
from pbl_pipeline.results.video_facts import VideoInfo

from .frames import Depth, depth_error

#: Bytes of a picture.
_MOST = 16 * bounded.MIB
_ENDS = (".png", ".npy")


def read_stray(folder: Path, video: VideoInfo) -> Depth:
    """Read a recording of Stray Scanner. Raises `PblError` DEPTH_FILE."""
    try:
        rows = pd.read_csv(io.StringIO(bounded.read_text(folder / "odometry.csv")), skipinitialspace=True)
        time = rows["timestamp"].to_numpy(float)
        matrix = np.loadtxt(io.StringIO(bounded.read_text(folder / "camera_matrix.csv")), delimiter=",").reshape(3, 3)
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = "odometry.csv with timestamp, and camera_matrix.csv"
        raise depth_error(f"no recording of Stray Scanner ({error})", expected, key=folder) from error
    depth = read_pictures(folder / "depth", 0.001, time)
    height, width = depth.read(0)[0].shape
    matrix[:2] *= [[width / video.width_px], [height / video.height_px]]
    confidences = {f.stem: f for f in (folder / "confidence").glob("*.png")}
    files = _files(folder / "depth")

    def read(i: int) -> tuple[np.ndarray, np.ndarray | None]:
        file = confidences.get(files[i].stem)
        return depth.read(i)[0], None if file is None else _picture(file)

    return Depth(folder, depth.time_s, matrix, read)


def read_pictures(folder: Path, scale_m: float, time_s: np.ndarray) -> Depth:
    """Read a folder of 16-bit PNG in the order of their names; scale_m: metres of one step; time_s (N,): of the frames.

    Raises `PblError` DEPTH_FILE.
    """
    files = _files(folder)
    n = min(len(files), len(time_s))
    if not n:
        raise depth_error(f"{len(files)} pictures and {len(time_s)} times", "a .png or .npy of each frame", key=folder)

    def read(i: int) -> tuple[np.ndarray, None]:
        picture = _picture(files[i])
        if picture.dtype != np.uint16:
            raise depth_error(f"{files[i].name} of {8 * picture.itemsize} bits", "16 bits a pixel", key=folder)
        return picture * scale_m, None

    return Depth(folder, np.asarray(time_s[:n], float) - float(time_s[0]), None, read)


def _files(folder: Path) -> list[Path]:
    return sorted(f for f in folder.glob("*") if f.suffix.lower() in _ENDS)


def _picture(file: Path) -> np.ndarray:
    try:
        data = bounded.read_bytes(file, _MOST)
        if file.suffix.lower() == ".npy":
            picture = np.load(io.BytesIO(data), allow_pickle=False)
        else:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.ndim != 2:
            raise ValueError("no picture of one value a pixel")
    except (OSError, ValueError, cv2.error) as error:
        raise depth_error(f"{file.name}: {error}", "a picture of one value a pixel", key=file.parent) from error
    return picture
