"""Video files: probe, frames in order with their own time stamps, camera intrinsics."""

from ._probe import probe, sha256_of
from ._read import read_frames
from ._types import Camera, Frame, VideoInfo

__all__ = ["Camera", "Frame", "VideoInfo", "probe", "read_frames", "sha256_of"]
