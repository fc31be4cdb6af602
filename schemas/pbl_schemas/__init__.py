"""The tables. `activate()` connects and declares them; everything scientific is in `pbl_pipeline`.

Importing this package connects to nothing and loads no table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from . import errors as _errors  # registers the codes
from ._activate import activate
from .stages import STAGES

if TYPE_CHECKING:
    from pbl_pipeline.visit import Visit


def computed_tables() -> list[Any]:
    """The computed tables in the order of the chain: see `pbl_schemas.chain`."""
    from .chain import computed_tables as tables

    return tables()


def load_visit(restriction: Any) -> Visit:
    """Return everything that the tables hold of one visit: see `pbl_schemas.reading.load_visit`."""
    from .reading import load_visit as load

    return load(restriction)


def visits_of(sessions: Any) -> Any:
    """Return our visits of rows of a linked laboratory's Session: see `pbl_schemas.linking`."""
    from .linking import visits_of as linked

    return linked(sessions)
