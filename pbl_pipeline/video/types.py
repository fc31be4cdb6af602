"""Types of a video file: its facts, one decoded frame and regions of it, and the intrinsics of its camera."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import cv2
import numpy as np

from pbl_pipeline.results.video_facts import CAMERA_KINDS, Intrinsics


def cut_image(image: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """`Frame.cut` of a converted picture (H, W, 3) uint8."""
    return cut_samples(image, matrix, size_px, 0.0)


def cut_samples(samples: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int], border: float) -> np.ndarray:
    """Bilinear interpolation, after averaging blocks of 2^n x 2^n samples if the region's pixels lie that far apart:
    otherwise the region would flicker."""
    (a, b, _), (c, d, _) = matrix.tolist()
    block = 1 << max(0, math.floor(math.log2(max(math.sqrt(abs(a * d - b * c)), 1.0))))
    if block > 1:
        samples, left, top = _needed(samples, matrix, size_px, block)
        if not samples.size:  # the region lies beyond the picture
            samples = np.full((block, block, *samples.shape[2:]), border, samples.dtype)
        down, right = (-n % block for n in samples.shape[:2])
        if down or right:  # the last block is incomplete
            samples = cv2.copyMakeBorder(samples, 0, down, 0, right, cv2.BORDER_REPLICATE)
        size = samples.shape[1] // block, samples.shape[0] // block
        samples = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
        matrix = to_blocks(matrix - [[0, 0, left], [0, 0, top]], block, block)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(samples, matrix, size_px, flags=flags, borderValue=(border,) * 4)


def _needed(
    samples: np.ndarray, matrix: np.ndarray, size_px: tuple[int, int], block: int
) -> tuple[np.ndarray, int, int]:
    """The samples around the region, in whole blocks, and their first column and row."""
    (a, b, x), (c, d, y) = matrix.tolist()
    right, down = size_px[0] - 1, size_px[1] - 1
    ends = ((x, a * right, b * down), (y, c * right, d * down))
    # An affine map has its extremes at the corners.
    left, top = (max(math.floor((at + min(i, 0) + min(j, 0)) / block - 1) * block, 0) for at, i, j in ends)
    last, lowest = (max(math.ceil((at + max(i, 0) + max(j, 0)) / block + 2) * block, 0) for at, i, j in ends)
    return samples[top:lowest, left:last], left, top


def to_blocks(matrix: np.ndarray, x: int, y: int) -> np.ndarray:
    """A matrix (2, 3) to pixel centres, as one to the centres of blocks of x by y pixels."""
    scale = np.array([1 / x, 1 / y])
    out = matrix * scale[:, None]
    out[:, 2] += (scale - 1) / 2
    return out


def square(matrix: np.ndarray) -> np.ndarray:
    """A matrix (2, 3) as a homogeneous one (3, 3)."""
    out = np.eye(3)
    out[:2] = matrix
    return out


class Frame:
    """One decoded frame. `image` (H, W, 3) uint8, channels BGR (OpenCV's order), upright.

    The picture is converted at the first access, so frames that are not used cost nothing; `cut` converts one region
    only. Not safe for use by two threads at once.
    """

    def __init__(
        self,
        index: int,
        time_s: float,
        convert: Callable[[], np.ndarray],
        cut: Callable[[np.ndarray, tuple[int, int]], np.ndarray | None] | None = None,
        size_px: tuple[int, int] | None = None,
    ) -> None:
        self.index, self.time_s = index, time_s
        self._size = size_px
        self._convert: Callable[[], np.ndarray] | None = convert
        self._cut = cut

    @functools.cached_property
    def image(self) -> np.ndarray:
        assert self._convert is not None
        image = self._convert()
        self._convert = self._cut = None  # releases the decoder's picture
        return image

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the upright picture."""
        return self._size or (self.image.shape[1], self.image.shape[0])

    def cut(self, matrix: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """A region of the upright picture, (height, width, 3) uint8 BGR for `size_px` = (width, height).

        `matrix` (2, 3) sends pixel centres of the region (0, 0 is the first) to pixel centres of the picture. Pixels
        that lie far apart there show the mean of the pixels between them. Black beyond the picture.
        """
        region = self._cut(matrix, size_px) if self._cut is not None else None
        return cut_image(self.image, matrix, size_px) if region is None else region


@dataclasses.dataclass(frozen=True)
class Camera:
    """Intrinsics of the upright frame: `matrix` (3, 3) in px, `distortion` (5,) OpenCV order k1 k2 p1 p2 k3.

    `source` states their origin, its first word is the `kind`: "file" and "measured" (a calibration), "metadata" (the
    phone's entry in the video), "preset" (a phone of that model), "guess". `focal_rel_sd`: standard deviation of the
    focal length as a fraction of it, NaN if not known.
    """

    matrix: np.ndarray
    distortion: np.ndarray
    source: str
    focal_rel_sd: float = math.nan

    @classmethod
    def of(cls, c: Intrinsics) -> Camera:
        """Return the camera of the figures of a calibration."""
        matrix = np.array([[c.fx_px, 0.0, c.cx_px], [0.0, c.fy_px, c.cy_px], [0.0, 0.0, 1.0]])
        rel_sd = np.nan if c.focal_sd_px is None else 2 * c.focal_sd_px / (c.fx_px + c.fy_px)
        return cls(matrix, np.asarray(c.distortion, float), f"{c.origin}: {c.note}", rel_sd)

    def measured(self, size_px: tuple[int, int]) -> Intrinsics:
        """Return the figures of a calibration, which holds for pictures of a size (width, height)."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        sd, note = self.focal_rel_sd * self.focal_px, self.source.removeprefix("file:").strip()
        return Intrinsics("measured", *size_px, fx, fy, cx, cy, self.distortion, sd, note)

    @property
    def kind(self) -> str:
        """Kind of the source, one of `CAMERA_KINDS`: files store it as the first word of `source`."""
        word = self.source.partition(":")[0]
        return word if word in CAMERA_KINDS else "other"

    @property
    def calibrated(self) -> bool:
        """True if the intrinsics were measured with this camera."""
        return self.kind in ("file", "measured")

    @property
    def focal_px(self) -> float:
        """Mean of the two focal lengths, px."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2
