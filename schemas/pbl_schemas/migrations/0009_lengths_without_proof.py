"""Whether the feet show that a cycle of odd length is not one stride."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column `cycle_length_unproven` of GaitCycle.Cycle: null, not known, of cycles that were found before."""
    comment = "no feet show whether a step was missed; null: not left out for its length, or not known"
    columns = {"cycle_length_unproven": ("bool", comment, "cycle_length_ratio")}
    return added(conn, "gait", "__gait_cycle__cycle", columns)
