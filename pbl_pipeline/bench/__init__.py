"""Benchmarks that `pbl bench` runs: each case in processes of its own, so that memory and cold times are honest.

Importing this package imports no JAX: the process that only starts others must not take the accelerator.
"""

from ._detect import detect_text, run_detect
from ._plan import MOTIONS, SOLVERS, Case, Data, long_cases, quick_cases, robust_cases, speed_cases
from ._run import Row, label, run_cases
from ._table import ratios, text

__all__ = [
    "MOTIONS",
    "SOLVERS",
    "Case",
    "Data",
    "Row",
    "detect_text",
    "label",
    "long_cases",
    "quick_cases",
    "ratios",
    "robust_cases",
    "run_cases",
    "run_detect",
    "speed_cases",
    "text",
]
