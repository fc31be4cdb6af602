"""Portable Biomechanics Laboratory: gait analysis from phone video, as a pure library.

Nothing here knows a database: the tables in `schemas` call these functions, never the other way round.
"""

#: Stated here only: pyproject.toml reads it. `code_version` adds the commit.
__version__ = "0.2.0"
