"""Benchmarks that `pbl bench` runs: each case in processes of its own, so that memory and cold times are honest.

Importing this package imports no JAX: the process that only starts others must not take the accelerator.
"""

from .detect import detect_text, run_detect
from .plan import MOTIONS, SOLVERS, Case, Data, long_cases, quick_cases, robust_cases, speed_cases
from .run import Row, label, run_cases
from .table import accuracy, number, rate, solver_name, table, text

__all__ = [
    "MOTIONS",
    "SOLVERS",
    "Case",
    "Data",
    "Row",
    "accuracy",
    "detect_text",
    "label",
    "long_cases",
    "number",
    "quick_cases",
    "rate",
    "robust_cases",
    "run_cases",
    "run_detect",
    "solver_name",
    "speed_cases",
    "table",
    "text",
]
