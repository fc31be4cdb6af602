"""Depth recordings in the formats that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError

from .folders import read_folder
from .record3d import read_record3d
from .recording import Depth, checked, depth_error


def read_depth(path: Path, time_s: np.ndarray, size_px: tuple[int, int], scale_m: float | None = None) -> Depth:
    """Read the depth recording of a video with frames at `time_s` (T,) and upright pictures of width and height
    `size_px`: a `.r3d` of Record3D, a folder of Stray Scanner, or with `scale_m`, the metres of one step, a folder of
    16-bit pictures, one for each frame.

    Raises `PblError` DEPTH_FILE as `checked`; FILE_MISSING; PACKAGE_MISSING for .r3d without the extra `depth`.
    """
    time = np.asarray(time_s, float) - float(time_s[0])
    if not path.exists():
        raise PblError("FILE_MISSING", "no such file or folder", "a depth recording", "check the path", path)
    if path.is_dir():
        return checked(read_folder(path, time, size_px, scale_m), len(time))
    if scale_m is not None:
        raise depth_error("a scale for a file", "a scale for a folder of 16-bit pictures", key=path)
    return checked(read_record3d(path, size_px), len(time))
