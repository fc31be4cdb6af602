"""Threads of the linear algebra library.

JAX calls LAPACK for each of many small matrices. A LAPACK that splits each of them over its own threads, beside JAX's,
is slower by a factor of ten and more where cores are shared (measured: 110 ms became 1,800 ms).
"""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController


@functools.cache
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  JAX takes its LAPACK from here; only a loaded library can be told

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """One thread per call of BLAS and LAPACK inside the block."""
    return _controller().limit(limits=1, user_api="blas")
