"""The segments of the body on which wearable sensors were worn."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The columns of WearableImu: null of files that were attached before, which are kept and not read."""
    names = "segment of the body, such as shank_r, to the name of its sensor in the file; null: kept, not read"
    rate = "(1/s) samples a second, as a person stated; null: the file says it"
    columns = {"imu_segments": ("json", names, "imu_name"), "imu_rate": ("float64", rate, "imu_segments")}
    return added(conn, "video", "wearable_imu", columns)
