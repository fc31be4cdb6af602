"""What is known of a video file, and one decoded frame."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class VideoInfo:
    """A probed video. Sizes are after the rotation flag is applied: what a person sees when it plays.

    Attributes
    ----------
    time_s : (T,) float64
        Presentation time of each frame that decodes, from the container's own stamps, first frame at 0.
    fps
        1 / median frame interval; a description only: no computation may use it instead of `time_s`.
    n_frames_announced
        What the container's header claims (0 when it says nothing). What decodes counts.
    """

    path: str
    sha256: str
    size_bytes: int
    container: str
    codec: str
    pixel_format: str
    width_px: int
    height_px: int
    rotation_deg: int
    time_s: np.ndarray
    fps: float
    duration_s: float
    n_frames: int
    n_frames_announced: int
    variable_frame_rate: bool
    recorded_utc: str | None
    make: str | None
    model: str | None


@dataclasses.dataclass(frozen=True)
class Frame:
    """One decoded frame: `image` (H, W, 3) uint8, channels BGR (OpenCV's order), upright."""

    index: int
    time_s: float
    image: np.ndarray
