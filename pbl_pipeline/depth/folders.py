"""Depth pictures in folders: of the app Stray Scanner, and 16-bit PNG with a scale (Kinect, RealSense, ARKit).

Stray Scanner (github.com/strayrobots/scanner, docs/format.md) writes `depth/` (16-bit PNG, older versions npy, in mm),
`confidence/` (PNG, 0 to 2), `odometry.csv` with a time (s) for each frame, and `camera_matrix.csv` of the video. Other
folders may also hold the last one, and `depth_matrix.csv` where the depth camera has another field of view.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from pbl_pipeline import bounded

from .recording import Depth, Pictures, depth_error

#: Bytes of a picture.
_MOST = 16 * bounded.MIB
_ENDS = (".png", ".npy")
#: Files of camera matrices: of the video's pictures, and of the depth pictures.
_MATRICES = "camera_matrix.csv", "depth_matrix.csv"


def read_folder(folder: Path, time_s: np.ndarray, size_px: tuple[int, int], scale_m: float | None) -> Depth:
    """Read a folder of depth pictures in the order of their names. `scale_m`: metres of one step, None of Stray
    Scanner's; `time_s` (T,): of the video's frames, which other folders have a picture for each. Raises `PblError`
    DEPTH_FILE."""
    inside, confidences = folder, dict[str, Path]()
    if scale_m is None:
        inside, scale_m = folder / "depth", 0.001
        time_s = _stray_times(folder)
        confidences = {f.stem: f for f in (folder / "confidence").glob("*.png")}
    elif not 0 < scale_m < 1000:
        raise depth_error(f"a scale of {scale_m:g} m", "metres of one step, such as 0.001", key=folder)
    files = sorted(f for f in inside.glob("*") if f.suffix.lower() in _ENDS)
    if not files:
        raise depth_error("no depth pictures", "a .png or .npy of each frame", key=folder)
    matrix, own = (_matrix(folder / name) for name in _MATRICES)
    if own is not None and matrix is None:
        raise depth_error(f"{_MATRICES[1]} alone", f"{_MATRICES[0]} beside it", key=folder)

    def read(frames: Iterable[int]) -> Iterator[Pictures]:
        for i in frames:
            picture, confidence = _picture(files[i]), confidences.get(files[i].stem)
            if picture.dtype != np.uint16:
                bits = f"{files[i].name} of {8 * picture.itemsize} bits ({picture.dtype})"
                raise depth_error(bits, "16 bits a pixel, whole numbers", key=folder)
            yield picture * scale_m, None if confidence is None else _picture(confidence)

    return Depth(folder, time_s[: len(files)] - time_s[0], size_px, matrix, own, read)


def _stray_times(folder: Path) -> np.ndarray:
    try:
        rows = pd.read_csv(io.StringIO(bounded.read_text(folder / "odometry.csv")), skipinitialspace=True)
        time = rows["timestamp"].to_numpy(float)
        if not len(time):
            raise ValueError("no rows")
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = "a folder of Stray Scanner with odometry.csv, or the scale of the folder's 16-bit pictures"
        raise depth_error(f"no recording of Stray Scanner ({error})", expected, key=folder) from error
    return time


def _matrix(file: Path) -> np.ndarray | None:
    if not file.exists():
        return None
    try:
        return np.loadtxt(io.StringIO(bounded.read_text(file)), delimiter=",").reshape(3, 3)
    except (OSError, ValueError) as error:
        raise depth_error(f"{file.name}: {error}", "3 rows of 3 numbers", key=file.parent) from error


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
