"""The tables. `activate()` connects and declares them; everything scientific is in `pbl_pipeline`.

Importing this package connects to nothing and loads no table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ._activate import activate
from .stages import STAGES

if TYPE_CHECKING:
    from .results import SessionResults


def computed_tables() -> list[Any]:
    """The computed tables in the order of the chain: see `schemas.chain`."""
    from .chain import computed_tables as tables

    return tables()


def load_session(restriction: Any) -> SessionResults:
    """Everything the tables hold of one session, as the library's objects: see `schemas.results.load_session`."""
    from .results import load_session as load

    return load(restriction)


__all__ = ["STAGES", "activate", "computed_tables", "load_session"]
