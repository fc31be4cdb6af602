"""Quality of the picture of the person: light, contrast and blur, measured in a few frames while they pass by.

A detector returns points also in the dark and out of focus, but worse ones, and its confidence falls late. The picture
is measured at the person's position and scale: the middle strip of the crop, scaled to `SIDE` pixels high.
docs/confidence.md explains the thresholds of the checks.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers
from pbl_pipeline.video import Frame

#: Height (px) of the crop in which the picture is measured: about that of the landmark networks.
SIDE = 256
#: Fraction of the crop's width that is measured: the body without its surroundings.
STRIP = 0.4
#: Standard deviation of the Gaussian (px of the crop) that removes the sensor's noise before the blur is measured.
_CALM_SD = 1.0
#: Interval of the measured frames (s).
_EVERY_S = 0.5
_LEAST_PX = 8


@dataclasses.dataclass(frozen=True)
class Picture:
    """Measures of P frames."""

    time_s: np.ndarray  # (P,) the frames' time stamps
    luma: np.ndarray  # (P, 3) 5th, 50th and 95th percentile of the brightness (0..255) where the person is
    #: (P,) length of the finest detail as a fraction of the person's size, `detail_of`. Blur makes it longer.
    detail: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """Fields of `keypoints.npz`."""
        return {
            "picture_time_s": np.asarray(self.time_s, np.float64),
            "picture_luma": np.asarray(self.luma, np.float32),
            "picture_detail": np.asarray(self.detail, np.float32),
        }

    @classmethod
    def from_arrays(cls, path: str | Path, data: Mapping[str, np.ndarray]) -> Picture | None:
        """Read the fields of a file; None if it has none. Raises `PblError` FILE_FORMAT."""
        if "picture_time_s" not in data:
            return None
        n = data["picture_time_s"].size
        missing = [name for name in ("picture_luma", "picture_detail") if name not in data]
        if missing:
            raise PblError(
                "FILE_FORMAT",
                found=f"picture_time_s without {', '.join(missing)}",
                expected="all fields of the picture or none",
                next_step="see docs/files.md, section keypoints.npz",
                key=str(path),
            )
        check_numbers(path, data, {"picture_time_s": (n,), "picture_luma": (n, 3), "picture_detail": (n,)})
        return cls(data["picture_time_s"], data["picture_luma"], data["picture_detail"])

    @property
    def bright(self) -> float:
        """Median over the frames of the 95th percentile of the brightness, NaN without a frame.

        The brightest parts, because dark clothes do not make a picture dark."""
        return _median(self.luma[:, 2])

    @property
    def detail_share(self) -> float:
        """Median of `detail`, NaN without a frame."""
        return _median(self.detail)


class PictureMeter:
    """Measures one frame in each `_EVERY_S` seconds, of those that pass through `watch`."""

    def __init__(self) -> None:
        self._next_s = -math.inf
        self._rows: list[tuple[float, np.ndarray, float]] = []

    def watch(self, frames: Iterable[Frame], roi_px: np.ndarray) -> Iterator[Frame]:
        """Yield all frames, and measure some; `roi_px` (T, 4) is the region of interest of each frame, or NaN."""
        for frame in frames:
            if frame.time_s >= self._next_s and np.isfinite(roi_px[frame.index]).all():
                self.add(frame.time_s, frame.image, roi_px[frame.index])
            yield frame

    def add(self, time_s: float, image: np.ndarray, roi_px: np.ndarray) -> None:
        """Measure `image` (H, W, 3) uint8 BGR around the region `roi_px` (4,): centre x, y, side, rotation."""
        strip = _strip(image, roi_px)
        if strip is None:
            return
        self._next_s = time_s + _EVERY_S
        self._rows.append((time_s, np.percentile(strip, (5, 50, 95)), detail_of(strip)))

    def result(self) -> Picture:
        """Return the measures so far."""
        if not self._rows:
            return Picture(np.zeros(0), np.zeros((0, 3)), np.zeros(0))
        time, luma, detail = zip(*self._rows, strict=True)
        return Picture(np.array(time), np.array(luma), np.array(detail))


def detail_of(strip: np.ndarray) -> float:
    """Length of the finest detail of a grey picture (H, W) whose height is the person's size, as a fraction of it.

    sqrt(variance / variance of the step between neighbouring pixels), along the axis with the longer detail, because
    movement blurs along one axis. Independent of brightness and contrast. NaN for a flat picture.
    """
    calm = cv2.GaussianBlur(strip.astype(np.float32), (0, 0), _CALM_SD)
    steps = min(float(np.var(np.diff(calm, axis=0))), float(np.var(np.diff(calm, axis=1))))
    variance = float(np.var(calm))
    return math.sqrt(variance / steps) / len(strip) if steps > 0 else math.nan


def _strip(image: np.ndarray, roi_px: np.ndarray) -> np.ndarray | None:
    """Grey strip (<= SIDE, W) uint8 of the person; None if hardly anything of it is in the picture."""
    x, y, side, _ = (float(v) for v in roi_px)
    height, width = image.shape[:2]
    x0, x1 = max(0, round(x - STRIP * side / 2)), min(width, round(x + STRIP * side / 2))
    y0, y1 = max(0, round(y - side / 2)), min(height, round(y + side / 2))
    if x1 - x0 < max(_LEAST_PX, 0.5 * STRIP * side) or y1 - y0 < max(_LEAST_PX, 0.5 * side):
        return None
    scale = SIDE / side
    size = max(2, round((x1 - x0) * scale)), max(2, round((y1 - y0) * scale))
    small = cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan
