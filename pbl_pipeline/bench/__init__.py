"""Benchmarks that `pbl bench` runs: each case in separate processes, so that memory and cold times are honest.

Importing this package imports no JAX: the process that only starts others must not take the accelerator.
"""

from .cases import METHOD, Case, Data, fit_cases
from .detect import detect_text, run_detect
from .run import Programs, Row, fit_text, run_cases
