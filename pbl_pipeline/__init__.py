"""Portable Biomechanics Laboratory: gait analysis from phone video, as a pure library.

Nothing here knows a database: the tables in `schemas` call these functions, never the other way round.
"""

import os

# Before NumPy is loaded: its matrices are small here, and threads of its library would wait for each other in loops.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

#: Stated here only: pyproject.toml reads it. `code_version` adds the commit.
__version__ = "0.2.0"
