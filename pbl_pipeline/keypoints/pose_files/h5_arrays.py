"""HDF5 files of other programs: arrays of bounded size, and nothing unpickled."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.bounded import MAX_ARRAYS
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.extras import needed

from .poses import bad_file


@contextmanager
def opened_h5(path: Path) -> Iterator[Any]:
    """An h5py.File to read. Raises `PblError` FILE_MISSING, FILE_FORMAT (also for a field that it lacks)."""
    h5py = needed("h5py", f"reading {path.name}")
    with os_errors_as("FILE_MISSING", "an HDF5 file", "check the path, and that you may read the file", path):
        path.open("rb").close()
    try:
        with h5py.File(path, "r") as file:
            yield file
    except PblError:
        raise
    except (OSError, KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError) as error:
        raise bad_file(str(error)[:200], "an analysis file of SLEAP, or an .h5 of DeepLabCut", key=path) from error


def array_of(data: Any) -> np.ndarray:
    """Values of a dataset of up to `MAX_ARRAYS`. Raises ValueError."""
    if data.size * max(data.dtype.itemsize, 8) > MAX_ARRAYS:
        raise ValueError(f"{data.name}: shape {data.shape} is too large")
    return np.asarray(data[()])


def texts_of(data: Any) -> tuple[str, ...]:
    """Values of a dataset (N,) of texts."""
    return tuple(v.decode() if isinstance(v, bytes) else str(v) for v in array_of(data).ravel())
