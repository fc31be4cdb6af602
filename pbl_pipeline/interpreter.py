"""The check that this Python can have the dependencies: the Makefile calls it before it makes an environment, and `pbl`
before it loads anything. It uses no syntax newer than Python 3.6, and the standard library only."""

import struct
import sys

#: Oldest version, as in pyproject.toml, and the size of a pointer for which jaxlib has wheels.
OLDEST, BITS = (3, 11), 64


def require() -> None:
    """End the process with PYTHON_UNSUPPORTED where the dependencies have no wheels for this Python: pip would compile
    for an hour and fail, or name a package instead of the cause."""
    version, bits = sys.version_info, 8 * struct.calcsize("P")
    if version >= OLDEST and bits >= BITS:
        return
    oldest = ".".join(map(str, OLDEST))
    sys.exit(
        "PYTHON_UNSUPPORTED: this Python is too old, or has 32 bits\n"
        f"  found:    Python {version[0]}.{version[1]} of {bits} bits, {sys.executable}\n"
        f"  expected: Python {oldest} or newer, of {BITS} bits\n"
        "  next:     install one (Debian 12: apt-get install python3-venv; elsewhere: uv python install 3.11), remove "
        "the environment (.venv) if this one made it, then: make demo PYTHON=/path/to/python3.11, or pip install again"
    )
