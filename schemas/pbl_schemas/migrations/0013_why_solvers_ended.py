"""The reason why the solver of a fit ended."""

from __future__ import annotations

from typing import Any

from ._columns import added


def statements(conn: Any) -> list[str]:
    """The column `fit_result` of SessionFit: null, not known, of fits from before it was recorded."""
    meaning = "why the solver ended: small_step, small_gain or max_steps_reached; null: not recorded"
    return added(conn, "fit", "__session_fit", {"fit_result": ("varchar(32)", meaning, "fit_converged")})
