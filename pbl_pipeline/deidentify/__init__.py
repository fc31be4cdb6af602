"""Videos without faces: heads found, held over gaps and covered (docs/privacy.md)."""

from .heads_of_video import FaceDetector, find_heads
from .types import REASONS, SOURCES, Head, HeadParams, Heads, ranges
from .video_copy import (
    HOW,
    KEEP,
    SPREAD_S,
    STATUSES,
    Deidentified,
    check_call,
    cover,
    covered_picture,
    deidentify,
    nothing_covered,
    outline,
    sidecar_of,
    to_show,
)
