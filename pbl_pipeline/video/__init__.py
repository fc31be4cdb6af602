"""Video files: probe, frames in order with their own time stamps, camera intrinsics."""

from ._types import Camera, Frame, VideoInfo

__all__ = ["Camera", "Frame", "VideoInfo"]
