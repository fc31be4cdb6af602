"""Adds what the declarations have and the server lacks, as far as no row can be lost or falsified by it.

Columns that may be null or have a default, wider types, longer lists of values, indexes, foreign keys of new columns,
comments (DataJoint reads types from them). Tables themselves are created by their declaration.
"""

from __future__ import annotations

from typing import Any

from schemas._differences import differences

#: Every version may add columns: this one is planned at each run.
REPEATS = True


def statements(conn: Any) -> list[str]:
    """What is still to be done."""
    return [d.statement for d in differences() if d.statement]
