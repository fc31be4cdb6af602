"""Depth pictures beside a video, and what they are compared with: the video, and distances that a sensor can see."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results.video_facts import VideoInfo

#: Farthest depth (m) that is used: beyond it the sensors of phones guess.
FARTHEST_M = 5.0
#: Typical depths (m) of a recording of a person.
_TYPICAL_M = (0.15, 20.0)
#: Pictures that are looked at; most of what they show that may lie beyond `FARTHEST_M`; differences of the shapes of
#: the pictures and of the numbers of frames, as fractions.
_LOOKED_AT, _MOST_FAR, _SHAPE, _FEWER = 5, 0.9, 0.03, 0.02

depth_error = functools.partial(
    PblError, "DEPTH_FILE", next_step="export it again as docs/imu.md says, or leave it out"
)


@dataclasses.dataclass(frozen=True)
class DepthFrame:
    """`depth_m` (H, W) float32: distance along the camera's axis, NaN where it is not known or beyond `FARTHEST_M`;
    `confidence` (H, W) 0 to 2, None if the sensor states none."""

    depth_m: np.ndarray
    confidence: np.ndarray | None


@dataclasses.dataclass(frozen=True)
class Depth:
    """A depth recording. `time_s` (N,): of its frames, 0 is the first; `matrix` (3, 3) px: of the depth picture, None
    if the file does not state it; `read`: raw depths (m) and confidence of frame i."""

    path: Path
    time_s: np.ndarray
    matrix: np.ndarray | None
    read: Callable[[int], tuple[np.ndarray, np.ndarray | None]]

    def frame(self, i: int) -> DepthFrame:
        """Read a frame. Raises `PblError` DEPTH_FILE."""
        depth, confidence = self.read(i)
        known = np.isfinite(depth) & (depth > 0) & (depth <= FARTHEST_M)
        return DepthFrame(np.where(known, depth, np.nan).astype(np.float32), confidence)


def checked(depth: Depth, video: VideoInfo) -> Depth:
    """Compare a recording with its video.

    Raises `PblError` DEPTH_FILE: fewer frames than the video; pictures that are turned by 90 deg or of another camera;
    depths of nothing, in another unit than stated, or nearly all beyond `FARTHEST_M`; times that do not increase.
    """
    n = len(depth.time_s)
    if n < (1 - _FEWER) * len(video.time_s):
        raise depth_error(
            said("{n} depth pictures for {all} of the video", n=n, all=len(video.time_s)),
            "one for each frame of the video",
            key=depth.path,
        )
    if not np.isfinite(depth.time_s).all() or np.any(np.diff(depth.time_s) <= 0):
        raise depth_error("times that are missing or do not increase", "seconds for each frame", key=depth.path)
    seen = [depth.read(i)[0] for i in np.unique(np.linspace(0, n - 1, _LOOKED_AT).astype(int))]
    if len({x.shape for x in seen}) > 1:
        raise depth_error("pictures of different sizes", "one size", key=depth.path)
    height, width = seen[0].shape
    shape = (width / height) / (video.width_px / video.height_px)
    if abs(shape - 1) > _SHAPE:
        turned = abs(width / height * video.width_px / video.height_px - 1) <= _SHAPE
        raise depth_error(
            said(
                "depth pictures of {w}x{h}{how} beside a video of {w2}x{h2}",
                w=width,
                h=height,
                how=said(", turned by 90 deg," if turned else ", of another camera,"),
                w2=video.width_px,
                h2=video.height_px,
            ),
            "pictures of one camera, upright as the video is shown",
            key=depth.path,
        )
    values = np.concatenate([x[np.isfinite(x) & (x > 0)] for x in seen])
    if not len(values):
        raise depth_error("depths of 0 in all pictures", "metres", key=depth.path)
    typical, far = float(np.median(values)), float(np.mean(values > FARTHEST_M))
    if not _TYPICAL_M[0] <= typical <= _TYPICAL_M[1]:
        raise depth_error(
            said("depths of typically {d:.3g} m, as in millimetres or with another scale", d=typical),
            f"{_TYPICAL_M[0]:g} to {FARTHEST_M:g} m; the scale is metres of one step of a 16-bit picture",
            key=depth.path,
        )
    if far > _MOST_FAR:
        raise depth_error(
            said("{share:.0%} of the depths beyond {far:g} m", share=far, far=FARTHEST_M),
            "a person nearer to the camera",
            key=depth.path,
        )
    return depth
