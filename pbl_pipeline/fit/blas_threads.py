"""Threads of the linear algebra library.

JAX calls LAPACK for each of many small matrices. A LAPACK that splits each of them over its own threads, beside JAX's,
is slower by a factor of ten and more where cores are shared (measured: 110 ms became 1,800 ms).
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator
from typing import Any

from threadpoolctl import ThreadpoolController


@functools.cache
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  JAX takes its LAPACK from here; only a loaded library can be told

    return ThreadpoolController()


_lock = threading.Lock()
_inside: list[Any] = []  # the limit, once for each block that is entered; it knows the number of threads before


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """One thread per call of BLAS and LAPACK inside the block, of which several threads may be in one at a time."""
    with _lock:
        limit = _controller().limit(limits=1, user_api="blas") if not _inside else _inside[0]
        _inside.append(limit)
    try:
        yield
    finally:
        with _lock:
            _inside.pop()
            if not _inside:
                limit.restore_original_limits()
