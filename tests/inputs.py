"""Inputs of the fit for tests: small trials, a TRC file, a calibration, an orientation log."""

from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, WorldMarkers
from pbl_pipeline.video import Camera, CameraPose, VideoInfo

T, J = 5, 3
NAMES = ("A", "B", "C")
LENS = Camera(np.array([[1000.0, 0, 500], [0, 1000.0, 500], [0, 0, 1]]), np.zeros(5), "test")
POSE = CameraPose(np.eye(3), np.zeros(3))
PHONE_T = np.array([0.0, 0.02, 0.05])
LEVEL = np.array([0.5, -0.5, 0.5, -0.5])


def code_of(error: pytest.ExceptionInfo[PblError]) -> str:
    """The code of an error that was raised."""
    return error.value.code


def markers(**changes) -> WorldMarkers:
    values: dict = {
        "time_s": np.arange(T) / 100,
        "names": NAMES,
        "marker_set": "lab",
        "xyz_world_m": np.arange(T * J * 3, dtype=float).reshape(T, J, 3) / 10,
        "confidence": np.ones((T, J)),
    }
    return WorldMarkers(**{**values, **changes})


def lens_of(size_px: tuple[int, int]) -> Camera:
    """A lens like `LENS` for a picture of another size."""
    width, height = size_px
    return Camera(np.array([[1000.0, 0, width / 2], [0, 1000.0, height / 2], [0, 0, 1]]), np.zeros(5), "test")


def keypoints(**changes) -> Keypoints:
    values: dict = {
        "time_s": np.arange(T) / 30,
        "names": NAMES,
        "marker_set": "lab",
        "xy_px": np.zeros((T, J, 2)),
        "xyz_cam_m": np.full((T, J, 3), np.nan),
        "root_relative": True,
        "confidence": np.ones((T, J)),
        "image_size_px": (1000, 1000),
        "camera": lens_of(changes.get("image_size_px", (1000, 1000))),
        "box_px": np.full((T, 4), np.nan),
    }
    return Keypoints(**{**values, **changes})


def video_info(**changes) -> VideoInfo:
    """Facts of a video of three frames, filmed upright, whose container names no camera."""
    values: dict = {
        "path": "v.mov",
        "sha256": "0" * 64,
        "size_bytes": 1,
        "container": "mov",
        "codec": "h264",
        "pixel_format": "yuv420p",
        "width_px": 720,
        "height_px": 1280,
        "rotation_deg": 90,
        "time_s": np.arange(3) / 30,
        "fps": 30.0,
        "duration_s": 0.1,
        "n_frames": 3,
        "n_frames_announced": 3,
        "variable_frame_rate": False,
        "recorded_utc": None,
        "make": None,
        "model": None,
    }
    if "time_s" in changes:
        values |= dict.fromkeys(("n_frames", "n_frames_announced"), len(changes["time_s"]))
    return VideoInfo(**{**values, **changes})


def changed(array: np.ndarray, value: float) -> np.ndarray:
    array = np.array(array, float)
    array.flat[1] = value
    return array


def rewritten(path: Path, *without: str, **changes: object) -> Path:
    """An npz file without some of its fields and with others changed, written beside it."""
    with np.load(path) as f:
        fields = {name: f[name] for name in f.files if name not in without}
    new = path.with_stem(f"{path.stem}-new")
    np.savez(new, **{**fields, **changes})
    return new


def trc_text(rows: list[str], units: str = "mm", n_frames: int | None = None, names: str = "Hip\t\t\tHead\t\t") -> str:
    header = [
        "PathFileType\t4\t(X/Y/Z)\tC:\\walk.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"100\t100\t{len(rows) if n_frames is None else n_frames}\t2\t{units}\t100\t1\t{len(rows)}",
        f"Frame#\tTime\t{names}",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        "",
    ]
    return "\n".join([*header, *rows]) + "\n"


ROWS = ["1\t0.00\t100\t900\t200\t110\t1600\t210", "2\t0.01\t101\t901\t201\t\t\t", "3\t0.02\t102\t902\t202\t0\t0\t0\t"]


CALIBRATION = """
[cam_01]
size = [1000, 1000]
matrix = [[900, 0, 500], [0, 900, 500], [0, 0, 1]]
distortions = [0, 0, 0, 0]
rotation = [1.5707963267948966, 0, 0]
translation = [0, 1.5, 4]
[cam_02]
size = [500, 500]
matrix = [[900, 0, 250], [0, 900, 250], [0, 0, 1]]
distortions = [0, 0, 0, 0]
rotation = [0, 0, 0]
translation = [0, 0, 2]
[metadata]
error = 0
"""


def about(axis: int, angle_deg: float) -> list[float]:
    """Quaternion w, x, y, z of a turn about one axis."""
    half = np.radians(angle_deg) / 2
    quat = [np.cos(half), 0.0, 0.0, 0.0]
    quat[1 + axis] = np.sin(half)
    return quat


def csv_log(
    path: Path, quat: list[float], extra: dict[str, object] | None = None, n: int = 3, begin_s: float = 0.0
) -> Path:
    extra = extra or {}
    lines = [",".join(["time_s", "qw", "qx", "qy", "qz", *extra])]
    lines += [",".join(map(str, [round(begin_s + 0.02 * i, 6), *quat, *extra.values()])) for i in range(n)]
    path.write_text("\n".join(["# phone 7", *lines]) + "\n")
    return path


UPRIGHT = about(0, 90)  # the top of the screen to the zenith, its normal to world -y: the back camera looks along +y
