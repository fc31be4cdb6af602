"""Depth recordings beside a video: Record3D, Stray Scanner, and 16-bit pictures with a scale."""

from pathlib import Path

import numpy as np

from pbl_pipeline.results.video_facts import VideoInfo

from .folders import read_pictures, read_stray
from .frames import FARTHEST_M, Depth, DepthFrame, checked
from .record3d import read_record3d


def read_depth(path: Path, video: VideoInfo, scale_m: float | None = None) -> Depth:
    """Read the depth recording of a video, which its content tells: `.r3d`, a folder of Stray Scanner, or a folder of
    16-bit PNG with `scale_m` metres a step and one picture for each frame of the video.

    Raises `PblError` DEPTH_FILE as `checked`; PACKAGE_MISSING for .r3d without the extra `depth`.
    """
    if path.is_dir() and scale_m is None:
        return checked(read_stray(path, video), video)
    found = read_record3d(path) if scale_m is None else read_pictures(path, scale_m, np.asarray(video.time_s))
    return checked(found, video)
