"""TRC files in pixels, as Sports2D writes them from RTMLib: `<video>_Sports2D_px_person00.trc`.

Their header states metres. x is right, y down, z 0; they have no confidence. `DataRate` is the video's rate, rounded to
a whole number.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbl_pipeline.keypoints.world_markers import read_trc

from .poses import Poses, bad_file


def is_pixel_trc(path: Path) -> bool:
    """True by the name, as Sports2D tells them apart."""
    return path.suffix.lower() == ".trc" and "_px" in path.stem


def read_pixel_trc(path: Path) -> Poses:
    """Read such a file. See `read_poses`."""
    trc = read_trc(path, pixels=True)
    if np.nanmax(np.abs(trc.xyz_m[..., 2]), initial=0.0) > 0:
        raise bad_file("z that is not 0", "points in pixels in a file named _px", key=path)
    step = float(np.median(np.diff(trc.time_s))) if len(trc.time_s) > 1 else np.nan
    rate = (len(trc.time_s) - 1) / float(np.ptp(trc.time_s)) if step > 0 else np.nan
    frame = np.round(trc.time_s * rate).astype(int) if step > 0 else np.zeros(len(trc.time_s), int)
    xy = trc.xyz_m[None, ..., :2]
    return Poses("TRC in pixels", frame, ("1",), trc.names, xy, np.full(xy.shape[:3], np.nan), rate)
