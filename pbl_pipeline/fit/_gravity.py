"""The vertical of a camera whose tilt was not measured."""

from __future__ import annotations

from ._inputs import Session
from .solvers import Solution


def upright(session: Session, solution: Solution) -> tuple[Solution, tuple[str, ...]]:
    """The solution in a world whose z is up, and where each trial's vertical comes from."""
    return solution, session.orientation
