"""2D keypoints that other programs wrote, a reader for each format. `fit.read_keypoints` makes a trial of them."""

from __future__ import annotations

from pathlib import Path

from pbl_pipeline.body import MarkerSet

from .deeplabcut import read_dlc_csv, read_dlc_h5
from .h5_arrays import opened_h5
from .openpose import read_openpose
from .pixel_trc import is_pixel_trc, read_pixel_trc
from .poses import Poses
from .sleap import read_sleap

_H5 = (".h5", ".hdf5")


def is_pose_file(path: Path) -> bool:
    """True for a folder, or a name that only 2D keypoints of another program have."""
    return path.is_dir() or path.suffix.lower() in (".csv", *_H5) or is_pixel_trc(path)


def read_poses(path: Path, rate_hz: float, table: MarkerSet | None = None) -> Poses:
    """Read a folder of OpenPose's JSON, DeepLabCut's .csv or .h5, SLEAP's analysis .h5, or a .trc in pixels.

    `rate_hz`: frames a second, by which OpenPose's people are linked over time. `table`: order of OpenPose's points
    where their number does not say it.

    Raises `PblError` FILE_MISSING, FILE_FORMAT; PACKAGE_MISSING for .h5 without the extra `h5`.
    """
    if path.is_dir():
        return read_openpose(path, rate_hz, table)
    if path.suffix.lower() not in _H5:
        return read_pixel_trc(path) if is_pixel_trc(path) else read_dlc_csv(path)
    with opened_h5(path) as file:
        return read_sleap(path, file) if "tracks" in file and "node_names" in file else read_dlc_h5(path, file)
