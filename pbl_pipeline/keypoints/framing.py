"""Whether the picture of a camera cuts off the feet or the head of the person in it, while she is filmed."""

from __future__ import annotations

import cv2
import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.tracking.blazepose import BlazePoseDetector
from pbl_pipeline.video import guess_camera

from .blazepose import BlazePoseLandmarks
from .in_view import feet_and_head

FEET, HEAD = "feet", "head"
#: Least presence of a person in the region that was found.
_PRESENT = 0.5
#: Points of a foot closer to the lower border, and of the face closer to the upper one, than this share of the height
#: from face to feet are cut off: the crown is 0.07 of it above the eyes. Tried on `research.benchmarks.framing`.
_FOOT, _FACE = 0.005, 0.06
#: Largest side of a picture that is looked at (px).
MOST_PX = 1280


class Framing:
    """Two small networks, a look of about 35 ms on one core. Not to be shared by threads.

    Raises the `PblError`s of `assets.fetch`.
    """

    def __init__(self) -> None:
        self._detector = BlazePoseDetector(assets.fetch("blazepose_detector"))
        self._points = BlazePoseLandmarks(assets.fetch("blazepose_landmarks"))
        self._feet, self._head = feet_and_head(self._points.names)

    def cut_off(self, image: np.ndarray) -> str | None:
        """Return what of the person in `image` (H, W, 3) uint8 BGR is cut off: `FEET`, `HEAD` or ""; None if no person
        is found, as of one who takes less than a fifth of the picture's height."""
        height, width = image.shape[:2]
        found = self._detector.detect(image)
        if not found:
            return None
        person = self._points.detect(image, found[0].roi_px, guess_camera((width, height)), quick=True)
        if person.presence < _PRESENT:
            return None
        y = person.xy_px[:, 1]
        lowest, highest = float(y[self._feet].max()), float(y[self._head].min())
        if lowest > height - _FOOT * (lowest - highest):
            return FEET
        return HEAD if highest < _FACE * (lowest - highest) else ""


def read_picture(content: bytes) -> np.ndarray | None:
    """Return a JPEG (H, W, 3) uint8 BGR; None for other bytes, and for a side beyond `MOST_PX`: the size is read
    before its pixels."""
    size = jpeg_size(content)
    if size is None or not 0 < min(size) <= max(size) <= MOST_PX:
        return None
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None


def jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height that the frame header of a JPEG states (ITU-T T.81, B.2.2). None for one that is not of
    baseline coding, as browsers write it, and where anything but tables, comments and data of applications precedes."""
    at = 2
    while content[:2] == b"\xff\xd8" and at + 9 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xC0:
            return int.from_bytes(content[at + 7 : at + 9], "big"), int.from_bytes(content[at + 5 : at + 7], "big")
        if marker not in (0xC4, 0xDB, 0xDD, 0xFE) and not 0xE0 <= marker <= 0xEF:
            return None
        at += 2 + length
    return None
