"""Depth recordings beside a video: Record3D, Stray Scanner, and 16-bit pictures with a scale (docs/depth.md)."""

from .packed import pack, sha256_of_recording
from .points import PointDepths, at_points
from .read import DepthFile, check_recording, read_depth, with_recordings
from .recording import Depth
