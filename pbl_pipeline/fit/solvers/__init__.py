"""One solver per file; each takes a `Session` and returns a `Solution`."""

from ._solution import Solution
from .gauss_newton import solve_gauss_newton, start_of
from .implicit_adam import solve_implicit_adam

__all__ = ["Solution", "solve_gauss_newton", "solve_implicit_adam", "start_of"]
