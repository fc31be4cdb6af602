"""The tables. `activate()` connects and declares them; everything scientific is in `pbl_pipeline`.

Importing this package connects to nothing and loads no table.
"""

from ._activate import COMPUTED, STAGES, activate, computed_tables

__all__ = ["COMPUTED", "STAGES", "activate", "computed_tables"]
