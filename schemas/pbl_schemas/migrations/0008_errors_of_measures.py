"""The error of each gait measure of a visit."""

from __future__ import annotations

from typing import Any

from ._columns import added

_UNIT = "in the unit (see session_measure):"
_COLUMNS = {
    "session_measure_error": (
        "float64",
        f"{_UNIT} standard deviation of the error of the mean",
        "session_measure_missing",
    ),
    "session_measure_minimal_change": (
        "float64",
        f"{_UNIT} minimal detectable change (90 percent)",
        "session_measure_error",
    ),
}


def statements(conn: Any) -> list[str]:
    """The columns of SessionGdi.Measure: null of visits that were measured before, until they are computed again."""
    return added(conn, "gdi", "__session_gdi__measure", _COLUMNS)
