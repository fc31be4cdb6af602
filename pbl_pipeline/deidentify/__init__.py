"""Videos without faces: heads found, held over gaps and covered (docs/privacy.md)."""

from .cover_heads import cover, outline
from .faces import FaceDetector
from .heads_of_video import find_heads
from .params import HeadParams
from .types import REASONS, SOURCES, Head, Heads, ranges
from .video_copy import (
    HOW,
    KEEP,
    SPREAD_S,
    STATUSES,
    Deidentified,
    check_call,
    covered_picture,
    deidentify,
    nothing_covered,
    sidecar_of,
    to_show,
)
