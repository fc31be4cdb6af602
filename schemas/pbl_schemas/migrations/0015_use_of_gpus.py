"""Use of the GPUs of a worker's machine."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column `worker_gpus` of Worker: null, not known, of workers of before."""
    comment = "of a supervisor: use of the GPUs of its machine; null: not known"
    return added(conn, "worker", "worker", {"worker_gpus": ("json", comment, "worker_doing")})
