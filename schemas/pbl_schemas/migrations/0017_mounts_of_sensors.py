"""How wearable sensors sit on their segments, as a person states it."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column of WearableImu."""
    mounts = "segment to where two axes of its sensor point, such as x up, z back, as a person stated; null: none"
    return added(conn, "video", "wearable_imu", {"imu_mounts": ("json", mounts, "imu_rate")})
