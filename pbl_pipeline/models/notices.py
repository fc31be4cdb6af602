"""Lines that a compiled library writes to the process's standard error, and that say nothing to anybody."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_STDERR = 2
_lock = threading.Lock()
_done: set[bytes] = set()


@contextmanager
def without_notice(words: bytes) -> Iterator[None]:
    """Keep lines with these words off the standard error, the first time in a process that the block is entered; what
    else is written there is written after the block. For a library that says it once and has no setting for it."""
    with _lock:
        first = words not in _done
        _done.add(words)
    if not first:
        yield
        return
    with tempfile.TemporaryFile() as kept:
        before = os.dup(_STDERR)
        os.dup2(kept.fileno(), _STDERR)
        try:
            yield
        finally:
            os.dup2(before, _STDERR)
            os.close(before)
            kept.seek(0)
            os.write(_STDERR, b"".join(line for line in kept if words not in line))
