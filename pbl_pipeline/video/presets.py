"""Calibrations of known phones' main cameras, brought to the size and turn of a recording.

The figures (`data/phone_cameras.json`, made by `research/phone_cameras.py`) hold for the upright portrait picture of
video of 720 or 2160 lines. Video of 16:9 uses the full width of the sensor's longer side, so a recording of another
size is taken as the same view scaled by its longer side, and one of another shape as cut (or widened) about the
middle along the shorter side. How much a phone's own stabilisation crops is not published; it makes the focal length
longer.
"""

from __future__ import annotations

import functools
import json
import math
import re
from importlib.resources import files
from typing import Any

import numpy as np

from .camera import scaled_matrix
from .types import Camera, VideoInfo

#: Standard deviation of a preset's focal length as a fraction of it. The two recording formats that are published of
#: one phone differ by 1.2 % (iPhone 11) and 0.1 % (iPhone 12 Pro); the rest is for the crop of stabilised video, which
#: the calibrated recordings did not have. The project's own estimate.
PRESET_REL_SD = 0.04
#: Lenses shorter than this (mm, the glass itself) are front or ultra-wide cameras; the presets are of the main ones.
_SHORTEST_MAIN_MM = 3.0


def preset_camera(video: VideoInfo) -> Camera | None:
    """The intrinsics published for the phone that `video.model` names (Apple's name or identifier); None where it is
    not known, or where `video.lens` says that another than its main camera recorded."""
    known = presets()
    name = _plain(video.model)
    models = [m for m, n in known["names"].items() if name in (_plain(m), _plain(n))]
    cameras = [c for c in known["cameras"] if set(models) & set(c["models"])]
    if not cameras or not _is_main(video.lens):
        return None
    long_side = max(video.width_px, video.height_px)
    camera = min(cameras, key=lambda c: abs(math.log(max(c["size_px"]) / long_side)))
    (fx, fy), (cx, cy) = camera["focal_px"], camera["centre_px"]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = np.array(camera["distortion"])
    width, height = camera["size_px"]
    for _ in range(_quarters(video)):
        matrix, distortion = quarter_turn(matrix, distortion, width)
        width, height = height, width
    factor = long_side / max(width, height)
    matrix = scaled_matrix(matrix, factor)
    matrix[0, 2] += (video.width_px - factor * width) / 2  # cut or widened about the middle
    matrix[1, 2] += (video.height_px - factor * height) / 2
    focal = (matrix[0, 0] + matrix[1, 1]) / 2
    same = f", from {camera['size_px'][0]}x{camera['size_px'][1]} px" if factor != 1 else ""
    cut = "" if abs(width * factor - video.width_px) + abs(height * factor - video.height_px) <= 2 else ", cut to shape"
    source = (
        f"preset: main camera of the {known['names'][models[0]]}, calibrated by OpenCap{same}{cut} "
        f"(focal length {focal:.0f} px +- {100 * PRESET_REL_SD:.0f} %; the phone's stabilisation may crop)"
    )
    return Camera(matrix, distortion, source, PRESET_REL_SD)


@functools.cache
def presets() -> dict[str, Any]:
    """The data file: `source`, `names` (identifier to name), `cameras`."""
    return json.loads((files("pbl_pipeline.video") / "data" / "phone_cameras.json").read_text(encoding="utf-8"))


def quarter_turn(matrix: np.ndarray, distortion: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) and (5,) after the picture, `width` px wide, is turned counter-clockwise by 90 degrees.

    A point (x, y) comes to (y, width - 1 - x); the tangential coefficients change places as the axes do.
    """
    k1, k2, p1, p2, k3 = distortion
    turned = np.array(
        [[matrix[1, 1], 0.0, matrix[1, 2]], [0.0, matrix[0, 0], width - 1 - matrix[0, 2]], [0.0, 0.0, 1.0]]
    )
    return turned, np.array([k1, k2, -p2, p1, k3])


def _quarters(video: VideoInfo) -> int:
    """Quarter turns (counter-clockwise) from the portrait picture to the recording's.

    The sensor lies along the phone: stored pictures are turned by 90 deg in portrait, by 0 or 180 in landscape, by 270
    on the phone's head. A flag that does not fit the shape is that of a copy whose pictures were turned.
    """
    portrait = video.width_px <= video.height_px
    if (video.rotation_deg in (90, 270)) != portrait:
        return 0 if portrait else 1
    return (90 - video.rotation_deg) // 90 % 4


def _is_main(lens: str | None) -> bool:
    if not lens:
        return True
    glass = re.search(r"([\d.]+)\s*mm", lens)
    short = glass is not None and float(glass[1]) < _SHORTEST_MAIN_MM
    return not short and not any(word in lens.lower() for word in ("front", "ultra", "tele"))


def _plain(text: str | None) -> str:
    return re.sub(r"\s+", " ", (text or "").strip()).casefold()
