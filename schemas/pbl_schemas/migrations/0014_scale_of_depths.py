"""Whether a depth recording is read, and the scale that a person stated."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The columns of DepthVideo: null of files that were attached before, which are kept and not read."""
    scale = "(m) one step of its 16-bit pictures, as a person stated; null: the recording says it"
    columns = {
        "depth_read": ("bool", "false, and null of older rows: kept, not read", "depth_name"),
        "depth_scale": ("float64", scale, "depth_read"),
    }
    return added(conn, "video", "depth_video", columns)
