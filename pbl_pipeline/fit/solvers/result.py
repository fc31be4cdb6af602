"""Reason why a solver ended."""

from __future__ import annotations

import enum


class Result(enum.IntEnum):
    """A code that fits into an array, so that a compiled loop can carry it."""

    #: At its bound on iterations or steps, or not ended yet.
    MAX_STEPS_REACHED = 0
    #: After a step in which no unknown moved further than the limit.
    SMALL_STEP = 1
    #: After steps that hardly lowered the cost.
    SMALL_GAIN = 2

    @property
    def converged(self) -> bool:
        """True if the solver ended at a minimum."""
        return self is not Result.MAX_STEPS_REACHED
