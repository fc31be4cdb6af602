"""Depth recordings beside a video: Record3D, Stray Scanner, and 16-bit pictures with a scale (docs/depth.md)."""

from .points import at_points
from .read import read_depth
from .recording import Depth
