"""The index that is not drawn towards the mean of people, of trials and visits."""

from __future__ import annotations

from typing import Any

from ._columns import added

_MEANING = "(-) not drawn towards the mean of people: for correlations and means over people"


def statements(conn: Any) -> list[str]:
    """The columns of GDI and SessionGdi: null of visits that were measured before, until they are computed again."""
    out = []
    for table, name in (("__g_d_i", "gdi_unshrunk"), ("__session_gdi", "session_gdi_unshrunk")):
        before = name.replace("unshrunk", "minimal_change")
        error = f"(-) standard deviation of the error of {name}"
        columns = {name: ("float64", _MEANING, before), f"{name}_sd": ("float64", error, name)}
        out += added(conn, "gdi", table, columns)
    return out
