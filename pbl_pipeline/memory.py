"""Memory of pictures goes back to the system as soon as they are let go.

The C library of Linux keeps blocks of up to 32 MB in one heap once the first of them was freed. A picture of a phone
video has 6 MB; between two of them small results are stored that stay, so the hole that a picture leaves is soon too
small for the next one, and the heap grows although nothing is held: tracking took 3.3 GB after two minutes of 1080p.
With a fixed limit large blocks are mapped on their own and returned when freed.
"""

from __future__ import annotations

import ctypes
import functools
import sys

#: Blocks from this size on are mapped on their own (bytes).
LARGE = 1 << 20
#: The C library's name of that limit (malloc.h).
_M_MMAP_THRESHOLD = -3


@functools.cache
def return_large_blocks() -> bool:
    """Fix the limit for this process; True where the C library has one (glibc). Once is enough."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        return bool(ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE))
    except (AttributeError, OSError):  # another C library
        return False
