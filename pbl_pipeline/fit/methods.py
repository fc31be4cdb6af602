"""The methods of the fit."""

from __future__ import annotations

from pbl_pipeline.methods import Stage

from .params import BLAZEPOSE, BLAZEPOSE_MEASURED, GAUSS_NEWTON, MARKERS, PAPER_2025, PAPER_GAUSS_NEWTON, Params
from .per_frame import solve_per_frame

#: A family is a solver: a function from sessions that are packed to the same sizes, its parameters and the sessions'
#: starts to a `Solution` of each in their order, or the `PblError` of one that cannot be solved. Sessions and starts
#: are iterables: they end where no other session is packed, and may have more when they are asked again.
METHODS: Stage[Params] = Stage("fit", "solver", "blazepose")
METHODS.register("paper-2025", 2, PAPER_2025, "pbl_pipeline.fit.implicit:solve_sessions")
METHODS.register("gauss-newton", 5, GAUSS_NEWTON, solve_per_frame)
METHODS.register("paper-gauss-newton", 3, PAPER_GAUSS_NEWTON)
METHODS.register("blazepose", 9, BLAZEPOSE)
METHODS.register("blazepose-measured", 2, BLAZEPOSE_MEASURED)
METHODS.register("markers", 3, MARKERS)
