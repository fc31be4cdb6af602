"""The body height that a fit was told."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column `fit_height` of SessionFit: null, because no fit of before was told one."""
    comment = "(m) body height of the person that the fit was told, null: not known"
    return added(conn, "fit", "__session_fit", {"fit_height": ("float64", comment, "fit_scale")})
