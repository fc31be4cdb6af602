"""Video files: probe, frames in order with their own time stamps, camera intrinsics."""

from ._camera import guess_camera, load_camera, viewing_ray
from ._probe import probe, sha256_of
from ._read import read_frames
from ._types import Camera, Frame, VideoInfo

__all__ = [
    "Camera",
    "Frame",
    "VideoInfo",
    "guess_camera",
    "load_camera",
    "probe",
    "read_frames",
    "sha256_of",
    "viewing_ray",
]
