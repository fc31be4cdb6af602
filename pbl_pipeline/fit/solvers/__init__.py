"""One solver per file; each takes a `Session` and returns a `Solution`."""

from ._solution import Solution
from .implicit_adam import solve_implicit_adam

__all__ = ["Solution", "solve_implicit_adam"]
