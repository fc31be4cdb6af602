"""Portable Biomechanics Laboratory: gait analysis from phone video, as a pure library.

Nothing here knows a database: the tables in `schemas` call these functions, never the other way round.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("pbl-pipeline")
except PackageNotFoundError:  # a source tree on sys.path without installation
    __version__ = "0.0.0+not-installed"
