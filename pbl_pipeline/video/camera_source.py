"""Whose word counts for a video's intrinsics: a calibration, then the file, then its phone's model, then a guess."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from .camera import guess_camera
from .lens_calibration import calibrated_camera
from .presets import PRESET_REL_SD, preset_camera
from .types import Camera, VideoInfo

#: 35 mm film: width and diagonal of its frame (mm).
_FILM_WIDTH_MM, _FILM_DIAGONAL_MM = 36.0, math.hypot(36.0, 24.0)
#: Standard deviation of a focal length from the file's 35 mm figure, as a fraction of it: 2.3 % for the two readings of
#: such a figure, 1.1 % for its rounding to whole millimetres, and room for a crop that it does not count. Of an iPhone
#: 13 the figure is 27 mm, from which comes 0.733 of the longer side; its published calibration has 0.732.
METADATA_REL_SD = 0.03


def find_camera(video: VideoInfo, file: str | Path | None = None) -> Camera:
    """The best known intrinsics of a probed video; `source` says whose they are.

    In this order: the calibration `file`; the focal length that the phone wrote into the video; the published
    calibration of a phone of that model; a typical phone's (`guess_camera`).

    Raises `PblError` CAMERA_INVALID for a calibration that cannot be used (`calibrated_camera`).
    """
    if file is not None:
        return calibrated_camera(file, video)
    return metadata_camera(video) or preset_camera(video) or guess_camera(video)


def metadata_camera(video: VideoInfo) -> Camera | None:
    """Intrinsics from the figure of 35 mm film in the file (`focal_35mm`); None where it has none that can be.

    Two readings of such figures are in use: as long as a lens that gives the same view along the diagonal (CIPA
    DCG-001), or along the longer side. In a picture of 16:9 the second is 5 % longer; their geometric mean is taken.
    The distortion is that of the phone's published calibration, where it has one whose focal length agrees: then it is
    the same lens, not zoomed. Else it is zero.
    """
    if video.focal_35mm is None or not 5 <= video.focal_35mm <= 500:
        return None
    long_side, diagonal = max(video.width_px, video.height_px), math.hypot(video.width_px, video.height_px)
    along, across = video.focal_35mm / _FILM_WIDTH_MM * long_side, video.focal_35mm / _FILM_DIAGONAL_MM * diagonal
    focal = math.sqrt(along * across)
    matrix = np.array([[focal, 0, (video.width_px - 1) / 2], [0, focal, (video.height_px - 1) / 2], [0, 0, 1]])
    camera = video.lens or " ".join(t for t in (video.make, video.model) if t)
    known = preset_camera(video)
    same = known is not None and abs(focal / known.focal_px - 1) <= 2 * math.hypot(METADATA_REL_SD, PRESET_REL_SD)
    distortion = known.distortion if known is not None and same else np.zeros(5)
    source = (
        f"metadata: {video.focal_35mm:g} mm on 35 mm film{f', {camera[:80]}' if camera else ''} (focal length "
        f"{focal:.0f} px +- {100 * METADATA_REL_SD:.0f} %, {'distortion of that model' if same else 'no distortion'})"
    )
    return Camera(matrix, distortion, source, METADATA_REL_SD)
