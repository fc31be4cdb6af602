"""Videos without faces: heads found, held over gaps and covered (docs/privacy.md)."""

from .heads_of_video import find_heads
from .types import REASONS, Head, HeadParams, Heads
from .video_copy import (
    HOW,
    SPREAD_S,
    Deidentified,
    check_call,
    cover,
    covered_picture,
    deidentify,
    nothing_covered,
    sidecar_of,
    to_show,
)
