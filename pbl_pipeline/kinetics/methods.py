"""Methods of the stage: a row of `KineticsMethod` in the tables."""

from __future__ import annotations

from pbl_pipeline.methods import Stage

from .compute import visit_kinetics
from .types import KineticsParams

#: The function takes fits, their gait and the `Method`, and returns `Kinetics` (`visit_kinetics`).
METHODS: Stage[KineticsParams] = Stage("kinetics", "family", "newton-euler")
METHODS.register("newton-euler", 5, KineticsParams(), visit_kinetics)
