"""Whether the errors of a joint are normally distributed."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column `joint_normal_p` of KinematicError.Joint: null of errors that were computed before."""
    comment = "(0..1) p of Shapiro-Wilk of the errors of the frames, or null"
    columns = {"joint_normal_p": ("float64", comment, "joint_within_90")}
    return added(conn, "validation", "__kinematic_error__joint", columns)
